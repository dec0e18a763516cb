"""HDF5, .npz and zarr files of robomimic, LIBERO, ALOHA, D4RL, V-D4RL, OGBench, Diffusion Policy.

Each is written in its program's own layout, from a known chain, and must come back as the chain.
"""

import io
import json
import resource
import shutil
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from chain import chain, follows
from PIL import Image

from wpt_agents.data.dataset import TrajectoryDataset
from wpt_agents.data.images import Resizer
from wpt_agents.data.importers.episodes import as_images
from wpt_agents.data.importers.formats import open_episodes, recognise
from wpt_agents.data.importers.rows import read_images

h5py = pytest.importorskip("h5py")
SMALL = {"image_size": 8}


def check(new, old, images=None):
    """`new` is the chain `old`, or its first `images` images."""
    np.testing.assert_array_equal(new.image, old.image[:images])
    state = new.image[:, 0, 0, 0].astype(int)
    assert (follows(state[:-1], new.action[:, 0]) == state[1:]).all()
    np.testing.assert_allclose(new.action, old.action[: len(new)], atol=1e-6)


def save_robomimic(path, trajectories, with_next=True, cameras=("agentview_image",), suffix=""):
    """data/demo_i/{actions, rewards, dones, states, obs/*, next_obs/*}; numbers without zeros."""
    with h5py.File(path, "w") as file:
        data = file.create_group("data")
        data.attrs["env_args"] = json.dumps({"env_name": "Lift", "type": 1, "env_kwargs": {}})
        for i, t in enumerate(trajectories):
            demo = data.create_group(f"demo_{i}{suffix}")
            demo["actions"] = t.action.astype(np.float64)
            demo["rewards"] = t.reward
            demo["dones"] = np.arange(len(t)) >= len(t) - 2  # robomimic flags each success
            demo["states"] = np.zeros((len(t), 32))
            demo["obs/robot0_eef_pos"] = np.zeros((len(t), 3))
            for k, camera in enumerate(cameras):
                demo[f"obs/{camera}"] = (t.image[:-1] + k).astype(np.uint8)
                if with_next:
                    demo[f"next_obs/{camera}"] = (t.image[1:] + k).astype(np.uint8)
        file["mask/train"] = np.array([b"demo_0", b"demo_10"])


@pytest.mark.parametrize("with_next", [True, False])
def test_robomimic_demos_come_in_numeric_order_and_keep_to_the_chain(tmp_path, with_next):
    old = [chain(5 + i, i) for i in range(12)]
    save_robomimic(tmp_path / "image.hdf5", old, with_next)
    new = list(open_episodes(tmp_path / "image.hdf5", **SMALL))
    assert len(new) == 12
    for episode, expected in zip(new, old, strict=True):
        check(episode, expected, None if with_next else len(expected))
    assert (new[10].source, new[10].task) == ("image.hdf5 data/demo_10", "Lift")


def test_the_main_camera_of_robomimic_is_taken_and_another_can_be_named(tmp_path):
    old = chain(6)
    cameras = ("robot0_eye_in_hand_image", "agentview_image")
    save_robomimic(tmp_path / "a.hdf5", [old], cameras=cameras)
    with pytest.warns(UserWarning, match=r"'obs/agentview_image' is used\. .*: obs/robot0"):
        [main] = open_episodes(tmp_path / "a.hdf5", **SMALL)
    np.testing.assert_array_equal(main.image, old.image + 1)
    for key in ("robot0_eye_in_hand_image", "data/demo_0/obs/robot0_eye_in_hand_image"):
        [hand] = open_episodes(tmp_path / "a.hdf5", image_key=key, **SMALL)
        check(hand, old)


def test_a_second_camera_of_an_unusual_name_is_named_but_depths_are_not(tmp_path):
    save_robomimic(tmp_path / "a.hdf5", [chain(6)], cameras=("agentview_image", "eye_in_hand"))
    with h5py.File(tmp_path / "a.hdf5", "a") as file:
        file["data/demo_0/obs/agentview_depth"] = np.zeros((6, 8, 8, 1), np.float32)
    with pytest.warns(UserWarning, match=r"'obs/agentview_image' is used\. .*: obs/eye_in_hand$"):
        open_episodes(tmp_path / "a.hdf5", **SMALL)


def test_libero_names_its_task_in_words(tmp_path):
    save_robomimic(tmp_path / "a.hdf5", [chain(5)], False, ("agentview_rgb",))
    with h5py.File(tmp_path / "a.hdf5", "a") as file:
        problem = {"language_instruction": "put the bowl on the plate"}
        file["data"].attrs["problem_info"] = json.dumps(problem)
    [new] = open_episodes(tmp_path / "a.hdf5", **SMALL)
    assert new.task == "put the bowl on the plate"
    [named] = open_episodes(tmp_path / "a.hdf5", task="bowl", **SMALL)
    assert named.task == "bowl"


