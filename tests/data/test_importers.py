"""Each reader turns a known chain, laid out in its format's convention, back into the chain."""

import io
import json
import shutil
from dataclasses import replace
from functools import partial

import gymnasium as gym
import numpy as np
import pytest
from chain import chain, follows
from debug_agent import pretrained
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from PIL import Image
from stable_baselines3.common.buffers import ReplayBuffer as SB3Buffer
from stable_baselines3.common.save_util import save_to_pkl
from tensorboard.summary.writer.record_writer import RecordWriter
from zoo_command import call

from wpt_agents.data.convert import cache_folder
from wpt_agents.data.dataset import TrajectoryDataset
from wpt_agents.data.images import Resizer
from wpt_agents.data.importers.episodes import as_images, needs
from wpt_agents.data.importers.formats import open_episodes, recognise
from wpt_agents.data.importers.npz import NpzEpisodes
from wpt_agents.data.importers.sb3 import SB3Episodes
from wpt_agents.data.trajectory import Trajectory
from wpt_agents.data.units import rescaled

SMALL = {"image_size": 8, "rewards": True}


def check_follows(trajectory):
    """The next image is the chain's, by the action taken at this one, with the reward for it."""
    state = trajectory.image[:, 0, 0, 0].astype(int)
    assert (follows(state[:-1], trajectory.action[:, 0]) == state[1:]).all()
    np.testing.assert_allclose(trajectory.reward, state[1:] / 251, rtol=1e-5)


def check_same(episode, expected, images=None):
    check_follows(episode)
    np.testing.assert_array_equal(episode.image, expected.image[:images])
    assert episode.terminated == expected.terminated


# Shared by all


def test_channels_first_becomes_channels_last_and_of_stacked_frames_the_newest_stays():
    frames = np.arange(2 * 16 * 20 * 9).reshape(2, 16, 20, 9).astype(np.uint8)
    np.testing.assert_array_equal(
        as_images(frames[:, :16, :16], Resizer(16)), frames[:, :16, :16, 6:]
    )
    first = frames[:, :16, :16].transpose(0, 3, 1, 2)
    np.testing.assert_array_equal(as_images(first, Resizer(16)), frames[:, :16, :16, 6:])


def test_resizing_keeps_flat_colours_and_gradients():
    image = np.zeros((70, 32, 48, 3), np.uint8)
    image[..., 0], image[:, :, 24:, 1] = 200, 100
    with pytest.warns(UserWarning, match="squeezed"):
        small = as_images(image, Resizer(8))
    assert small.shape == (70, 8, 8, 3)
    assert (small[..., 0] == 200).all()
    assert small[0, 0, :, 1].tolist()[:2] == [0, 0]
    assert small[0, 0, :, 1].tolist()[-2:] == [100, 100]


def test_the_advice_for_images_that_are_not_square_suits_any_layout(tmp_path):
    image = np.zeros((3, 3, 20, 8), np.uint8)  # where image[..., 6:14, 0:8, :] is nothing
    np.savez(tmp_path / "0.npz", observation=image, action=np.zeros((3, 2)))
    with pytest.warns(UserWarning, match=r"to keep the proportions, pass crop=True \(--crop\)$"):
        NpzEpisodes(tmp_path, **SMALL)[0]
    assert NpzEpisodes(tmp_path, crop=True, **SMALL)[0].image.shape == (3, 8, 8, 3)


@pytest.mark.parametrize(
    ("shape", "dtype", "culprit"),
    [((5, 17), np.float32, "render the states"), ((5, 8, 8, 1), np.uint8, "1 channels")],
)
def test_what_is_no_colour_image_is_refused(shape, dtype, culprit):
    with pytest.raises(ValueError, match=culprit):
        as_images(np.zeros(shape, dtype), Resizer(8))


def test_actions_are_rescaled_by_hand():
    # (a - low) / (high - low) * 2 - 1: 1 of 0..4 is -0.5; beyond the limits is clipped; equal is 0
    scaled = rescaled(np.array([[1.0, 9.0, 7.0]]), [0, 0, 7], [4, 1, 7])
    assert scaled.tolist() == [[-0.5, 1.0, 0.0]]


def test_actions_without_limits_are_refused():
    with pytest.raises(ValueError, match="not finite; pass low and high"):
        rescaled(np.zeros((3, 1)), [-np.inf], [np.inf])
    with pytest.raises(ValueError, match="not continuous actions"):
        rescaled(np.zeros(3), [0.0], [1.0])


@pytest.mark.parametrize("form", ["hdf5", "lerobot", "npz", "rlds"])
@pytest.mark.parametrize("limit", ["low", "high"])
def test_one_limit_without_the_other_is_refused(tmp_path, form, limit):
    with pytest.raises(ValueError, match=r"low and high, .* belong together; got low=.* and high="):
        open_episodes(tmp_path, form, **{limit: [1.0, 1.0]})


@pytest.mark.parametrize(("low", "high"), [(1, -1), ([-1, 2], [1, 1]), ([-1, 2], 1)])
def test_limits_that_were_exchanged_are_refused(tmp_path, low, high):
    with pytest.raises(ValueError, match=r"low is above high in dimension [01], .*; exchange them"):
        open_episodes(tmp_path, "npz", low=low, high=high)


def test_a_missing_package_is_asked_for_by_name():
    with pytest.raises(ImportError, match="Reading smoke needs nowhere_to_be: pip install"):
        needs("nowhere_to_be.found", "smoke")


def test_a_format_that_is_not_known_is_refused(tmp_path):
    with pytest.raises(ValueError, match=r"No format 'gif'\. There are: hdf5, lerobot"):
        open_episodes(tmp_path, "gif")
    with pytest.raises(ValueError, match="is empty; pass a folder with data"):
        open_episodes(tmp_path)


# .npz: the action led to the observation


