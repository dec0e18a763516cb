"""Each reader turns a known chain, laid out in its format's convention, back into the chain."""

import io
import json

import gymnasium as gym
import numpy as np
import pytest
from chain import chain, follows
from PIL import Image
from stable_baselines3.common.buffers import ReplayBuffer as SB3Buffer

from wpt_agents.dataset import TrajectoryDataset
from wpt_agents.importers.convert import convert, open_episodes
from wpt_agents.importers.episodes import as_images, needs, rescaled
from wpt_agents.importers.npz import NpzEpisodes
from wpt_agents.importers.sb3 import SB3Episodes

SMALL = {"image_size": 8, "rewards": True}


def check_follows(trajectory):
    """The next image is the chain's, by the action taken at this one, with the reward for it."""
    state = trajectory.image[:, 0, 0, 0].astype(int)
    assert (follows(state[:-1], trajectory.action[:, 0]) == state[1:]).all()
    np.testing.assert_allclose(trajectory.reward, state[1:] / 251, rtol=1e-5)


def check_same(found, expected, images=None):
    check_follows(found)
    np.testing.assert_array_equal(found.image, expected.image[:images])
    assert found.terminated == expected.terminated


# Shared by all


def test_channels_first_becomes_channels_last_and_of_stacked_frames_the_newest_stays():
    frames = np.arange(2 * 16 * 20 * 9).reshape(2, 16, 20, 9).astype(np.uint8)
    np.testing.assert_array_equal(as_images(frames[:, :16, :16], 16), frames[:, :16, :16, 6:])
    first = frames[:, :16, :16].transpose(0, 3, 1, 2)
    np.testing.assert_array_equal(as_images(first, 16), frames[:, :16, :16, 6:])


def test_resizing_keeps_flat_colours_and_gradients():
    image = np.zeros((70, 32, 48, 3), np.uint8)
    image[..., 0], image[:, :, 24:, 1] = 200, 100
    small = as_images(image, 8)
    assert small.shape == (70, 8, 8, 3)
    assert (small[..., 0] == 200).all()
    assert small[0, 0, :, 1].tolist()[:2] == [0, 0]
    assert small[0, 0, :, 1].tolist()[-2:] == [100, 100]


@pytest.mark.parametrize(
    ("shape", "dtype", "culprit"),
    [((5, 17), np.float32, "render the states"), ((5, 8, 8, 1), np.uint8, "1 channels")],
)
def test_what_is_no_colour_image_is_refused(shape, dtype, culprit):
    with pytest.raises(ValueError, match=culprit):
        as_images(np.zeros(shape, dtype), 8)


def test_actions_are_rescaled_by_hand():
    # (a - low) / (high - low) * 2 - 1: 1 of 0..4 is -0.5; beyond the limits is clipped; equal is 0
    scaled = rescaled(np.array([[1.0, 9.0, 7.0]]), [0, 0, 7], [4, 1, 7])
    assert scaled.tolist() == [[-0.5, 1.0, 0.0]]


def test_actions_without_limits_are_refused():
    with pytest.raises(ValueError, match="not finite; give low and high"):
        rescaled(np.zeros((3, 1)), [-np.inf], [np.inf])
    with pytest.raises(ValueError, match="not continuous actions"):
        rescaled(np.zeros(3), [0.0], [1.0])


def test_a_missing_package_is_asked_for_by_name():
    with pytest.raises(ImportError, match="Reading smoke needs nowhere_to_be: pip install"):
        needs("nowhere_to_be.found", "smoke")


def test_a_format_that_is_not_known_is_refused(tmp_path):
    with pytest.raises(ValueError, match=r"No format 'gif'\. There are: hdf5, lerobot"):
        open_episodes(tmp_path, "gif")
    with pytest.raises(ValueError, match="looks like none of"):
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


def test_rewards_are_left_out_unless_asked_for(tmp_path):
    save_npz(tmp_path / "0.npz", chain(5))
    assert NpzEpisodes(tmp_path, image_size=8)[0].reward is None