def test_aloha_has_a_file_an_episode(tmp_path):
    old = [chain(5 + i, i, action_dim=14) for i in range(3)]
    for i, t in enumerate(old):
        with h5py.File(tmp_path / f"episode_{i}.hdf5", "w") as file:
            file.attrs["sim"] = True
            file["action"] = t.action
            file["observations/qpos"] = np.zeros((len(t), 14))
            file["observations/images/top"] = t.image[:-1]
    assert recognise(tmp_path) == "hdf5"
    for episode, expected in zip(open_episodes(tmp_path, **SMALL), old, strict=True):
        check(episode, expected, len(expected))
    [one] = open_episodes(tmp_path / "episode_1.hdf5", **SMALL)
    check(one, old[1], len(old[1]))


def test_files_of_several_formats_in_a_folder_are_not_left_out_in_silence(tmp_path):
    save_robomimic(tmp_path / "a.hdf5", [chain(5)], False, ("agentview_rgb",))
    np.savez(tmp_path / "b.npz", image=chain(5).image)
    np.savez(tmp_path / "c.npz", image=chain(5).image)
    with pytest.warns(UserWarning, match="of format hdf5 are read, and 2 of format npz are left"):
        assert recognise(tmp_path) == "hdf5"


def as_files(images, kind):
    """Encodes each image; PNG for exact colours, JPEG as ALOHA does."""
    streams = [io.BytesIO() for _ in images]
    for image, stream in zip(images, streams, strict=True):
        Image.fromarray(image).save(stream, kind, quality=95)
    return [np.frombuffer(stream.getvalue(), np.uint8) for stream in streams]


def test_files_of_an_image_or_none_are_left_out(tmp_path):
    old = chain(5)
    for i, length in enumerate((0, 5, 1)):
        arrays = {"action": old.action[:length], "observations/images/top": old.image[:length]}
        save(tmp_path / f"episode_{i}.hdf5", arrays)
    with pytest.warns(UserWarning, match="2 episodes of a single image left out"):
        [new] = open_episodes(tmp_path, **SMALL)
    check(new, old, 5)


@pytest.mark.parametrize("padded", [True, False], ids=["ALOHA", "RoboMIND"])
def test_compressed_images_of_aloha_are_decoded(tmp_path, padded):
    old = [chain(5 + i, i, action_dim=14) for i in range(2)]
    for i, t in enumerate(old):
        red = t.image[:-1] * np.array([1, 0, 0], np.uint8)
        files = as_files(t.image[:-1], "PNG"), as_files(red, "JPEG")
        longest = max(len(file) for file in (*files[0], *files[1]))
        with h5py.File(tmp_path / f"episode_{i}.hdf5", "w") as file:
            file.attrs["compress"] = True
            file["action"] = t.action
            file["compress_len"] = np.array([[len(file) for file in part] for part in files])
            for camera, part in zip(("cam_high", "cam_low"), files, strict=True):
                name = f"observations/images/{camera}"
                if padded:
                    file[name] = np.stack([np.pad(f, (0, longest - len(f))) for f in part])
                    continue
                file.create_dataset(name, (len(part),), dtype=h5py.vlen_dtype(np.uint8))
                for k, one in enumerate(part):
                    file[name][k] = one
    with pytest.raises(ValueError, match="images in: observations/images/cam_high, "):
        open_episodes(tmp_path, **SMALL)
    new = open_episodes(tmp_path, image_key="cam_high", **SMALL)
    for episode, expected in zip(new, old, strict=True):
        check(episode, expected, len(expected))
    jpeg = open_episodes(tmp_path, image_key="cam_low", **SMALL)[0].image.astype(int)
    assert np.abs(jpeg[..., 0] - old[0].image[:-1, ..., 0]).max() < 8
    assert jpeg[..., 2].max() < 8  # red stays red


def test_images_are_read_in_parts_and_black_ones_are_black_in_floats_too():
    old = chain(200)
    image = old.image.astype(np.float32)
    image[64:128] = 0  # a part that does not say whether 1 or 255 is white
    read = []

    class Rows:
        shape = image.shape

        def __getitem__(self, chosen):
            read.append(chosen.stop - chosen.start)
            return image[chosen]

    pieces = [(Rows(), 1, 200), (Rows(), 200, 201)]
    for chunks, rows_at_once in ((None, 64), ((10, 8, 8, 3), 64), ((100, 8, 8, 3), 100)):
        Rows.chunks = chunks
        read.clear()
        seen = read_images(pieces, lambda part: as_images(part, Resizer(8)))
        np.testing.assert_array_equal(seen, image[1:])
        assert sum(read) == 200 and max(read) == rows_at_once


def test_a_damaged_file_of_an_image_is_named(tmp_path):
    old = chain(5)
    files = as_files(old.image[:-1], "PNG")
    images = np.stack([np.pad(file, (0, 200 - len(file))) for file in files])
    images[3] = 0
    path = save(tmp_path / "a.hdf5", {"action": old.action, "observations/images/top": images})
    with pytest.raises(ValueError, match=r"a\.hdf5: one of its images is damaged: cannot identify"):
        open_episodes(path, **SMALL)[0]