def save_npz(path, trajectory, key="observation", terminated_as="discount"):
    before = np.zeros((1, trajectory.action.shape[1]), np.float32)
    over = np.zeros((len(trajectory) + 1, 1), np.float32)
    over[-1] = trajectory.terminated
    arrays = {
        key: trajectory.image.transpose(0, 3, 1, 2),
        "action": np.concatenate([before, trajectory.action]),
        "reward": np.concatenate([[0], trajectory.reward])[:, None],
        terminated_as: 1 - over if terminated_as == "discount" else over,
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(path, **arrays)


@pytest.mark.parametrize(
    ("key", "over"),
    [("observation", "discount"), ("image", "is_terminal")],
    ids=["ncrl", "dreamer"],
)
@pytest.mark.parametrize("terminated", [True, False])
def test_npz_actions_lead_the_observation_and_are_shifted_back(tmp_path, key, over, terminated):
    old = chain(20, terminated=terminated)
    save_npz(tmp_path / "20240101T000000-ab-0-20.npz", old, key, over)
    [new] = open_episodes(tmp_path, embodiment="walker", **SMALL)
    check_same(new, old)
    assert (new.embodiment, new.source) == ("walker", "20240101T000000-ab-0-20.npz")


def test_npz_with_an_image_more_than_actions_has_our_timing(tmp_path):
    old = chain(5, terminated=True)
    path = tmp_path / "0.npz"
    over = np.arange(5) == 4
    np.savez(path, image=old.image, action=old.action, reward=old.reward, is_terminal=over)
    [new] = open_episodes(tmp_path, **SMALL)
    check_same(new, old)
    np.savez(path, image=old.image, action=old.action, reward=np.zeros(6))
    with pytest.raises(ValueError, match="has 6 rewards for 5 actions"):
        open_episodes(tmp_path, **SMALL)[0]


def test_a_first_action_in_npz_that_is_no_placeholder_is_asked_about(tmp_path):
    old = chain(5, terminated=True)
    path = tmp_path / "0.npz"
    over = np.arange(5) == 4
    np.savez(path, image=old.image[:-1], action=old.action, reward=old.reward, is_terminal=over)
    with pytest.raises(ValueError, match=r"0\.npz.* here it is not: pass shifted=True if it did "):
        open_episodes(tmp_path, **SMALL)[0]
    [taken] = open_episodes(tmp_path, shifted=False, **SMALL)
    np.testing.assert_array_equal(taken.action, old.action[:4])
    np.testing.assert_array_equal(taken.image, old.image[:5])
    np.testing.assert_allclose(taken.reward, old.reward[:4])
    assert not taken.terminated  # what the last action led to is not there
    [led] = open_episodes(tmp_path, shifted=True, **SMALL)
    np.testing.assert_array_equal(led.action, old.action[1:])


def test_npz_actions_are_rescaled_from_the_limits_given(tmp_path):
    old = chain(5)
    large = replace(old, action=old.action / 4)  # in [-1/4, 1/4]
    save_npz(tmp_path / "0.npz", large)
    [new] = open_episodes(tmp_path, low=[-0.25] * 2, high=[0.25] * 2, **SMALL)
    np.testing.assert_allclose(new.action, old.action, atol=1e-6)


def test_rewards_are_left_out_unless_asked_for(tmp_path):
    save_npz(tmp_path / "0.npz", chain(5))
    assert NpzEpisodes(tmp_path, image_size=8)[0].reward is None


class Start(Trajectory):
    """An episode that ended before anything was done."""

    def __post_init__(self):
        pass


def start(seed=0):
    none = np.zeros((0, 2), np.float32)
    return Start(chain(1, seed).image[:1], none, none[:, 0], action_dim=2)


def test_rewards_that_are_not_asked_for_need_not_be_one_for_each_step(tmp_path):
    save_npz(tmp_path / "in/0.npz", chain(5))
    with np.load(tmp_path / "in/0.npz") as arrays:
        np.savez(tmp_path / "in/0.npz", **(dict(arrays) | {"reward": 3.0, "is_first": True}))
    assert len(NpzEpisodes(tmp_path / "in", image_size=8)[0]) == 5
    with pytest.raises(ValueError, match=r"0\.npz has 1 rewards for 6 actions"):
        NpzEpisodes(tmp_path / "in", **SMALL)[0]


def save_npz_folder(folder, trajectories):
    for i, trajectory in enumerate(trajectories):
        save_npz(folder / f"{i}.npz", trajectory)


def save_rlds_folder(folder, trajectories):
    for i in (0, 2):
        save_rlds(folder / f"{i}.tfrecord", trajectories[i : i + 2])


@pytest.mark.parametrize("save", [save_npz_folder, save_rlds_folder])
def test_episodes_of_a_single_image_are_left_out_aloud(tmp_path, save):
    old = [start(0), chain(5, 1), start(2), chain(7, 3)]
    save(tmp_path / "in", old)
    with pytest.warns(UserWarning, match="in: 2 episodes of a single image left out") as warned:
        episodes = open_episodes(tmp_path / "in", **SMALL)
    assert len(warned) == 1
    for episode, expected in zip(episodes, [old[1], old[3]], strict=True):
        check_same(episode, expected)
    TrajectoryDataset.from_episodes(episodes, tmp_path / "out")
    assert TrajectoryDataset.from_episodes(episodes, tmp_path / "out").lengths.tolist() == [5, 7]


def test_an_npz_file_without_an_image_is_left_out_as_one_of_a_single_image_is(tmp_path):
    save_npz(tmp_path / "0.npz", chain(5))
    empty = {"observation": np.zeros((0, 8, 8, 3), np.uint8), "action": np.zeros((0, 2))}
    np.savez(tmp_path / "1.npz", **empty)
    with pytest.warns(UserWarning, match="1 episode of a single image left out"):
        assert [len(t) for t in NpzEpisodes(tmp_path, **SMALL)] == [5]


def test_npz_episodes_come_by_name_from_every_folder(tmp_path):
    for name, n in (("b/1", 5), ("a/2", 6), ("a/1", 7)):
        save_npz(tmp_path / f"{name}.npz", chain(n))
    assert [len(t) for t in NpzEpisodes(tmp_path, **SMALL)] == [7, 6, 5]


def test_a_file_of_another_format_is_no_npz_and_never_to_be_loaded_as_a_pickle(tmp_path):
    np.save(tmp_path / "a.npy", np.zeros((3, 4)))
    (tmp_path / "a.hdf5").write_bytes(b"\x89HDF\r\n\x1a\n" + bytes(100))
    for name in ("a.npy", "a.hdf5"):
        with pytest.raises(
            ValueError, match=rf"{name} is .* not an .npz .*; if it is of"
        ) as refused:
            NpzEpisodes(tmp_path / name)[0]
        assert "pickle" not in str(refused.value)


@pytest.mark.parametrize("share", [0.1, 0.6, 0.99])
def test_a_truncated_npz_is_named(tmp_path, share):
    save_npz(tmp_path / "0.npz", chain(50))
    content = (tmp_path / "0.npz").read_bytes()
    (tmp_path / "0.npz").write_bytes(content[: int(share * len(content))])
    with pytest.raises(ValueError, match=r"0\.npz is damaged"):
        NpzEpisodes(tmp_path, **SMALL)[0]


@pytest.mark.parametrize(
    ("arrays", "culprit"),
    [
        ({"observation": np.zeros((4, 24), np.float32), "action": np.zeros((4, 2))}, "render"),
        ({"pixels": np.zeros((4, 8, 8, 3), np.uint8), "action": np.zeros((2, 2))}, "equally many"),
        (
            {
                "image": np.zeros((4, 8, 8, 3), np.uint8),
                "action": np.zeros((4, 2)),
                "is_first": np.array([1, 0, 1, 0], bool),
            },
            "parts of several episodes",
        ),
        ({"state": np.zeros(3)}, "holds state; an episode needs 'action' and one of observation"),
        (
            {
                "image": np.zeros((4, 8, 8, 3), np.uint8),
                "action": np.array([[0, 0], [9, 9], [9, 9], [9, 9.0]]),
            },
            "rescale",
        ),
    ],
)
def test_an_npz_of_something_else_is_named_with_the_reason(tmp_path, arrays, culprit):
    np.savez(tmp_path / "strange.npz", **arrays)
    with pytest.raises(ValueError, match=rf"strange\.npz.*{culprit}"):
        NpzEpisodes(tmp_path, **SMALL)[0]


def test_a_folder_without_npz_is_named(tmp_path):
    with pytest.raises(ValueError, match=r"holds no \.npz"):
        NpzEpisodes(tmp_path)


# Converting


def test_a_conversion_that_was_cut_short_goes_on_where_it_stopped(tmp_path):
    for i in range(4):
        save_npz(tmp_path / f"in/{i}.npz", chain(5 + i, i))
    save_npz(tmp_path / "in/2.npz", chain(2), key="nonsense")
    episodes = NpzEpisodes(tmp_path / "in", **SMALL)
    with pytest.raises(ValueError, match=r"2\.npz holds"):
        TrajectoryDataset.from_episodes(episodes, tmp_path / "out")
    assert len(TrajectoryDataset.open(tmp_path / "out")) == 2
    save_npz(tmp_path / "in/2.npz", chain(7, 2))
    TrajectoryDataset.from_episodes(episodes, tmp_path / "out")
    dataset = TrajectoryDataset.open(tmp_path / "out")
    assert dataset.lengths.tolist() == [5, 6, 7, 8]
    for seed, trajectory in enumerate(dataset):
        check_same(trajectory, chain(5 + seed, seed))


def test_a_conversion_that_another_one_overtakes_adds_nothing_twice(tmp_path, monkeypatch):
    for i in range(3):
        save_npz(tmp_path / "in" / f"{i}.npz", chain(5, i))
    open_or_create = TrajectoryDataset.open_or_create

    def overtaken(path, image_size):
        monkeypatch.undo()
        dataset = open_or_create(path, image_size)
        TrajectoryDataset.from_npz(tmp_path / "in", path, **SMALL)
        return dataset

    monkeypatch.setattr(TrajectoryDataset, "open_or_create", overtaken)
    dataset = TrajectoryDataset.from_npz(tmp_path / "in", tmp_path / "out", **SMALL)
    assert dataset.sources == ["0.npz", "1.npz", "2.npz"]


def test_a_conversion_killed_while_its_folder_is_made_goes_on(tmp_path):
    save_npz(tmp_path / "in/0.npz", chain(5))
    (tmp_path / "out").mkdir()
    (tmp_path / "out/index.jsonl").touch()  # and no meta.json
    assert len(TrajectoryDataset.from_npz(tmp_path / "in", tmp_path / "out", **SMALL)) == 1


def test_a_dataset_of_another_source_is_not_added_to(tmp_path):
    for folder, name in (("a", "1"), ("b", "2")):
        save_npz(tmp_path / folder / f"{name}.npz", chain(5))
    TrajectoryDataset.from_npz(tmp_path / "a", tmp_path / "out", **SMALL)
    with pytest.raises(ValueError, match="1 trajectories of another source"):
        TrajectoryDataset.from_npz(tmp_path / "b", tmp_path / "out", **SMALL)


@pytest.mark.parametrize("count", [3, 5])
def test_a_source_whose_files_have_the_same_names_is_not_added_to(tmp_path, count):
    for i in range(3):
        save_npz(tmp_path / f"walker/{i}.npz", chain(5, i))
    for i in range(count):
        save_npz(tmp_path / f"cheetah/{i}.npz", chain(5, 10 + i))
    TrajectoryDataset.from_npz(tmp_path / "walker", tmp_path / "out", **SMALL)
    with pytest.raises(ValueError, match="3 trajectories of another source"):
        TrajectoryDataset.from_npz(tmp_path / "cheetah", tmp_path / "out", **SMALL)
    assert len(TrajectoryDataset.open(tmp_path / "out")) == 3


def test_the_same_actions_seen_by_another_camera_are_another_source(tmp_path):
    seen = chain(5)
    save_npz(tmp_path / "a/0.npz", seen)
    save_npz(tmp_path / "b/0.npz", replace(seen, image=255 - seen.image))
    TrajectoryDataset.from_npz(tmp_path / "a", tmp_path / "out", **SMALL)
    with pytest.raises(ValueError, match="another source"):
        TrajectoryDataset.from_npz(tmp_path / "b", tmp_path / "out", **SMALL)


def test_a_conversion_does_not_go_on_under_another_label(tmp_path):
    for i in range(2):
        save_npz(tmp_path / f"in/{i}.npz", chain(5, i))
    (tmp_path / "in/1.npz").rename(tmp_path / "1.npz")
    TrajectoryDataset.from_npz(tmp_path / "in", tmp_path / "out", embodiment="walker", **SMALL)
    (tmp_path / "1.npz").rename(tmp_path / "in/1.npz")
    with pytest.raises(ValueError, match="other labels; convert to another folder"):
        TrajectoryDataset.from_npz(tmp_path / "in", tmp_path / "out", embodiment="ant", **SMALL)
    done = TrajectoryDataset.from_npz(
        tmp_path / "in", tmp_path / "out", embodiment="walker", **SMALL
    )
    assert done.embodiments == ["walker", "walker"]


def test_a_format_or_option_that_is_mistyped_is_answered_with_the_nearest(tmp_path):
    with pytest.raises(ValueError, match=r"No format 'lerobt'\. Did you mean 'lerobot'"):
        TrajectoryDataset.from_episodes(open_episodes(tmp_path, "lerobt"), tmp_path / "out")
    with pytest.raises(ValueError, match=r"No option for npz 'image_kye'\. Did you mean 'image_"):
        TrajectoryDataset.from_npz(tmp_path, tmp_path / "out", image_kye="pixels")


def test_other_metadata_than_minaris_do_not_make_a_folder_minaris(tmp_path):
    save_npz(tmp_path / "0.npz", chain(5))
    (tmp_path / "metadata.json").write_text('{"robot": "arm"}')
    assert recognise(tmp_path) == "npz"
    with pytest.raises(ValueError, match=r"is damaged .*: download or record this Minari"):
        open_episodes(tmp_path, "minari")


# Straight from the files


@pytest.fixture
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache" / "wpt_agents"


def test_a_folder_of_npz_is_converted_once_and_anew_when_a_file_changes(tmp_path, cache):
    save_npz(tmp_path / "in/0.npz", chain(5, 0, size=64))
    first = TrajectoryDataset.of(tmp_path / "in")
    assert first.path == cache_folder(tmp_path / "in") and first.path.parent == cache
    written = [p.stat().st_mtime_ns for p in sorted(first.path.iterdir())]
    again = TrajectoryDataset.of(str(tmp_path / "in"))
    assert [p.stat().st_mtime_ns for p in sorted(again.path.iterdir())] == written
    save_npz(tmp_path / "in/1.npz", chain(6, 1, size=64))
    assert TrajectoryDataset.of(tmp_path / "in").lengths.tolist() == [5, 6]
    assert len(list(cache.iterdir())) == 2


def test_data_in_linked_folders_are_read_and_converted_anew_when_they_change(tmp_path, cache):
    save_npz(tmp_path / "in/here/0.npz", chain(5, 0, size=64))
    save_npz(tmp_path / "elsewhere/1.npz", chain(7, 1, size=64))
    (tmp_path / "in/there").symlink_to(tmp_path / "elsewhere")
    dataset = TrajectoryDataset.of(tmp_path / "in")
    assert dataset.lengths.tolist() == [5, 7]
    assert dataset.sources == ["here/0.npz", "there/1.npz"]
    save_npz(tmp_path / "elsewhere/2.npz", chain(9, 2, size=64))
    assert TrajectoryDataset.of(tmp_path / "in").lengths.tolist() == [5, 7, 9]


def test_a_cache_that_cannot_be_made_is_said_to_be_movable(tmp_path, monkeypatch):
    save_npz(tmp_path / "in/0.npz", chain(5, 0, size=64))
    (tmp_path / "file").touch()  # in the place of a folder, which root cannot write into either
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    with pytest.raises(ValueError, match=r"in is converted into a cache, .* set XDG_CACHE_HOME"):
        TrajectoryDataset.of(tmp_path / "in")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "folder"))
    assert len(TrajectoryDataset.of(tmp_path / "in")) == 1