def test_npz_episodes_come_by_name_from_every_folder(tmp_path):
    for name, n in (("b/1", 5), ("a/2", 6), ("a/1", 7)):
        save_npz(tmp_path / f"{name}.npz", chain(n))
    assert [len(t) for t in NpzEpisodes(tmp_path, **SMALL)] == [7, 6, 5]


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
        ({"pixels": np.zeros((4, 8, 8, 3), np.uint8), "action": np.zeros((3, 2))}, "equally many"),
        ({"state": np.zeros(3)}, "holds nothing known; an episode needs 'action'"),
        ({"image": np.zeros((4, 8, 8, 3), np.uint8), "action": np.full((4, 2), 9.0)}, "rescale"),
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
        convert(episodes, tmp_path / "out")
    assert len(TrajectoryDataset.open(tmp_path / "out")) == 2
    save_npz(tmp_path / "in/2.npz", chain(7, 2))
    convert(episodes, tmp_path / "out")
    dataset = TrajectoryDataset.open(tmp_path / "out")
    assert dataset.lengths.tolist() == [5, 6, 7, 8]
    for seed, trajectory in enumerate(dataset):
        check_same(trajectory, chain(5 + seed, seed))


def test_a_dataset_of_another_source_is_not_added_to(tmp_path):
    for folder, name in (("a", "1"), ("b", "2")):
        save_npz(tmp_path / folder / f"{name}.npz", chain(5))
    convert(NpzEpisodes(tmp_path / "a", **SMALL), tmp_path / "out")
    with pytest.raises(ValueError, match="1 trajectories of another source"):
        convert(NpzEpisodes(tmp_path / "b", **SMALL), tmp_path / "out")


# SB3: the action was taken at the observation


def sb3_buffer(trajectories, size, channels_first=True, **kwargs):
    """Fills a buffer of SB3 with whole trajectories, one environment."""
    shape = (3, 8, 8) if channels_first else (8, 8, 3)
    image_space = gym.spaces.Box(0, 255, shape, np.uint8)
    buffer = SB3Buffer(size, image_space, gym.spaces.Box(-1, 1, (2,)), "cpu", **kwargs)
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
    for found, expected in zip(new, old, strict=True):
        check_same(found, expected)


def test_a_ring_that_has_gone_round_is_read_oldest_first():
    old = [chain(6, 0), chain(7, 1, terminated=True), chain(4, 2)]
    new = list(SB3Episodes(sb3_buffer(old, 13), **SMALL))
    # 17 steps in a ring of 13: the first episode has lost 4 of its 6 steps
    assert [len(trajectory) for trajectory in new] == [2, 7, 4]
    np.testing.assert_array_equal(new[0].image, old[0].image[4:])
    for found, expected in zip(new[1:], old[1:], strict=True):
        check_same(found, expected)


@pytest.mark.parametrize("size", [50, 13])
def test_a_buffer_that_saves_memory_has_lost_each_last_observation(size):
    old = [chain(6, 0, terminated=True), chain(7, 1), chain(4, 2)]
    kwargs = {"optimize_memory_usage": True, "handle_timeout_termination": False}
    new = list(SB3Episodes(sb3_buffer(old, size, **kwargs), **SMALL))
    for found in new:
        check_follows(found)
        assert not found.terminated
    np.testing.assert_array_equal(new[-2].image, old[1].image[:7])


def test_only_a_replay_buffer_of_sb3_is_read():
    with pytest.raises(ValueError, match=r"Expected a ReplayBuffer of SB3, got str"):
        SB3Episodes("replay.pkl")


# HDF5 in D4RL's manner


def save_hdf5(path, trajectories, with_next=False):
    h5py = pytest.importorskip("h5py")
    with h5py.File(path, "w") as file:
        file["observations"] = np.concatenate([t.image[:-1] for t in trajectories])
        file["actions"] = np.concatenate([3 * t.action for t in trajectories])
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
    for found, expected in zip(new, old, strict=True):
        check_same(found, expected)


def test_hdf5_without_next_observations_leaves_each_last_action_out(tmp_path):
    save_hdf5(tmp_path / "data.h5", [chain(5, 0, terminated=True), chain(1, 1), chain(7, 2)])
    one, two = open_episodes(tmp_path / "data.h5", **LIMITS, **SMALL)
    check_same(one, chain(5, 0), images=5)
    check_same(two, chain(7, 2), images=7)
    assert two.source == "data.h5 rows 6 to 12"