def test_groups_with_an_observation_more_than_actions_keep_every_action(tmp_path):
    old = [chain(5, 0), chain(1, 1)]  # as ManiSkill's traj_0/obs/sensor_data/...
    with h5py.File(tmp_path / "a.h5", "w") as file:
        for i, t in enumerate(old):
            file[f"traj_{i}/actions"] = t.action
            file[f"traj_{i}/obs/sensor_data/base_camera/rgb"] = t.image
            file[f"traj_{i}/terminated"] = np.arange(len(t)) == len(t) - 1
    for episode, expected in zip(
        open_episodes(tmp_path / "a.h5", image_key="rgb", **SMALL), old, strict=True
    ):
        check(episode, expected)
        assert episode.terminated


def test_a_reward_for_each_image_is_refused_as_it_may_be_shifted(tmp_path):
    old = chain(5)
    path = tmp_path / "a.h5"
    arrays = {"actions": old.action, "observations": old.image, "rewards": np.arange(6.0)}
    save(path, arrays)
    assert open_episodes(path, **SMALL)[0].reward is None  # rewards are not asked for
    with pytest.raises(ValueError, match=r"of shape \(5,\), got \(6,\)"):
        open_episodes(path, rewards=True, **SMALL)[0]


def rows(trajectories, image="observations", action="actions"):
    return {
        image: np.concatenate([t.image[:-1] for t in trajectories]),
        action: np.concatenate([t.action for t in trajectories]),
    }


def last(trajectories):
    return np.concatenate([np.arange(len(t)) == len(t) - 1 for t in trajectories])


def save(path, arrays):
    with h5py.File(path, "w") as file:
        for name, array in arrays.items():
            file[name] = array
    return path


def test_the_return_of_an_episode_is_no_reward_of_a_step(tmp_path):
    arrays = rows([chain(5)]) | {"dones": last([chain(5)]), "reward": 3.0}
    (episode,) = open_episodes(save(tmp_path / "in.hdf5", arrays), image_size=8)
    assert len(episode) == 4
    with pytest.raises(ValueError, match=r"in\.hdf5 rows 0 to 4: "):
        open_episodes(tmp_path / "in.hdf5", image_size=8, rewards=True)[0]


@pytest.mark.parametrize(
    "flags",
    [
        {"terminals": 0, "timeouts": 1},
        {"terminations": 0, "truncations": 1},
        {"terminated": 1, "truncated": 0},
        {"dones": 1},
        {"done": 1},
    ],
    ids=lambda flags: "-".join(flags),
)
def test_flat_rows_end_where_any_of_the_usual_flags_says(tmp_path, flags):
    old = [chain(5, 0), chain(7, 1), chain(2, 2)]
    arrays = rows(old) | {name: last(old) * on for name, on in flags.items()}
    new = list(open_episodes(save(tmp_path / "a.hdf5", arrays), **SMALL))
    for episode, expected in zip(new, old, strict=True):
        check(episode, expected, len(expected))


@pytest.mark.parametrize("flags", ["terminations", "dones", "step_type", "episode_ends"])
@pytest.mark.parametrize("suffix", ["h5", "npz"])
def test_one_episode_with_flags_and_an_image_more_than_actions_is_whole(tmp_path, flags, suffix):
    old = chain(5, 0, terminated=flags == "terminations")
    over = {"step_type": 2 * last([old]), "episode_ends": [5]}.get(flags, last([old]))
    arrays = {"observations": old.image, "actions": old.action, flags: np.asarray(over)}
    path = tmp_path / f"a.{suffix}"
    np.savez(path, **arrays) if suffix == "npz" else save(path, arrays)
    [new] = open_episodes(path, **SMALL)
    check(new, old)
    assert new.terminated == old.terminated
    arrays[flags] = np.array([3, 5] if flags == "episode_ends" else [0, 2, 0, 0, 2])
    np.savez(path, **arrays) if suffix == "npz" else save(path, arrays)
    with pytest.raises(ValueError, match="in files of many episodes they must be equally many"):
        open_episodes(path, **SMALL)


def test_rows_of_one_episode_are_read_once_the_file_says_so(tmp_path):
    old = chain(6)
    path = save(tmp_path / "a.hdf5", rows([old]))
    with pytest.raises(ValueError, match=r"add the array episode_ends = \[6\] to the file"):
        open_episodes(path, **SMALL)
    with h5py.File(path, "a") as file:
        file["episode_ends"] = [6]
    check(open_episodes(path, **SMALL)[0], old, 6)


def test_groups_beside_numbered_ones_are_episodes_or_named(tmp_path):
    old = [chain(5, 0), chain(7, 1), chain(6, 2)]
    with h5py.File(tmp_path / "a.hdf5", "w") as file:
        for name, t in zip(("1f", "a2", "bc"), old, strict=True):  # hexadecimal numbers
            file[f"data/{name}/actions"] = t.action
            file[f"data/{name}/obs/agentview_image"] = t.image[:-1]
        file["data/d3/obs/agentview_image"] = t.image  # broken off
        file["mask/e5/train"] = np.arange(3)
    with pytest.warns(
        UserWarning, match="1 groups of images without actions are left out, data/d3"
    ):
        new = list(open_episodes(tmp_path / "a.hdf5", **SMALL))
    for episode, expected in zip(new, old, strict=True):
        check(episode, expected, len(expected))