def test_a_folder_whose_name_is_a_label_is_converted_again_once_renamed(tmp_path, cache):
    save_npz(tmp_path / "metaworld/reach/20240101T000000-ab-0-5.npz", chain(5, 0, size=64))
    assert TrajectoryDataset.of(tmp_path / "metaworld").tasks == ["reach"]
    (tmp_path / "metaworld/reach").rename(tmp_path / "metaworld/push")
    assert TrajectoryDataset.of(tmp_path / "metaworld").tasks == ["push"]


def test_conversions_of_readers_that_read_otherwise_are_not_used(tmp_path, cache, monkeypatch):
    save_npz(tmp_path / "in/0.npz", chain(5, 0, size=64))
    before = cache_folder(tmp_path / "in")
    monkeypatch.setattr("wpt_agents.data.convert.READERS", 1)
    assert cache_folder(tmp_path / "in") != before


def test_an_episode_that_cannot_be_converted_is_left_out_as_the_error_says(tmp_path):
    for i in range(4):
        save_npz(tmp_path / f"in/{i}.npz", chain(5 + i, i))
    broken = chain(6, 1)
    broken.action[2, 1] = np.nan
    save_npz(tmp_path / "in/1.npz", broken)
    convert = partial(TrajectoryDataset.from_npz, tmp_path / "in", **SMALL)
    remedy = r"action 2 is nan .*leave that episode out.* skip=\[1\] \(--skip=1\) leaves this one"
    with pytest.raises(ValueError, match=remedy):
        convert(tmp_path / "out")
    assert convert(tmp_path / "out", skip=[1]).lengths.tolist() == [5, 7, 8]
    save_npz(tmp_path / "in/3.npz", broken)
    with pytest.raises(ValueError, match=r"skip=\[3\]"):  # the number in the source
        convert(tmp_path / "two", skip=[1])
    assert convert(tmp_path / "two", skip=[1, 3]).lengths.tolist() == [5, 7]
    with pytest.raises(ValueError, match="skip names the episode 4, but there are 4, counted "):
        convert(tmp_path / "three", skip=[4])