def test_a_damaged_or_strange_hdf5_is_named(tmp_path):
    save_hdf5(tmp_path / "data.h5", [chain(50)])
    with pytest.raises(ValueError, match=r"needs 'pixels', .* there are: actions, observations"):
        open_episodes(tmp_path / "data.h5", image_key="pixels")
    (tmp_path / "data.h5").write_bytes((tmp_path / "data.h5").read_bytes()[:3000])
    with pytest.raises(ValueError, match=r"data\.h5 is damaged or not an HDF5 file"):
        open_episodes(tmp_path / "data.h5")


# Minari, recorded with Minari itself


def record_minari(tmp_path, monkeypatch, trajectories, nested=False, **kwargs):
    minari = pytest.importorskip("minari")
    pytest.importorskip("h5py")
    from minari.data_collector import EpisodeBuffer

    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    buffers = [
        EpisodeBuffer(
            observations={"pixels": t.image} if nested else t.image,
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
        observation_space=gym.spaces.Dict({"pixels": image}) if nested else image,
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
        for found, expected in zip(new, old, strict=True):
            check_same(found, expected)
        assert new[1].source == "chain/test-v0 episode 1"


@pytest.mark.filterwarnings("ignore::UserWarning:minari")
def test_a_minari_image_key_that_is_missing_or_not_there_is_named(tmp_path, monkeypatch):
    record_minari(tmp_path, monkeypatch, [chain(9)], nested=True, jpeg_encoding=False)
    with pytest.raises(ValueError, match="give image_key, one of: pixels"):
        open_episodes("chain/test-v0", "minari", **SMALL)[0]
    with pytest.raises(ValueError, match="has no 'image'; there are: pixels"):
        open_episodes("chain/test-v0", "minari", image_key="image", **SMALL)[0]


@pytest.mark.filterwarnings("ignore::UserWarning:minari")
def test_images_that_minari_stored_as_jpeg_are_warned_of(tmp_path, monkeypatch):
    record_minari(tmp_path, monkeypatch, [chain(9, size=32)])
    with pytest.warns(UserWarning, match="as JPEG, which is lossy; record with jpeg_encoding=Fal"):
        open_episodes("chain/test-v0", "minari")


# LeRobot, files made to the published schema


def level(state):
    """The chain's states told apart after lossy video: 12 grey levels."""
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
    path.parent.mkdir(parents=True)
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=fps, options={"g": "4", "crf": "20"})
        stream.width = stream.height = 32
        stream.pix_fmt = "yuv420p"
        for state in states:
            frame = np.full((32, 32, 3), level(state), np.uint8)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")))
        container.mux(stream.encode())


@pytest.mark.parametrize("video", [True, False])
def test_lerobot_episodes_keep_to_the_chain_and_leave_each_last_action_out(tmp_path, video):
    save_lerobot(tmp_path, [6, 9, 1, 5], video)
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


def test_a_lerobot_video_that_is_too_short_is_named(tmp_path):
    states = save_lerobot(tmp_path, [6, 9])
    (tmp_path / "videos/front/chunk-000/file-000.mp4").unlink()
    (tmp_path / "videos/front/chunk-000").rmdir()
    write_video(tmp_path / "videos/front/chunk-000/file-000.mp4", states[:10], 10)
    episodes = open_episodes(tmp_path, **SMALL)
    assert len(episodes[0]) == 5
    with pytest.raises(ValueError, match=r"episode 1: .*mp4 has no frame at 1\.000 s"):
        episodes[1]


def test_an_older_lerobot_version_and_a_camera_that_is_not_there_are_named(tmp_path):
    save_lerobot(tmp_path, [6], video=False)
    with pytest.raises(ValueError, match="0 cameras for camera='back'; give one of: front"):
        open_episodes(tmp_path, camera="back")
    write_lerobot_meta(tmp_path, False, 10, version="v2.1")
    with pytest.raises(ValueError, match=r"version v2\.1; convert it to v3\.0"):
        open_episodes(tmp_path)