def test_an_empty_demo_of_robomimic_is_left_out(tmp_path):
    with h5py.File(tmp_path / "a.hdf5", "w") as file:
        for i, t in enumerate([chain(5, 0), chain(5, 1)]):
            rows = len(t) * (i == 0)
            file[f"data/demo_{i}/actions"] = t.action[:rows]
            file[f"data/demo_{i}/obs/agentview_image"] = t.image[:rows]
            file[f"data/demo_{i}/next_obs/agentview_image"] = t.image[1 : rows + 1]
    with pytest.warns(UserWarning, match="1 episode of a single image left out"):
        [new] = open_episodes(tmp_path / "a.hdf5", **SMALL)
    check(new, chain(5, 0))


def test_a_damaged_chunk_of_hdf5_is_named_and_can_be_skipped(tmp_path):
    old = [chain(5, 0), chain(7, 1), chain(6, 2)]
    path = tmp_path / "a.hdf5"
    with h5py.File(path, "w") as file:
        for i, t in enumerate(old):
            file[f"data/demo_{i}/actions"] = t.action
            images = file.create_dataset(
                f"data/demo_{i}/obs/agentview_image", data=t.image[:-1], compression="gzip"
            )
            if i == 1:
                chunk = images.id.get_chunk_info(0)
    content = bytearray(path.read_bytes())
    content[chunk.byte_offset : chunk.byte_offset + chunk.size] = bytes(chunk.size)
    path.write_bytes(content)
    remedy = r"a\.hdf5 data/demo_1 cannot be read: .*hdf5plugin.* skip=\[1\]"
    with pytest.raises(ValueError, match=remedy):
        TrajectoryDataset.from_hdf5(path, tmp_path / "out", **SMALL)
    data = TrajectoryDataset.from_hdf5(path, tmp_path / "out", skip=[1], **SMALL)
    assert data.lengths.tolist() == [4, 5]


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="reads /proc, which Linux has")
def test_reading_many_demos_takes_the_memory_of_one(tmp_path):
    """HDF5 keeps chunks of every array that is open: 4.8 MB of each of these."""
    images = np.zeros((60, 84, 84, 3), np.uint8)
    images[:] = np.arange(84, dtype=np.uint8)[:, None, None]
    with h5py.File(tmp_path / "a.hdf5", "w") as file:
        for i in range(40):
            file[f"data/demo_{i}/actions"] = np.full((60, 2), 0.5)
            demo = file[f"data/demo_{i}"]
            demo.create_dataset("obs/agentview_image", data=images, chunks=(1, 84, 84, 3))
    episodes = open_episodes(tmp_path / "a.hdf5", image_size=84)
    for i in range(5):
        np.testing.assert_array_equal(episodes[i].image, images)
    before = resident()
    for i in range(5, 40):
        assert len(episodes[i]) == 59
    assert resident() - before < 40  # MiB


def resident():
    """The memory of this process in MiB."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 2**20


def test_empty_arrays_and_texts_in_hdf5_do_no_harm(tmp_path):
    save_robomimic(tmp_path / "a.hdf5", [chain(5)])
    with h5py.File(tmp_path / "a.hdf5", "a") as file:
        file["data/demo_0/note"] = h5py.Empty("f")
        file["data/demo_0/obs/words"] = ["lift"] * 5
        file["data/demo_0/obs/fixed"] = np.array([b"lift"] * 5)
        file["data/demo_0/scalar"] = 3
    check(open_episodes(tmp_path / "a.hdf5", **SMALL)[0], chain(5))


def test_links_in_hdf5_are_followed_and_a_broken_one_is_named(tmp_path):
    old = [chain(5, 0), chain(7, 1)]
    save_robomimic(tmp_path / "b.hdf5", old)
    with h5py.File(tmp_path / "a.hdf5", "w") as file:
        for i in range(2):
            file[f"data/demo_{i}"] = h5py.ExternalLink("b.hdf5", f"/data/demo_{1 - i}")
        file["data/demo_2"] = h5py.SoftLink("/data/demo_0")
        file["data/all"] = h5py.SoftLink("/")
    new = list(open_episodes(tmp_path / "a.hdf5", **SMALL))
    for episode, expected in zip(new, [old[1], old[0], old[1]], strict=True):
        check(episode, expected)
    (tmp_path / "b.hdf5").unlink()
    with pytest.raises(ValueError, match=r"a\.hdf5: the link 'demo_0' in '/data' leads nowhere"):
        open_episodes(tmp_path / "a.hdf5", **SMALL)


def test_the_flag_of_a_terminal_state_in_groups_is_named_by_done_key(tmp_path):
    save_robomimic(tmp_path / "a.hdf5", [chain(5)])
    for key, over in ((None, False), ("dones", True), ("data/demo_0/dones", True)):
        [new] = open_episodes(tmp_path / "a.hdf5", done_key=key, **SMALL)
        assert new.terminated == over
    with pytest.raises(ValueError, match="in data/demo_0: there is no array 'over'; there are: "):
        open_episodes(tmp_path / "a.hdf5", done_key="over", **SMALL)


def test_a_flag_of_another_name_is_named_by_done_key(tmp_path):
    old = [chain(5, 0), chain(7, 1)]
    path = save(tmp_path / "a.hdf5", rows(old) | {"episode_over": last(old)})
    with pytest.raises(ValueError, match=r"nothing says where episodes end.* done_key"):
        open_episodes(path, **SMALL)
    new = open_episodes(path, done_key="episode_over", **SMALL)
    assert [len(t) for t in new] == [4, 6]
    with pytest.raises(ValueError, match="no array 'over'; there are: actions, episode_over"):
        open_episodes(path, done_key="over", **SMALL)


def test_the_companion_of_nested_images_gives_the_last_observation(tmp_path):
    old = [chain(5, 0), chain(7, 1)]
    arrays = rows(old, "observations/image") | {
        "terminals": last(old),
        "next_observations/image": np.concatenate([t.image[1:] for t in old]),
    }
    path = save(tmp_path / "a.hdf5", arrays)
    with pytest.raises(ValueError, match="no usual name; there are images in: observations/image"):
        open_episodes(path, **SMALL)
    for episode, expected in zip(
        open_episodes(path, image_key="observations/image", **SMALL), old, strict=True
    ):
        check(episode, expected)
        assert episode.terminated


def save_dm_env(path, trajectories, first=0.0):
    """V-D4RL's: row t holds the action that led to observation t; step types 0, 1 and 2."""
    blank = np.full((1, 2), first, np.float32)
    return save(
        path,
        {
            "observation": np.concatenate([t.image for t in trajectories]),
            "action": np.concatenate([np.concatenate([blank, t.action]) for t in trajectories]),
            "reward": np.concatenate([[0, *t.reward] for t in trajectories]),
            "discount": np.concatenate([[1] * len(t) + [not t.terminated] for t in trajectories]),
            "step_type": np.concatenate([[0] + [1] * (len(t) - 1) + [2] for t in trajectories]),
        },
    )