def test_one_error_names_all_episodes_that_cannot_be_converted(tmp_path):
    for i in range(6):
        save_npz(tmp_path / f"in/{i}.npz", chain(5 + i, i))
    for name in ("0", "2", "5"):
        (tmp_path / f"in/{name}.npz").write_bytes(b"damaged")
    convert = partial(TrajectoryDataset.from_npz, tmp_path / "in", tmp_path / "out", **SMALL)
    remedy = r"0\.npz is damaged .* 2 after it .* skip=\[0, 2, 5\] \(--skip=0,2,5\) leaves them out"
    with pytest.raises(ValueError, match=remedy):
        convert()
    assert convert(skip=[0, 2, 5]).lengths.tolist() == [6, 8, 9]


def test_an_option_that_suits_no_episode_does_not_suggest_to_skip_all(tmp_path):
    for i in range(3):
        save_npz(tmp_path / f"in/{i}.npz", chain(5, i))
    with pytest.raises(ValueError) as error:
        TrajectoryDataset.from_npz(tmp_path / "in", tmp_path / "out", image_key="top", **SMALL)
    assert "skip" not in str(error.value)


def test_pretraining_takes_whatever_can_be_read(tmp_path, cache, monkeypatch):
    pictures = [chain(9, 0, size=64), chain(8, 1, size=64)]
    save_npz(tmp_path / "npz/0.npz", pictures[0])
    save_hdf5(tmp_path / "data.h5", [chain(9, 0, size=64)], with_next=True, scale=1)
    buffer = sb3_buffer(pictures, 30, size=64)
    store = TrajectoryDataset.from_npz(tmp_path / "npz", tmp_path / "store")
    for data in (tmp_path / "npz", tmp_path / "data.h5", buffer, store, store.path, pictures):
        model = pretrained(data, steps=1)
        assert model.pretrain_steps == 1
        np.testing.assert_array_equal(model.dataset[0].image, pictures[0].image)


def test_our_own_store_is_no_foreign_format(tmp_path):
    save_npz(tmp_path / "in/0.npz", chain(5))
    TrajectoryDataset.from_npz(tmp_path / "in", tmp_path / "out", **SMALL)
    assert recognise(tmp_path / "out") is None
    assert recognise(tmp_path / "in") == "npz"
    with pytest.raises(ValueError, match="nowhere does not exist"):
        TrajectoryDataset.of(tmp_path / "nowhere")


# SB3: the action was taken at the observation


def sb3_buffer(trajectories, length, channels_first=True, size=8, **kwargs):
    """Fills a buffer of SB3 with whole trajectories, one environment."""
    shape = (3, size, size) if channels_first else (size, size, 3)
    image_space = gym.spaces.Box(0, 255, shape, np.uint8)
    buffer = SB3Buffer(length, image_space, gym.spaces.Box(-1, 1, (2,)), "cpu", **kwargs)
    for trajectory in trajectories:
        order = (0, 3, 1, 2) if channels_first else (0, 1, 2, 3)
        image, last = trajectory.image.transpose(order), len(trajectory) - 1
        for t, (action, reward) in enumerate(
            zip(trajectory.action, trajectory.reward, strict=True)
        ):
            limit = [{"TimeLimit.truncated": t == last and not trajectory.terminated}]
            done = np.array([t == last])
            buffer.add(image[t], image[t + 1], action, np.array([reward]), done, limit)
    return buffer


@pytest.mark.parametrize("channels_first", [True, False])
def test_an_sb3_buffer_comes_back_as_its_episodes(channels_first):
    old = [chain(5, 0, terminated=True), chain(7, 1), chain(1, 2)]
    new = list(SB3Episodes(sb3_buffer(old, 50, channels_first), **SMALL))
    assert len(new) == 3
    for episode, expected in zip(new, old, strict=True):
        check_same(episode, expected)


def test_an_episode_that_sb3_left_for_a_new_one_ends_there():
    old = [chain(5, 0), chain(7, 1), chain(4, 2)]
    buffer = sb3_buffer(old, 50)
    buffer.dones[4] = 0  # `learn` was called again in the middle of the first
    new = list(SB3Episodes(buffer, **SMALL))
    assert [len(trajectory) for trajectory in new] == [5, 7, 4]
    check_same(new[0], replace(old[0], terminated=False))


def test_discrete_actions_of_sb3_are_refused():
    image = gym.spaces.Box(0, 255, (3, 8, 8), np.uint8)
    with pytest.raises(ValueError, match=r"actions are Discrete\(2\); they must be a Box"):
        SB3Episodes(SB3Buffer(5, image, gym.spaces.Discrete(2), "cpu"))


def test_actions_of_sb3_with_several_axes_keep_their_bounds():
    buffer = sb3_buffer([chain(5, 0)], 50)
    low, high = np.array([[[-2], [0]], [[2], [1]]], np.float32)
    buffer.action_space = gym.spaces.Box(low, high)
    (episode,) = SB3Episodes(buffer, **SMALL)
    assert episode.bounds.tolist() == [[-2, 0], [2, 1]]


def test_a_ring_that_has_gone_round_is_read_oldest_first():
    old = [chain(6, 0), chain(7, 1, terminated=True), chain(4, 2)]
    new = list(SB3Episodes(sb3_buffer(old, 13), **SMALL))
    # 17 steps in a ring of 13: the first episode has lost 4 of its 6 steps
    assert [len(trajectory) for trajectory in new] == [2, 7, 4]
    np.testing.assert_array_equal(new[0].image, old[0].image[4:])
    for episode, expected in zip(new[1:], old[1:], strict=True):
        check_same(episode, expected)


@pytest.mark.filterwarnings("ignore:.*of a single image left out")  # what is left of the oldest
@pytest.mark.parametrize("size", [50, 13])
def test_a_buffer_that_saves_memory_has_lost_each_last_observation(size):
    old = [chain(6, 0, terminated=True), chain(7, 1), chain(4, 2)]
    kwargs = {"optimize_memory_usage": True, "handle_timeout_termination": False}
    new = list(SB3Episodes(sb3_buffer(old, size, **kwargs), **SMALL))
    for episode in new:
        check_follows(episode)
        assert not episode.terminated
    np.testing.assert_array_equal(new[-2].image, old[1].image[:7])