def test_rows_of_dm_env_are_shifted_back(tmp_path):
    old = [chain(5, 0, terminated=True), chain(7, 1)]
    path = save_dm_env(tmp_path / "a.hdf5", old)
    for episode, expected in zip(open_episodes(path, rewards=True, **SMALL), old, strict=True):
        check(episode, expected)
        np.testing.assert_allclose(episode.reward, expected.reward)
        assert episode.terminated == expected.terminated


def test_rows_of_step_types_without_placeholders_are_asked_about(tmp_path):
    path = save_dm_env(tmp_path / "a.hdf5", [chain(5, 0)], first=0.5)
    with pytest.raises(ValueError, match=r"first action of an episode is zero.* shifted=True if"):
        open_episodes(path, **SMALL)
    check(open_episodes(path, shifted=True, **SMALL)[0], chain(5, 0))
    unshifted = open_episodes(path, shifted=False, **SMALL)[0]
    assert unshifted.action[0].tolist() == [0.5, 0.5]


def save_dreamer(path, trajectories, marked=True):
    """PyDreamer's: row t holds the action that led to image t, and whether image t is terminal."""
    rows = [len(t) + 1 for t in trajectories]
    blank = np.zeros((1, 2), np.float32)
    arrays = {
        "image": np.concatenate([t.image for t in trajectories]),
        "action": np.concatenate([a for t in trajectories for a in (blank, t.action)]),
        "reward": np.concatenate([[0, *t.reward] for t in trajectories]),
        "terminal": np.concatenate([np.arange(n) == n - 1 for n in rows]),
    }
    reset = {"reset": np.concatenate([np.arange(n) == 0 for n in rows])}
    np.savez(path, **arrays, **(reset if marked else {}))


def test_rows_of_dreamer_are_shifted_back(tmp_path):
    old = [chain(5, 0, terminated=True), chain(7, 1, terminated=True)]
    save_dreamer(tmp_path / "a.npz", old)
    for new, expected in zip(open_episodes(tmp_path, rewards=True, **SMALL), old, strict=True):
        check(new, expected)
        np.testing.assert_allclose(new.reward, expected.reward)
        assert new.terminated


def test_a_part_of_a_dreamer_episode_is_asked_about(tmp_path):
    save_dreamer(tmp_path / "a.npz", [chain(9, 0, terminated=True)])
    with np.load(tmp_path / "a.npz") as whole:
        arrays = {name: whole[name][3:] for name in whole.files}
    np.savez(tmp_path / "a.npz", **arrays)
    with pytest.raises(ValueError, match=r"no row is marked as the first.* \(reset\): pass shift"):
        open_episodes(tmp_path, **SMALL)
    [new] = open_episodes(tmp_path, shifted=True, **SMALL)
    np.testing.assert_array_equal(new.action, chain(9, 0).action[3:])


@pytest.mark.parametrize("mark", ["is_first", "step_type"])
def test_an_episode_that_broke_off_ends_where_the_next_begins(tmp_path, mark):
    old = [chain(5, 0), chain(7, 1, terminated=True), chain(6, 2)]
    path = save_dm_env(tmp_path / "a.hdf5", old)
    with h5py.File(path, "a") as file:
        types = file["step_type"][:]
        types[5] = 1  # the last step of the first episode is no end
        types[-1] = 1
        del file["step_type"]
        file[mark] = types == 0 if mark == "is_first" else types
        if mark == "is_first":
            file["terminals"] = types == 2
    new = open_episodes(path, **SMALL)
    for episode, expected in zip(new, old, strict=True):
        check(episode, expected)
        assert episode.terminated == expected.terminated


def test_files_of_dreamers_rows_are_shifted_back_and_cut_where_episodes_begin(tmp_path):
    old = [chain(5, 0, terminated=True), chain(7, 1), chain(6, 2)]
    blank = np.zeros((1, 2), np.float32)
    for name, part in (("0.h5", old[:1]), ("1.h5", old[1:])):
        arrays = {
            "image": np.concatenate([t.image for t in part]),
            "action": np.concatenate([a for t in part for a in (blank, t.action)]),
            "is_first": np.concatenate([np.arange(len(t) + 1) == 0 for t in part]),
            "is_terminal": np.concatenate(
                [t.terminated * (np.arange(len(t) + 1) == len(t)) for t in part]
            ),
        }
        save(tmp_path / name, arrays)
    for source, expected in ((tmp_path, old), (tmp_path / "0.h5", old[:1])):
        for episode, t in zip(open_episodes(source, **SMALL), expected, strict=True):
            check(episode, t)
            assert episode.terminated == t.terminated


def test_rows_whose_episodes_all_begin_with_a_zero_action_are_questioned(tmp_path, recwarn):
    old = [chain(5, 0), chain(7, 1)]
    save_dreamer(tmp_path / "a.npz", old, marked=False)
    with pytest.warns(UserWarning, match=r"first action of every episode is zero.* shifted=True"):
        assert len(open_episodes(tmp_path, **SMALL)) == 2
    recwarn.clear()
    for new, expected in zip(open_episodes(tmp_path, shifted=True, **SMALL), old, strict=True):
        check(new, expected)
    taken = open_episodes(tmp_path, shifted=False, **SMALL)[0]
    assert not taken.action[0].any()
    assert not recwarn


def test_the_timing_of_step_types_can_be_told_for_npz_too(tmp_path):
    old = chain(5, 0)
    steps = {"action": old.action, "step_type": [0, 1, 1, 1, 2]}
    np.savez(tmp_path / "a.npz", observation=old.image[:-1], **steps)
    with pytest.raises(ValueError, match="shifted=True if"):
        open_episodes(tmp_path / "a.npz", **SMALL)
    check(open_episodes(tmp_path / "a.npz", shifted=False, **SMALL)[0], old, 5)


def test_actions_in_several_arrays_are_put_side_by_side_in_the_order_of_the_keys(tmp_path):
    old = chain(5, 0)
    arrays = {
        "observations": old.image[:-1],
        "action/arm": old.action[:, 0],  # one number a step
        "action/gripper": old.action[:, 1:],
        "terminals": last([old]),
    }
    path = save(tmp_path / "a.hdf5", arrays)
    with pytest.raises(ValueError, match="action_key, one or several of: action/arm, action/gr"):
        open_episodes(path, **SMALL)
    for key in (["action/arm", "action/gripper"], "action/arm, action/gripper"):
        check(open_episodes(path, action_key=key, **SMALL)[0], old, 5)
    [swapped] = open_episodes(path, action_key="gripper,arm", **SMALL)
    np.testing.assert_array_equal(swapped.action[:, ::-1], old.action[:4])


def test_a_wrong_name_of_actions_in_groups_is_refused_with_the_names_of_one_group(tmp_path):
    save_robomimic(tmp_path / "a.hdf5", [chain(5, i) for i in range(3)], with_next=False)
    message = r"in data/demo_0: there is no array 'action' of actions; there are: actions, dones"
    with pytest.raises(ValueError, match=message):
        open_episodes(tmp_path / "a.hdf5", action_key="action", **SMALL)


def test_unusual_names_of_actions_in_groups_are_asked_for_besides_the_images(tmp_path):
    old = [chain(5 + i, i) for i in range(3)]
    names = {f"data/demo_{i}/obs/agentview_image": t.image for i, t in enumerate(old)}
    names |= {f"data/demo_{i}/joints": t.action for i, t in enumerate(old)}
    path = save(tmp_path / "a.hdf5", names)
    with pytest.raises(ValueError, match=r"pass image_key .* pass action_key, .*demo_0/joints"):
        open_episodes(path, **SMALL)
    for new, expected in zip(open_episodes(path, action_key="joints", **SMALL), old, strict=True):
        check(new, expected)


def test_a_folder_of_hdf5_files_is_read_in_numeric_order(tmp_path):
    for i in (0, 2, 10):
        old = [chain(5 + i, i)]
        save(tmp_path / f"part_{i}.h5", rows(old) | {"terminals": last(old)})
    assert [len(t) for t in open_episodes(tmp_path, **SMALL)] == [4, 6, 14]


# OGBench: rows in an .npz