def test_a_step_of_sb3_that_has_lost_its_outcome_is_left_out_aloud():
    kwargs = {"optimize_memory_usage": True, "handle_timeout_termination": False}
    buffer = sb3_buffer([chain(6, 0), chain(1, 1), chain(4, 2)], 50, **kwargs)
    with pytest.warns(UserWarning, match="environment 0: 1 episode of a single image left out"):
        assert [len(trajectory) for trajectory in SB3Episodes(buffer, **SMALL)] == [5, 3]


def test_only_a_replay_buffer_of_sb3_is_read(tmp_path):
    with pytest.raises(ValueError, match=r"Expected a ReplayBuffer of SB3, got list"):
        SB3Episodes([])
    save_to_pkl(tmp_path / "list.pkl", [1])
    with pytest.raises(ValueError, match=r"Expected a ReplayBuffer of SB3, got list"):
        SB3Episodes(tmp_path / "list.pkl", trust=True)


def test_a_saved_replay_buffer_is_loaded_by_those_who_trust_it_only(tmp_path):
    old = chain(5, 0, terminated=True)
    save_to_pkl(tmp_path / "replay.pkl", sb3_buffer([old], 20))
    with pytest.raises(ValueError, match=r"replay\.pkl is a pickle.*trust=True \(--trust\)"):
        TrajectoryDataset.from_sb3(tmp_path / "replay.pkl", tmp_path / "out", **SMALL)
    [new] = TrajectoryDataset.from_sb3(
        tmp_path / "replay.pkl", tmp_path / "out", trust=True, **SMALL
    )
    check_same(new, old)
    (tmp_path / "replay.pkl").write_bytes(b"\x80\x04half")
    with pytest.raises(ValueError, match=r"replay\.pkl cannot be read as a replay buffer"):
        SB3Episodes(tmp_path / "replay.pkl", trust=True)


# HDF5 in D4RL's manner


def save_hdf5(path, trajectories, with_next=False, scale=3):
    h5py = pytest.importorskip("h5py")
    with h5py.File(path, "w") as file:
        file["observations"] = np.concatenate([t.image[:-1] for t in trajectories])
        file["actions"] = np.concatenate([scale * t.action for t in trajectories])
        file["rewards"] = np.concatenate([t.reward for t in trajectories])
        last = np.concatenate([np.arange(len(t)) == len(t) - 1 for t in trajectories])
        over = np.concatenate([np.full(len(t), t.terminated) for t in trajectories])
        file["terminals"], file["timeouts"] = last & over, last & ~over
        if with_next:
            file["next_observations"] = np.concatenate([t.image[1:] for t in trajectories])


LIMITS = {"low": [-3, -3], "high": [3, 3]}


def test_hdf5_with_next_observations_keeps_every_action(tmp_path):
    old = [chain(5, 0, terminated=True), chain(7, 1), chain(1, 2)]
    save_hdf5(tmp_path / "data.hdf5", old, with_next=True)
    new = list(open_episodes(tmp_path / "data.hdf5", **LIMITS, **SMALL))
    for episode, expected in zip(new, old, strict=True):
        check_same(episode, expected)


def test_hdf5_without_next_observations_leaves_each_last_action_out(tmp_path):
    save_hdf5(tmp_path / "data.h5", [chain(5, 0, terminated=True), chain(1, 1), chain(7, 2)])
    with pytest.warns(UserWarning, match=r"data\.h5: 1 episode of a single image left out"):
        one, two = open_episodes(tmp_path / "data.h5", **LIMITS, **SMALL)
    check_same(one, chain(5, 0), images=5)
    check_same(two, chain(7, 2), images=7)
    assert two.source == "data.h5 rows 6 to 12"


def test_a_damaged_or_strange_hdf5_is_named(tmp_path):
    save_hdf5(tmp_path / "data.h5", [chain(50)])
    with pytest.raises(ValueError, match=r"needs an array 'pixels'; there are: actions, obs"):
        open_episodes(tmp_path / "data.h5", image_key="pixels")
    (tmp_path / "data.h5").write_bytes((tmp_path / "data.h5").read_bytes()[:3000])
    with pytest.raises(ValueError, match=r"data\.h5 is damaged or not an HDF5 file"):
        open_episodes(tmp_path / "data.h5")


# Minari, recorded with Minari itself


def record_minari(tmp_path, monkeypatch, trajectories, nested=False, cameras=1, **kwargs):
    minari = pytest.importorskip("minari")
    pytest.importorskip("h5py")
    from minari.data_collector import EpisodeBuffer

    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    names = ["pixels", "wrist"][:cameras]
    buffers = [
        EpisodeBuffer(
            observations=dict.fromkeys(names, t.image) if nested else t.image,
            actions=2 * t.action,
            rewards=t.reward.tolist(),
            terminations=(np.arange(len(t)) == len(t) - 1) & t.terminated,
            truncations=(np.arange(len(t)) == len(t) - 1) & (not t.terminated),
        )
        for t in trajectories
    ]
    image = gym.spaces.Box(0, 255, trajectories[0].image.shape[1:], np.uint8)
    minari.create_dataset_from_buffers(
        "chain/test-v0",
        buffers,
        observation_space=gym.spaces.Dict(dict.fromkeys(names, image)) if nested else image,
        action_space=gym.spaces.Box(-2, 2, (2,), np.float32),
        **kwargs,
    )


@pytest.mark.filterwarnings("ignore::UserWarning:minari")
@pytest.mark.parametrize("form", ["hdf5", "arrow"])
@pytest.mark.parametrize("nested", [False, True])
def test_minari_episodes_come_back_as_they_were(tmp_path, monkeypatch, nested, form):
    old = [chain(9, 0, terminated=True), chain(20, 1)]
    record_minari(tmp_path, monkeypatch, old, nested, data_format=form, jpeg_encoding=False)
    key = "pixels" if nested else None
    for source, name in ((tmp_path / "chain" / "test-v0", None), ("chain/test-v0", "minari")):
        new = list(open_episodes(source, name, image_key=key, **SMALL))
        for episode, expected in zip(new, old, strict=True):
            check_same(episode, expected)
        assert new[1].source == "chain/test-v0 episode 1"


@pytest.mark.filterwarnings("ignore::UserWarning:minari")
def test_a_minari_image_key_that_is_missing_or_not_there_is_named(tmp_path, monkeypatch):
    record_minari(tmp_path, monkeypatch, [chain(9)], nested=True, cameras=2, jpeg_encoding=False)
    with pytest.raises(ValueError, match=r"pass image_key \(--image-key\), one of: pixels, wrist"):
        open_episodes("chain/test-v0", "minari", **SMALL)[0]
    with pytest.raises(ValueError, match="has no 'image'; there are: pixels, wrist"):
        open_episodes("chain/test-v0", "minari", image_key="image", **SMALL)[0]


@pytest.mark.filterwarnings("ignore::UserWarning:minari")
def test_the_only_images_in_a_minari_dictionary_need_no_image_key(tmp_path, monkeypatch):
    old = chain(9)
    record_minari(tmp_path, monkeypatch, [old], nested=True, jpeg_encoding=False)
    check_same(open_episodes("chain/test-v0", "minari", **SMALL)[0], old)