def save_ogbench(path, trajectories):
    """Rows of T + 1 observations; the action of an episode's last row means nothing."""
    pad = np.full((1, 2), 0.9, np.float32)
    np.savez_compressed(
        path,
        observations=np.concatenate([t.image for t in trajectories]),
        actions=np.concatenate([np.concatenate([t.action, pad]) for t in trajectories]),
        terminals=np.concatenate([np.arange(len(t) + 1) == len(t) for t in trajectories]),
        qpos=np.zeros((sum(len(t) + 1 for t in trajectories), 9)),
    )


def test_ogbench_rows_are_read_in_any_order(tmp_path):
    old = [chain(5, 0), chain(70, 1), chain(3, 2)]
    save_ogbench(tmp_path / "visual-cube-single-play-v0.npz", old)
    for source in (tmp_path, tmp_path / "visual-cube-single-play-v0.npz"):
        assert recognise(source) == "npz"
        episodes = open_episodes(source, **SMALL)
        for i in (0, 1, 2, 1, 0):
            check(episodes[i], old[i])


def test_rows_in_npz_may_be_transposed_and_beside_objects(tmp_path):
    old = chain(5)
    actions = np.asfortranarray(old.action)  # as np.stack([x, y]).T is
    info = np.array({"robot": "arm"}, object)
    over = last([old])
    path = tmp_path / "a.npz"
    np.savez(path, observations=old.image[:-1], actions=actions, terminals=over, info=info)
    check(open_episodes(path, **SMALL)[0], old, 5)


def test_a_damaged_npz_of_rows_is_named(tmp_path):
    save_ogbench(tmp_path / "a.npz", [chain(50)])
    content = bytearray((tmp_path / "a.npz").read_bytes())
    content[200:260] = bytes(60)
    (tmp_path / "a.npz").write_bytes(content)
    with pytest.raises(ValueError, match=r"a\.npz"):
        open_episodes(tmp_path, "npz", **SMALL)[0]


def test_npz_files_that_are_no_episodes_are_skipped_with_a_warning(tmp_path):
    np.savez(tmp_path / "evaluations.npz", timesteps=np.arange(3), results=np.zeros((3, 5)))
    save_ogbench(tmp_path / "a.npz", [chain(5)])
    with pytest.warns(UserWarning, match=r"1 \.npz files without actions .* skipped, eva"):
        assert len(open_episodes(tmp_path, **SMALL)) == 1


def test_npz_keys_can_be_named(tmp_path):
    old = chain(5)
    action = np.concatenate([np.zeros((1, 2), np.float32), old.action])
    np.savez(
        tmp_path / "a.npz", rgb=old.image, arm=action[:, :1], hand=action[:, 1], over=[0] * 5 + [1]
    )
    keys = {"image_key": "rgb", "action_key": "arm,hand", "done_key": "over"}
    [new] = open_episodes(tmp_path, **keys, **SMALL)
    check(new, old)
    assert new.terminated


# Diffusion Policy: zarr


def save_zarr(path, trajectories, dtype=np.uint8, version=2):
    """data/img as floats in 0 .. 255 (PushT), data/action, meta/episode_ends."""
    zarr = pytest.importorskip("zarr")
    group = zarr.open_group(str(path), mode="w", zarr_format=version)
    arrays = {
        "data/img": np.concatenate([t.image[:-1] for t in trajectories]).astype(dtype),
        "data/action": np.concatenate([256 + 256 * t.action for t in trajectories]),
        "data/state": np.zeros((sum(map(len, trajectories)), 5), np.float32),
        "meta/episode_ends": np.cumsum([len(t) for t in trajectories]),
    }
    for name, array in arrays.items():
        group.create_array(name, data=array)


@pytest.mark.parametrize(("dtype", "version"), [(np.float32, 2), (np.uint8, 3)])
def test_zarr_rows_end_at_episode_ends(tmp_path, dtype, version):
    old = [chain(5, 0), chain(7, 1), chain(2, 2)]
    save_zarr(tmp_path / "pusht.zarr", old, dtype, version)
    assert recognise(tmp_path / "pusht.zarr") == "zarr"
    with pytest.raises(ValueError, match=r"dimension . runs from .* low=\[.*\], high=\[.*--low="):
        open_episodes(tmp_path / "pusht.zarr", **SMALL)[0]
    new = list(open_episodes(tmp_path / "pusht.zarr", low=0, high=512, **SMALL))
    for episode, expected in zip(new, old, strict=True):
        check(episode, expected, len(expected))
    assert new[0].bounds.tolist() == [[0, 0], [512, 512]]


def test_rows_after_the_last_episode_end_are_left_out(tmp_path):
    old = [chain(5, 0), chain(7, 1), chain(9, 2)]
    arrays = rows(old) | {"episode_ends": np.array([5, 12])}
    with pytest.warns(UserWarning, match="The 9 rows after the last of 'episode_ends' belong to"):
        new = list(open_episodes(save(tmp_path / "a.hdf5", arrays), **SMALL))
    assert [len(episode) for episode in new] == [4, 6]


def test_a_zarr_group_that_is_damaged_is_named(tmp_path):
    save_zarr(tmp_path / "a.zarr", [chain(5)], version=3)
    (tmp_path / "a.zarr" / "zarr.json").write_text("{")
    with pytest.raises(ValueError, match=r"a\.zarr cannot be read as a zarr group"):
        open_episodes(tmp_path / "a.zarr", "zarr")


@pytest.mark.parametrize("array", ["img", "episode_ends"])
def test_a_zip_of_a_zarr_group_that_is_damaged_is_named(tmp_path, array):
    save_zarr(tmp_path / "a.zarr", [chain(5), chain(6)], version=3)
    path = Path(shutil.make_archive(str(tmp_path / "a.zarr"), "zip", tmp_path / "a.zarr"))
    with zipfile.ZipFile(path) as archive:
        chunks = [i for i in archive.infolist() if f"/{array}/c/" in i.filename and i.file_size]
    content = bytearray(path.read_bytes())
    content[chunks[0].header_offset + 30 + len(chunks[0].filename) + 9] ^= 255
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"a\.zarr\.zip.* cannot be read: "):
        open_episodes(path, low=0, high=512, **SMALL)[0]


# TD-MPC2: torch


def save_tdmpc2(path, trajectories, pickled=False):
    """(E, T + 1, ...), the first action NaN."""
    import torch

    nan = np.full((1, 2), np.nan, np.float32)
    images = np.stack([t.image.transpose(0, 3, 1, 2) for t in trajectories])
    actions = np.stack([np.concatenate([nan, t.action]) for t in trajectories])
    content = {"obs": torch.from_numpy(images), "action": torch.from_numpy(actions)}
    torch.save(content | ({"made": Made()} if pickled else {}), path)


class Made:
    """Something that only a pickle can hold."""


def test_tdmpc2_actions_lead_to_the_observation_and_are_shifted_back(tmp_path):
    old = [chain(5, 0), chain(5, 1)]
    save_tdmpc2(tmp_path / "chunk_0.pt", old)
    save_tdmpc2(tmp_path / "chunk_1.pt", [replace(old[0], action=old[0].action)])
    new = list(open_episodes(tmp_path, "tdmpc2", **SMALL))
    for episode, expected in zip(new, [*old, old[0]], strict=True):
        check(episode, expected)


def test_a_first_action_of_tdmpc2_that_is_no_placeholder_is_asked_about(tmp_path):
    import torch

    old = chain(5)
    content = {"obs": torch.from_numpy(old.image[None, :-1])}
    content["action"] = torch.from_numpy(old.action[None])
    torch.save(content, tmp_path / "a.pt")
    with pytest.raises(ValueError, match=r"a\.pt episode 0: .*pass shifted=True if it did"):
        open_episodes(tmp_path / "a.pt", "tdmpc2", **SMALL)[0]
    check(open_episodes(tmp_path / "a.pt", "tdmpc2", shifted=False, **SMALL)[0], old, 5)
    content["obs"] = torch.from_numpy(old.image[None])  # an image more than actions
    torch.save(content, tmp_path / "a.pt")
    check(open_episodes(tmp_path / "a.pt", "tdmpc2", **SMALL)[0], old)


def test_a_pickle_of_tdmpc2_is_loaded_by_those_who_trust_it_only(tmp_path):
    save_tdmpc2(tmp_path / "chunk_0.pt", [chain(5)], pickled=True)
    with pytest.raises(ValueError, match=r"pickle of more than tensors .*trust=True \(--trust\)"):
        open_episodes(tmp_path / "chunk_0.pt", "tdmpc2", **SMALL)
    check(open_episodes(tmp_path / "chunk_0.pt", "tdmpc2", trust=True, **SMALL)[0], chain(5))


def test_nonsense_is_not_called_a_pickle_where_pickles_are_trusted(tmp_path):
    (tmp_path / "junk.pt").write_bytes(b"abc")
    with pytest.raises(ValueError, match=r"junk\.pt cannot be read by torch\.load"):
        open_episodes(tmp_path / "junk.pt", "tdmpc2", trust=True, **SMALL)


def test_states_of_tdmpc2_are_refused_as_states(tmp_path):
    import torch

    torch.save({"obs": torch.zeros(4, 11, 24), "action": torch.zeros(4, 11, 6)}, tmp_path / "a.pt")
    with pytest.raises(ValueError, match=r"are \(11, 24\) float32, .*render the states"):
        open_episodes(tmp_path / "a.pt", "tdmpc2")[0]


def test_a_door_for_each_format_converts(tmp_path):
    old = [chain(5, 0)]
    save_robomimic(tmp_path / "a.hdf5", old)
    save_zarr(tmp_path / "b.zarr", old)
    save_tdmpc2(tmp_path / "c.pt", old)
    for form, name, options in (
        ("hdf5", "a.hdf5", {}),
        ("zarr", "b.zarr", {"low": 0, "high": 512}),
        ("tdmpc2", "c.pt", {}),
    ):
        door = getattr(TrajectoryDataset, f"from_{form}")
        dataset = door(tmp_path / name, tmp_path / form, **options, **SMALL)
        np.testing.assert_allclose(dataset[0].action, old[0].action[: len(dataset[0])], atol=1e-6)