def test_a_minari_dataset_that_is_not_there_is_offered_for_download(tmp_path, monkeypatch):
    pytest.importorskip("minari")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    with pytest.raises(FileNotFoundError, match="run: minari download kitchen/none-v0"):
        open_episodes("kitchen/none-v0", "minari")


@pytest.mark.filterwarnings("ignore::UserWarning:minari")
def test_images_that_minari_stored_as_jpeg_are_warned_of(tmp_path, monkeypatch):
    record_minari(tmp_path, monkeypatch, [chain(9, size=32)])
    with pytest.warns(UserWarning, match="as JPEG, which is lossy; record with jpeg_encoding=Fal"):
        open_episodes("chain/test-v0", "minari")


# LeRobot, files made to the published schema


def level(state):
    """The chain's states as 12 grey levels, which stay distinct after lossy video."""
    return 10 + 20 * state


def save_lerobot(folder, lengths, video=True, fps=10):
    """Two files of data, one video; row t holds observation t and the action taken at it."""
    pa, pq = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    rng, rows, episodes, states = np.random.default_rng(0), [], [], []
    for e, length in enumerate(lengths):
        state, start = int(rng.integers(12)), len(rows)
        for t in range(length):
            action = [float(rng.integers(0, 12)), 5.0]
            rows.append(
                {"action": action, "episode_index": e, "frame_index": t, "timestamp": t / fps,
                 "next.reward": (state + action[0]) % 12}
            )  # fmt: skip
            states.append(state)
            state = int(state + action[0]) % 12
        camera = {"chunk_index": 0, "file_index": 0, "from_timestamp": start / fps}
        episodes.append(
            {"episode_index": e, "tasks": [f"task {e}"], "length": length, "data/chunk_index": 0,
             "data/file_index": min(e, 1), **{f"videos/front/{k}": v for k, v in camera.items()}}
        )  # fmt: skip
    write_lerobot_meta(folder, video, fps)
    tables = {"meta/episodes/chunk-000/file-000": episodes}
    for file in (0, 1):
        tables[f"data/chunk-000/file-{file:03d}"] = [
            r for r in rows if min(r["episode_index"], 1) == file
        ]
    if video:
        write_video(folder / "videos/front/chunk-000/file-000.mp4", states, fps)
    else:
        for row, state in zip(rows, states, strict=True):
            row["front"] = {"bytes": png(state), "path": None}
    for name, content in tables.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        pq.write_table(pa.Table.from_pylist(content), folder / f"{name}.parquet")
    return states


def save_lerobot_2(folder, lengths, video=True, fps=10):
    """Version 2.1: a table and a video for each episode, JSON lines about them; 2 in a chunk."""
    pq = pytest.importorskip("pyarrow.parquet")
    states = iter(save_lerobot(folder / "new", lengths, video, fps))
    (folder / "meta").mkdir(parents=True)
    info = json.loads((folder / "new/meta/info.json").read_text())
    paths = ("chunk-{episode_chunk:03d}", "episode_{episode_index:06d}")
    info |= {"codebase_version": "v2.1", "chunks_size": 2}
    info["data_path"] = f"data/{paths[0]}/{paths[1]}.parquet"
    info["video_path"] = f"videos/{paths[0]}/{{video_key}}/{paths[1]}.mp4"
    (folder / "meta/info.json").write_text(json.dumps(info))
    lines, stats = [], []
    for e, length in enumerate(lengths):
        table = pq.read_table(folder / f"new/data/chunk-000/file-{min(e, 1):03d}.parquet")
        table = table.filter(np.array(table["episode_index"]) == e)
        names = {"episode_chunk": e // 2, "episode_index": e, "video_key": "front"}
        path = folder / info["data_path"].format(**names)
        path.parent.mkdir(parents=True, exist_ok=True)
        pq.write_table(table, path)
        seen = [next(states) for _ in range(length)]
        if video:
            write_video(folder / info["video_path"].format(**names), seen, fps)
        lines.append({"episode_index": e, "tasks": [f"task {e}"], "length": length})
        high = 11.0 if e == 1 else 9.0  # the extremes are those of all episodes
        limits = {"min": [0.0, 5.0], "max": [high, 5.0], "count": [length]}
        stats.append({"episode_index": e, "stats": {"action": limits}})
    for name, content in (("episodes", lines), ("episodes_stats", stats)):
        text = "\n".join(map(json.dumps, content))
        (folder / f"meta/{name}.jsonl").write_text(text + "\n")
    shutil.rmtree(folder / "new")


def write_lerobot_meta(folder, video, fps, version="v3.0"):
    (folder / "meta").mkdir(parents=True, exist_ok=True)
    path = "chunk-{chunk_index:03d}/file-{file_index:03d}"
    info = {
        "codebase_version": version,
        "robot_type": "so100",
        "fps": fps,
        "data_path": f"data/{path}.parquet",
        "video_path": f"videos/{{video_key}}/{path}.mp4",
        "features": {
            "front": {"dtype": "video" if video else "image", "shape": [32, 32, 3]},
            "action": {"dtype": "float32", "shape": [2]},
        },
    }
    (folder / "meta/info.json").write_text(json.dumps(info))
    stats = {"action": {"min": [0.0, 5.0], "max": [11.0, 5.0]}}
    (folder / "meta/stats.json").write_text(json.dumps(stats))


def png(state):
    out = io.BytesIO()
    Image.fromarray(np.full((32, 32, 3), level(state), np.uint8)).save(out, "png")
    return out.getvalue()


def write_video(path, states, fps):
    av = pytest.importorskip("av")
    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=fps, options={"g": "4", "crf": "20"})
        stream.width = stream.height = 32
        stream.pix_fmt = "yuv420p"
        for state in states:
            frame = np.full((32, 32, 3), level(state), np.uint8)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")))
        container.mux(stream.encode())


@pytest.mark.filterwarnings("ignore:LeRobot stored", "ignore:Images of 32 x 32 are resized")
@pytest.mark.parametrize("save", [save_lerobot, save_lerobot_2], ids=["v3.0", "v2.1"])
@pytest.mark.parametrize("video", [True, False])
def test_lerobot_episodes_keep_to_the_chain_and_leave_each_last_action_out(tmp_path, save, video):
    save(tmp_path, [6, 9, 1, 5], video)
    with pytest.warns(UserWarning, match="1 episode of a single image left out"):
        new = list(open_episodes(tmp_path, **SMALL))
    assert [len(trajectory) for trajectory in new] == [5, 8, 4]
    for trajectory in new:
        state = np.rint((trajectory.image[:, 4, 4, 0].astype(float) - 10) / 20).astype(int)
        action = np.rint((trajectory.action[:, 0] + 1) * 11 / 2).astype(int)
        assert ((state[:-1] + action) % 12 == state[1:]).all()
        assert (trajectory.reward == state[1:]).all()
        assert not trajectory.action[:, 1].any()  # it never moved
        assert not trajectory.terminated
    assert (new[1].task, new[1].embodiment) == ("task 1", "so100")


@pytest.mark.filterwarnings("ignore:Images of 32 x 32 are resized")
def test_that_lerobot_stored_video_is_warned_of(tmp_path):
    save_lerobot(tmp_path, [6])
    with pytest.warns(UserWarning, match="as video, which is lossy; record with dtype 'image'"):
        TrajectoryDataset.from_lerobot(tmp_path, tmp_path / "out", **SMALL)


@pytest.mark.filterwarnings("ignore:LeRobot stored", "ignore:Images of 32 x 32 are resized")
def test_a_lerobot_video_that_is_too_short_is_named(tmp_path):
    states = save_lerobot(tmp_path, [6, 9])
    (tmp_path / "videos/front/chunk-000/file-000.mp4").unlink()
    (tmp_path / "videos/front/chunk-000").rmdir()
    write_video(tmp_path / "videos/front/chunk-000/file-000.mp4", states[:10], 10)
    episodes = open_episodes(tmp_path, **SMALL)
    assert len(episodes[0]) == 5
    with pytest.raises(ValueError, match=r"episode 1: .*mp4 has no frame at 1\.000 s"):
        episodes[1]


def test_a_lerobot_dataset_of_some_episodes_is_read_with_these_alone(tmp_path):
    save_lerobot(tmp_path, [6, 9, 1, 5], video=False)
    made = {"__module__": "lerobot.datasets.lerobot_dataset"}
    loaded = type("LeRobotDataset", (), made | {"root": tmp_path, "episodes": [1, 3]})()
    with pytest.warns(UserWarning, match="Images of 32 x 32 are resized"):
        assert TrajectoryDataset.of(loaded).lengths.tolist() == [8, 4]
    with pytest.raises(ValueError, match="has no episode 7"):
        open_episodes(tmp_path, episodes=[1, 7])


@pytest.mark.filterwarnings("ignore:Images of 32 x 32 are resized")
def test_a_table_of_lerobot_that_is_missing_is_named_and_can_be_skipped(tmp_path):
    save_lerobot(tmp_path / "in", [6, 9], video=False)
    (tmp_path / "in/data/chunk-000/file-001.parquet").unlink()
    convert = partial(TrajectoryDataset.from_lerobot, tmp_path / "in", tmp_path / "out", **SMALL)
    with pytest.raises(ValueError, match=r"file-001\.parquet cannot be read.* skip=\[1\]"):
        convert()
    assert convert(skip=[1]).lengths.tolist() == [5]


@pytest.mark.filterwarnings("ignore:LeRobot stored the images .* as video")
@pytest.mark.parametrize(
    "name",
    [
        "meta/info.json",
        "meta/stats.json",
        "meta/episodes/chunk-000/file-000.parquet",
        "data/chunk-000/file-000.parquet",
        "videos/front/chunk-000/file-000.mp4",
    ],
)
def test_a_file_of_lerobot_that_git_lfs_has_not_fetched_is_named(tmp_path, name):
    save_lerobot(tmp_path, [6, 9])
    pointer = "version https://git-lfs.github.com/spec/v1\noid sha256:4d7a\nsize 1234\n"
    (tmp_path / name).write_text(pointer)
    with pytest.raises(ValueError, match=f"{name} (cannot be read|is damaged): "):
        open_episodes(tmp_path, **SMALL)[0]


def test_a_line_of_lerobot_may_contain_any_separator(tmp_path):
    save_lerobot_2(tmp_path, [6, 9], video=False)
    path = tmp_path / "meta/episodes.jsonl"
    path.write_text(path.read_text().replace("task 0", "lift\u2028put\x85"), encoding="utf-8")
    with pytest.warns(UserWarning, match="Images of 32 x 32 are resized"):
        assert open_episodes(tmp_path, **SMALL)[0].task == "lift\u2028put\x85"


def test_an_unknown_robot_of_lerobot_has_no_name(tmp_path):
    save_lerobot(tmp_path, [6], video=False)
    path = tmp_path / "meta/info.json"
    path.write_text(path.read_text().replace("so100", "unknown"))
    with pytest.warns(UserWarning, match="Images of 32 x 32 are resized"):
        assert open_episodes(tmp_path, **SMALL)[0].embodiment is None


def test_an_older_lerobot_version_and_a_camera_that_is_not_there_are_named(tmp_path):
    save_lerobot(tmp_path, [6], video=False)
    with pytest.raises(ValueError, match="0 cameras for camera='back'; pass one of: front"):
        open_episodes(tmp_path, camera="back")
    write_lerobot_meta(tmp_path, False, 10, version="v1.6")
    with pytest.raises(ValueError, match=r"version v1\.6; convert it to v2\.1"):
        open_episodes(tmp_path)


# RLDS, written with TensorBoard's record writer and Google's protocol buffers


def example_class():
    """`tf.train.Example` from its published definition."""
    file = descriptor_pb2.FileDescriptorProto(name="example.proto", package="t", syntax="proto3")
    field = descriptor_pb2.FieldDescriptorProto

    def message(name, *fields, within=file.message_type):
        made = within.add(name=name)
        for number, (title, kind, several) in enumerate(fields, 1):
            named = {"type_name": kind, "type": field.TYPE_MESSAGE} if isinstance(kind, str) else {}
            label = field.LABEL_REPEATED if several else field.LABEL_OPTIONAL
            made.field.add(name=title, number=number, label=label, **(named or {"type": kind}))
        return made

    message("BytesList", ("value", field.TYPE_BYTES, True))
    message("FloatList", ("value", field.TYPE_FLOAT, True))
    message("Int64List", ("value", field.TYPE_INT64, True))
    message("Feature", ("bytes_list", ".t.BytesList", False), ("float_list", ".t.FloatList", False),
            ("int64_list", ".t.Int64List", False))  # fmt: skip
    features = message("Features", ("feature", ".t.Features.FeatureEntry", True))
    entry = message("FeatureEntry", ("key", field.TYPE_STRING, False),
                    ("value", ".t.Feature", False), within=features.nested_type)  # fmt: skip
    entry.options.map_entry = True
    message("Example", ("features", ".t.Features", False))
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName("t.Example"))


def save_rlds(path, trajectories, form="png", cameras=("image",), scale=1.0, filler=9):
    """As TFDS writes them: the last step's action and reward are there and mean nothing."""
    example_type = example_class()
    path.parent.mkdir(parents=True, exist_ok=True)
    with open(path, "wb") as file:
        writer = RecordWriter(file)
        for t in trajectories:
            example, steps = example_type(), len(t) + 1
            feature = example.features.feature
            for camera in cameras:
                images = [encoded(image, form) for image in t.image]
                feature[f"steps/observation/{camera}"].bytes_list.value.extend(images)
            action = np.concatenate([scale * t.action, np.full((1, 2), 9)])
            feature["steps/action"].float_list.value.extend(action.ravel().tolist())
            feature["steps/observation/state"].float_list.value.extend([0.5] * steps)
            feature["steps/reward"].float_list.value.extend([*t.reward.tolist(), 77.0])
            ends = [0] * len(t) + [1]
            feature["steps/is_first"].int64_list.value.extend(ends[::-1])
            feature["steps/is_last"].int64_list.value.extend(ends)
            terminal = [0] * (steps - 1) + [int(t.terminated)]
            feature["steps/is_terminal"].int64_list.value.extend(terminal)
            feature["episode_metadata/file_path"].bytes_list.value.append(bytes(filler))
            writer.write(example.SerializeToString())
        writer.flush()


def encoded(image, form):
    out = io.BytesIO()
    Image.fromarray(image).save(out, form)
    return out.getvalue()


def test_rlds_episodes_keep_to_the_chain_and_the_last_action_means_nothing(tmp_path):
    old = [chain(5, 0, terminated=True), chain(300, 1), chain(1, 2)]
    save_rlds(tmp_path / "1.0.0/chain-train.tfrecord-00000-of-00002", old[:2])
    save_rlds(tmp_path / "1.0.0/chain-train.tfrecord-00001-of-00002", old[2:])
    save_rlds(tmp_path / "1.0.0/chain-test.tfrecord-00000-of-00001", old[:1])
    new = list(open_episodes(tmp_path, split="train", embodiment="arm", **SMALL))
    assert len(new) == 3
    for episode, expected in zip(new, old, strict=True):
        check_same(episode, expected)
    assert new[2].embodiment == "arm"
    assert new[2].source == "1.0.0/chain-train.tfrecord-00001-of-00002 at byte 12"
    assert len(TrajectoryDataset.from_rlds(tmp_path, tmp_path / "out", **SMALL)) == 4


def test_files_of_rlds_that_are_missing_are_warned_of(tmp_path):
    for i in (0, 2):
        save_rlds(tmp_path / f"1.0.0/a-train.tfrecord-{i:05d}-of-00004", [chain(5, i)])
    save_rlds(tmp_path / "1.0.0/a-val.tfrecord-00000-of-00001", [chain(5)])
    words = r"a-train\.tfrecord: 2 of 4 files are missing, number 1 for example"
    with pytest.warns(UserWarning, match=words) as warned:
        assert len(open_episodes(tmp_path, **SMALL)) == 3
    assert len(warned) == 1


def test_an_episode_of_no_steps_is_left_out_of_rlds(tmp_path):
    save_rlds(tmp_path / "a.tfrecord", [chain(5)])
    nothing = example_class()()
    for name in ("is_first", "reward", "observation/image"):  # no values of any
        nothing.features.feature[f"steps/{name}"].int64_list.SetInParent()
    with open(tmp_path / "a.tfrecord", "ab") as file:
        RecordWriter(file).write(nothing.SerializeToString())
    with pytest.warns(UserWarning, match="1 episode of a single image left out"):
        [new] = open_episodes(tmp_path, **SMALL)
    check_same(new, chain(5))


@pytest.mark.parametrize("begin", [b"\x1f\x8b", b"\x78\x9c"], ids=["gzip", "zlib"])
def test_a_record_whose_length_looks_like_a_compressed_file_is_read(tmp_path, begin):
    old = chain(5)
    length = int.from_bytes(begin, "little")
    path = tmp_path / "a.tfrecord"
    save_rlds(path, [old], filler=length)
    save_rlds(path, [old], filler=2 * length - (path.stat().st_size - 16))
    assert path.read_bytes()[:8] == length.to_bytes(8, "little")
    [new] = open_episodes(tmp_path, **SMALL)
    check_same(new, old)
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(ValueError, match="is compressed by"):
        open_episodes(tmp_path)


def test_rlds_actions_are_rescaled_from_the_limits_given(tmp_path):
    save_rlds(tmp_path / "a.tfrecord", [chain(5)], scale=3.0)
    check_same(open_episodes(tmp_path, **LIMITS, **SMALL)[0], chain(5))
    with pytest.raises(ValueError, match=r"a\.tfrecord at byte 12.*rescale"):
        open_episodes(tmp_path, **SMALL)[0]


def test_an_rlds_image_is_chosen_if_there_are_several(tmp_path):
    save_rlds(tmp_path / "a.tfrecord", [chain(5)], cameras=("front", "wrist"))
    with pytest.raises(ValueError, match="2 images a step; pass image_key, one of: observation/fr"):
        open_episodes(tmp_path, "rlds", **SMALL)[0]
    check_same(open_episodes(tmp_path, image_key="wrist", **SMALL)[0], chain(5))
    with pytest.raises(ValueError, match="no 'world_vector' in its steps; there are: "):
        open_episodes(tmp_path, image_key="wrist", action_key="world_vector", **SMALL)[0]


def test_an_rlds_image_key_that_names_numbers_is_named(tmp_path):
    save_rlds(tmp_path / "a.tfrecord", [chain(5)])
    with pytest.raises(ValueError, match="no images under 'observation/state'; pass image_key"):
        open_episodes(tmp_path, image_key="observation/state", **SMALL)[0]


def test_rlds_images_that_are_jpeg_are_warned_of_once(tmp_path):
    save_rlds(tmp_path / "a.tfrecord", [chain(5), chain(6)], "jpeg")
    with pytest.warns(UserWarning, match="are JPEG, which is lossy") as warned:
        TrajectoryDataset.from_rlds(tmp_path, tmp_path / "out", image_size=8)
    assert len(warned) == 1


@pytest.mark.parametrize("share", [0.3, 0.97])
def test_a_tfrecord_that_is_cut_short_is_named(tmp_path, share):
    save_rlds(tmp_path / "a.tfrecord", [chain(50), chain(50)])
    content = (tmp_path / "a.tfrecord").read_bytes()
    (tmp_path / "a.tfrecord").write_bytes(content[: int(share * len(content))])
    with pytest.raises(ValueError, match=r"a\.tfrecord is cut short: a record at byte"):
        open_episodes(tmp_path, "rlds", **SMALL)


def test_a_damaged_image_or_record_of_rlds_is_named(tmp_path):
    save_rlds(tmp_path / "a.tfrecord", [chain(50)])
    content = bytearray((tmp_path / "a.tfrecord").read_bytes())
    at = content.index(b"IDAT")
    content[at + 6 : at + 20] = bytes(14)
    (tmp_path / "a.tfrecord").write_bytes(content)
    with pytest.raises(ValueError, match=r"a\.tfrecord at byte 12: one of its images is damaged"):
        open_episodes(tmp_path, **SMALL)[0]
    content[12] = 0x0F  # a field of a kind that does not exist
    (tmp_path / "a.tfrecord").write_bytes(content)
    with pytest.raises(ValueError, match=r"byte 12 is damaged or no tf\.train\.Example"):
        open_episodes(tmp_path, **SMALL)[0]


# The command


def test_the_command_prints_warnings_on_lines_of_their_own(tmp_path, monkeypatch, capsys):
    save_npz(tmp_path / "in/0.npz", chain(5, size=32))
    assert call(monkeypatch, "import", "npz", tmp_path / "in", tmp_path / "out") == 0
    assert "\rWarning: Images of 32 x 32" in capsys.readouterr().err  # not beside the bar


def test_the_command_converts_with_labels_and_prints_what_came_of_it(tmp_path, monkeypatch, capsys):
    save_npz(tmp_path / "in/0.npz", chain(5, size=64))
    labels = ["--embodiment", "walker", "--task", "run", "--rewards"]
    assert call(monkeypatch, "import", "npz", tmp_path / "in", tmp_path / "out", *labels) == 0
    printed = capsys.readouterr().out
    assert "walker" in printed and "Dataset:" in printed and "codec" not in printed
    [new] = TrajectoryDataset.open(tmp_path / "out")
    check_same(new, chain(5, size=64))
    assert (new.embodiment, new.task) == ("walker", "run")


def test_the_command_warns_of_lossy_images_and_takes_limits(tmp_path, monkeypatch, capsys):
    save_rlds(tmp_path / "in/a.tfrecord", [chain(5, size=16)], "jpeg", scale=3.0)
    words = ["auto", tmp_path / "in", tmp_path / "out", "--low=-3,-3", "--high", "3,3"]
    assert call(monkeypatch, "import", *words) == 0
    assert "Warning: The images of" in capsys.readouterr().err
    np.testing.assert_allclose(TrajectoryDataset.open(tmp_path / "out")[0].action, chain(5).action)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["lerobt"], "Did you mean 'lerobot'"),
        (["npz", "--camera", "front"], "No option for npz 'camera'"),
        (["hdf5", "--low=a,b"], "--low takes numbers separated by commas, got 'a,b'"),
        (["npz"], "holds no .npz file"),
    ],
)
def test_what_the_command_cannot_import_ends_in_one_line(
    tmp_path, monkeypatch, capsys, words, message
):
    form, *options = words
    assert call(monkeypatch, "import", form, tmp_path / "in", tmp_path / "out", *options) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
