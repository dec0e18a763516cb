import copy
import gc
import json
import os
import pickle
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from io import FileIO

import numpy as np
import pytest
import torch
from chain import chain, check_chain, tensors

from wpt_agents.data import shards
from wpt_agents.data.dataset import TrajectoryDataset
from wpt_agents.data.replay import ReplayBuffer
from wpt_agents.data.trajectory import Trajectory


def test_a_dataset_with_threads_or_a_writer_can_be_copied_and_pickled(tmp_path):
    with TrajectoryDataset.create(tmp_path / "a", image_size=8, workers=2) as dataset:
        dataset.append(chain(20))
        dataset.sample(2, 4)  # starts the threads
        for other in (copy.deepcopy(dataset), pickle.loads(pickle.dumps(dataset))):
            assert other.workers == 2
            check_chain(other.sample(2, 4))
            with pytest.raises(ValueError, match="written to by another process"):
                other.append(chain(3))
        dataset.append(chain(5))


def made(path, *trajectories, **kwargs):
    with TrajectoryDataset.create(path, image_size=8, **kwargs) as dataset:
        for trajectory in trajectories:
            dataset.append(trajectory)
    return TrajectoryDataset.open(path)


def rng(seed=0):
    return np.random.default_rng(seed)


def flip_bit(file, at):
    content = bytearray(file.read_bytes())
    content[at] ^= 1
    file.write_bytes(content)


@pytest.mark.parametrize("codec", ["zstd", "raw"])
@pytest.mark.parametrize("length", [1, 14, 15, 16, 17, 40])
def test_a_trajectory_comes_back_as_it_was(tmp_path, codec, length):
    labels = {"terminated": True, "embodiment": "walker", "task": "run", "source": "ours"}
    old = chain(length, **labels)
    new = made(tmp_path, chain(3), old, codec=codec)[1]
    for name, value in vars(old).items():
        np.testing.assert_array_equal(getattr(new, name), value)


def test_a_disk_may_read_less_than_it_is_asked_for(tmp_path, monkeypatch):
    class Slow(FileIO):
        def read(self, size=-1):
            return super().read(min(size, 1000))

    old = chain(70, size=8)
    with TrajectoryDataset.create(tmp_path / "d", image_size=8, codec="raw") as dataset:
        dataset.append(old)
    monkeypatch.setattr(shards, "FileIO", Slow)
    assert not dataset.validate()
    np.testing.assert_array_equal(dataset[0].image, old.image)


def test_single_images_are_those_of_the_trajectory(tmp_path):
    dataset = made(tmp_path, chain(3), chain(40))
    times = [40, 0, 17, 16, 15, 31]
    np.testing.assert_array_equal(dataset.images(1, times), dataset[1].image[times])
    np.testing.assert_array_equal(dataset.subset([1]).images(0, [7]), dataset[1].image[[7]])


def test_missing_rewards_and_labels_stay_missing(tmp_path):
    new = made(tmp_path, chain(20, reward=None))[0]
    assert (new.reward, new.embodiment, new.task, new.source) == (None, None, None, None)
    assert not new.terminated


def test_only_the_true_action_width_is_kept(tmp_path):
    old = chain(5, action_dim=2)
    padded = Trajectory(old.image, np.pad(old.action, ((0, 0), (0, 4))), action_dim=2)
    dataset = made(tmp_path, padded)
    np.testing.assert_array_equal(dataset[0].action, old.action)
    assert dataset.max_action_dim == 2


@pytest.mark.parametrize("workers", [0, 2])
def test_a_sample_keeps_to_the_chain(tmp_path, workers):
    made(tmp_path, *(chain(50, seed, terminated=True) for seed in range(4)), chain(3, 9))
    with TrajectoryDataset.open(tmp_path, workers=workers) as dataset:
        batch = dataset.sample(64, 40, 3, rng())
    check_chain(batch)
    assert batch.image.shape == (64, 40, 8, 8, 3)
    assert batch.is_terminal.any()


def test_dataset_and_replay_draw_the_same_batch(tmp_path):
    trajectories = [chain(n, n, terminated=n % 2 == 0) for n in (1, 2, 15, 16, 17, 60)]
    dataset, replay = made(tmp_path, *trajectories), ReplayBuffer()
    for trajectory in trajectories:
        replay.add(trajectory)
    for seed in range(20):
        one, two = (d.sample(8, 18, 2, rng(seed)) for d in (dataset, replay))
        for name, stream in tensors(one).items():
            np.testing.assert_array_equal(stream, tensors(two)[name])


def test_the_same_rng_and_contents_draw_the_same_batch_again(tmp_path):
    made(tmp_path, chain(50), chain(50, 1))
    one, two = (TrajectoryDataset.open(tmp_path).sample(4, 9, 2, rng(3)) for _ in range(2))
    for name, stream in tensors(one).items():
        np.testing.assert_array_equal(stream, tensors(two)[name])


def test_width_and_generator_may_be_left_out(tmp_path):
    dataset = made(tmp_path, chain(300, action_dim=2), chain(300, action_dim=5))
    one, two = dataset.sample(32, 9), dataset.sample(32, 9)
    assert one.action.shape == (32, 9, 5)
    assert not one.image.equal(two.image)
    assert dataset.subset([0]).sample(1, 9).action.shape == (1, 9, 2)


def test_batches_come_from_pinned_memory_if_asked(tmp_path, monkeypatch):
    pinned = []
    monkeypatch.setattr(torch.Tensor, "pin_memory", lambda t: pinned.append(t.shape) or t)
    batches = made(tmp_path, chain(30)).batches(4, 9, 2, seed=0, ahead=0, pin=True)
    check_chain(next(batches))
    batches.close()
    assert len(pinned) >= 6  # the streams of a Batch


def test_a_batch_goes_to_another_device(tmp_path):
    batch = made(tmp_path, chain(30)).sample(4, 9)
    assert batch.to("meta").image.shape == batch.image.shape
    assert {stream.device.type for stream in vars(batch.to("meta")).values()} == {"meta"}


def test_threads_may_sample_windows_of_different_lengths(tmp_path):
    dataset = made(tmp_path, *(chain(n, n) for n in (9, 20, 31)))
    with ThreadPoolExecutor(4) as pool:
        for batch in pool.map(lambda k: dataset.sample(8, 4 + k % 5, rng=rng(k)), range(60)):
            check_chain(batch)


def test_trajectories_shorter_than_a_window_are_chained_not_dropped(tmp_path):
    dataset = made(tmp_path, chain(3), chain(4, 1), chain(40, 2))
    batch = dataset.sample(200, 16, rng=rng())
    check_chain(batch)
    joints = batch.is_first.numpy()[:, 1:].any(1)
    # 41 images have 26 windows of 16, each short trajectory counts as one
    np.testing.assert_allclose(joints.mean(), 2 / 28, atol=0.06)
    assert joints.any()


def test_batch_k_depends_on_seed_purpose_and_k_alone(tmp_path):
    dataset = made(tmp_path, chain(300))

    def starts(purpose, start):
        batches = dataset.batches(4, 9, 2, seed=1, purpose=purpose, start=start)
        firsts = [next(batches).image[:, 0, 0, 0, 0].tolist() for _ in range(5)]
        batches.close()
        return firsts

    drawn = [dataset.sample(4, 9, 2, rng([1, 0, k])).image[:, 0, 0, 0, 0].tolist() for k in (3, 4)]
    assert starts(0, 3)[:2] == starts(0, 0)[3:] == drawn
    assert starts(0, 0) != starts(1, 0)


def test_what_was_appended_is_seen_by_the_one_who_appended(tmp_path):
    with TrajectoryDataset.create(tmp_path, image_size=8) as dataset:
        for seed in range(3):
            dataset.append(chain(20, seed))
            np.testing.assert_array_equal(dataset[seed].image, chain(20, seed).image)
        assert len(dataset) == 3


def test_what_others_appended_is_sampled_once_it_is_seen(tmp_path):
    dataset = made(tmp_path, chain(20))
    dataset.sample(2, 4)
    with TrajectoryDataset.open(tmp_path) as other:
        other.extend(chain(20, 1, reward=None) for _ in range(9))
    with dataset:
        dataset.reserve()
    assert len(dataset) == 10
    assert not dataset.sample(50, 4, rng=rng()).reward_known[:, 1:].all()


@pytest.mark.parametrize("codec", ["zstd", "raw"])
def test_extending_copies_another_dataset_in_its_order(tmp_path, codec):
    labels = {"terminated": True, "embodiment": "arm", "task": "reach", "source": "ours"}
    other = made(tmp_path / "2", chain(8, 1), chain(40, 2, **labels), chain(7, reward=None))
    with made(tmp_path / "1", chain(9), codec=codec) as dataset:
        dataset.extend(other.subset([2, 1, 1]))
        assert dataset.lengths.tolist() == [9, 7, 40, 40]
    dataset = TrajectoryDataset.open(tmp_path / "1")
    assert dataset.validate() == []
    for new, old in zip(dataset, (chain(9), other[2], other[1], other[1]), strict=True):
        for name, value in vars(old).items():
            np.testing.assert_array_equal(getattr(new, name), value)


def test_merge_makes_a_dataset_of_several(tmp_path):
    parts = [made(tmp_path / str(n), chain(n), chain(n + 1)) for n in (3, 5)]
    merged = TrajectoryDataset.merge(
        tmp_path / "all", [str(parts[0].path), parts[1], parts[0].subset([1])]
    )
    assert merged.lengths.tolist() == [3, 4, 5, 6, 4]
    assert merged.validate() == []
    with merged:
        merged.append(chain(9))
    assert [len(part) for part in parts] == [2, 2]


@pytest.mark.parametrize(
    ("codecs", "codec"),
    [(("raw", "raw"), "raw"), (("jpeg", "raw"), "zstd"), (("jpeg", "jpeg"), "jpeg")],
)
def test_merging_loses_no_more_than_was_lost(tmp_path, codecs, codec):
    parts = [made(tmp_path / str(n), chain(40, n), codec=c) for n, c in enumerate(codecs)]
    merged = TrajectoryDataset.merge(tmp_path / "all", parts)
    assert merged.info()["codec"] == codec
    for trajectory, part in zip(merged, parts, strict=True):
        np.testing.assert_array_equal(trajectory.image, part[0].image)


def test_merge_refuses_nothing_and_other_sizes_before_it_writes(tmp_path):
    small, large = made(tmp_path / "1", chain(3)), TrajectoryDataset.create(tmp_path / "2")
    with pytest.raises(ValueError, match=r"one image size: .*1 has 8, .*2 has 64"):
        TrajectoryDataset.merge(tmp_path / "all", [small, large])
    with pytest.raises(ValueError, match="got no dataset"):
        TrajectoryDataset.merge(tmp_path / "all", [])
    assert not (tmp_path / "all").exists()


@pytest.mark.filterwarnings("ignore:Images of 8 x 8 are resized")
def test_merge_resizes_where_it_is_asked_to(tmp_path):
    small, large = made(tmp_path / "1", chain(3)), TrajectoryDataset.create(tmp_path / "2")
    merged = TrajectoryDataset.merge(tmp_path / "all", [small, large], image_size=64)
    np.testing.assert_array_equal(merged[0].image, chain(3, size=64).image)


def test_joined_datasets_are_read_as_one_and_nothing_is_copied(tmp_path):
    one = made(tmp_path / "1", chain(9, 0), chain(4, 1), codec="raw")
    two = made(tmp_path / "2", chain(7, 2, embodiment="arm"))
    both = TrajectoryDataset.join([one.subset([1, 0]), two])
    assert both.lengths.tolist() == [4, 9, 7]
    assert both.embodiments == [None, None, "arm"]
    for new, old in zip(both, (one[1], one[0], two[0]), strict=True):
        np.testing.assert_array_equal(new.image, old.image)
    check_chain(both.sample(8, 5, 2, rng()))
    np.testing.assert_array_equal(both.subset([2])[0].image, two[0].image)
    assert both.info()["codec"] == "raw, zstd" and both.info()["trajectories"] == 3
    assert len({both.fingerprint, one.fingerprint, two.fingerprint}) == 3
    with pytest.raises(ValueError, match="read-only"):
        both.append(chain(3))
    flip_bit(tmp_path / "2" / "shard-00000.bin", 20)
    assert [damage.trajectory for damage in both.validate(set_aside=True)] == [2]
    assert len(TrajectoryDataset.open(tmp_path / "2")) == 0
    assert len(TrajectoryDataset.open(tmp_path / "1")) == 2


def test_datasets_of_different_image_sizes_are_not_joined(tmp_path):
    small, large = made(tmp_path / "1", chain(3)), TrajectoryDataset.create(tmp_path / "2")
    with pytest.raises(ValueError, match=r"1 has 8, .*2 has 64; copy them by .*merge"):
        TrajectoryDataset.join([small, large])


def test_a_damaged_trajectory_is_not_copied(tmp_path):
    other = made(tmp_path / "1", chain(40), chain(40, 1))
    flip_bit(tmp_path / "1" / "shard-00000.bin", other.info()["bytes"] - 20)
    with pytest.raises(ValueError, match=f"Trajectory 1 of {tmp_path / '1'} is damaged"):
        TrajectoryDataset.merge(tmp_path / "2", [other])
    assert TrajectoryDataset.open(tmp_path / "2").lengths.tolist() == [40]


def test_lengths_widths_and_labels(tmp_path):
    dataset = made(tmp_path, chain(4, embodiment="a", task="run"), chain(9, action_dim=5))
    assert len(dataset) == 2
    assert dataset.lengths.tolist() == [4, 9]
    assert dataset.action_dims.tolist() == [2, 5]
    assert (dataset.embodiments, dataset.tasks) == (["a", None], ["run", None])
    assert (dataset.max_action_dim, dataset.path) == (5, tmp_path)
    assert [len(trajectory) for trajectory in dataset] == [4, 9]
    assert len(dataset[-1]) == 9


def test_an_index_past_the_end_is_an_index_error(tmp_path):
    with pytest.raises(IndexError):
        made(tmp_path, chain(4))[1]


def test_a_slice_is_refused_with_what_to_write(tmp_path):
    dataset = made(tmp_path, *(chain(5 + i) for i in range(3)))
    with pytest.raises(TypeError, match="use subset"):
        dataset[:2]
    assert dataset.subset(range(2)).lengths.tolist() == [5, 6]


def test_a_subset_by_mask_is_of_those_that_are_true(tmp_path):
    dataset = made(tmp_path, *(chain(5 + i) for i in range(3)))
    for mask in ([False, True, True], dataset.lengths > 5):
        assert dataset.subset(mask).lengths.tolist() == [6, 7]
    assert len(dataset.subset([])) == len(dataset.subset([False] * 3)) == 0
    with pytest.raises(ValueError, match="mask of 2 for 3 trajectories"):
        dataset.subset([True, False])


def test_a_subset_of_trajectories_in_memory_outlives_them():
    view = TrajectoryDataset.of([chain(5, size=64)]).subset([0])
    gc.collect()
    assert len(view[0]) == 5


def test_a_shard_of_another_dataset_is_told_from_its_own(tmp_path):
    for name, seed in (("a", 0), ("b", 9)):
        made(tmp_path / name, chain(20, seed), codec="raw")
    shard = "shard-00000.bin"
    (tmp_path / "a" / shard).write_bytes((tmp_path / "b" / shard).read_bytes())
    dataset = TrajectoryDataset.open(tmp_path / "a")
    with pytest.raises(ValueError, match="another trajectory than the index names"):
        dataset[0]
    assert len(dataset.validate()) == 1


def test_numbers_of_numpy_are_taken(tmp_path):
    old = replace(chain(5), terminated=np.bool_(True), action_dim=np.int64(2))
    assert made(tmp_path, old)[0].terminated


def test_a_subset_is_a_view_in_the_order_given(tmp_path):
    dataset = made(tmp_path, *(chain(n) for n in (4, 5, 6, 7)))
    view = dataset.subset([3, 1, 2]).subset([-1, 0])
    assert view.lengths.tolist() == [6, 7]
    np.testing.assert_array_equal(view[1].image, dataset[3].image)
    check_chain(view.sample(4, 5, 2, rng()))
    with pytest.raises(ValueError, match="subset is read-only"):
        view.append(chain(3))


def test_first_observations_come_in_order_and_in_batches(tmp_path):
    dataset = made(tmp_path, *(chain(20, seed) for seed in range(5)))
    batches = list(dataset.first_observations(batch=2))
    assert [len(batch) for batch in batches] == [2, 2, 1]
    first = np.stack([trajectory.image[0] for trajectory in dataset])
    np.testing.assert_array_equal(np.concatenate(batches), first)


def test_info_counts(tmp_path):
    info = made(tmp_path, chain(20, embodiment="a"), chain(30, reward=None)).info()
    assert (info["trajectories"], info["transitions"], info["with_reward"]) == (2, 50, 1)
    assert (info["embodiments"], info["action_dims"]) == ({"a": 1, None: 1}, {2: 2})
    assert info["bytes"] == (tmp_path / "shard-00000.bin").stat().st_size
    # 52 images in one byte value each: far less than 8 * 8 * 3 bytes an image
    assert info["compression"] > 2


def test_a_dataset_is_printed_with_its_content(tmp_path):
    text = repr(made(tmp_path, chain(20, embodiment="a"), chain(30)))
    words = "2 trajectories, 50 transitions, robots: a, unnamed, actions: 2>"
    assert text.startswith("<TrajectoryDataset '") and text.endswith(words)


def test_sources_and_tasks_are_told_and_counted(tmp_path):
    dataset = made(tmp_path, chain(4, source="ours", task="run"), chain(4, task="run"), chain(4))
    assert dataset.sources == ["ours", None, None]
    assert dataset.info()["tasks"] == {"run": 2, None: 1}


def photograph(length, size=16):
    """A trajectory whose images shade smoothly, with the noise of a camera."""
    rng = np.random.default_rng(0)
    shade = np.linspace(40, 200, size)[:, None] + np.linspace(-30, 30, size)
    noisy = shade[None, :, :, None] + rng.normal(0, 4, (length + 1, size, size, 3))
    return Trajectory(noisy.astype(np.uint8), chain(length).action, chain(length).reward)


@pytest.mark.parametrize("length", [1, 15, 16, 40])
def test_jpeg_keeps_images_nearly_and_all_else_exactly(tmp_path, length):
    old = photograph(length)
    with TrajectoryDataset.create(tmp_path, image_size=16, codec="jpeg") as dataset:
        dataset.append(old)
    new = TrajectoryDataset.open(tmp_path)[0]
    assert np.abs(new.image.astype(int) - old.image).mean() < 3
    np.testing.assert_array_equal(new.action, old.action)
    np.testing.assert_array_equal(new.reward, old.reward)


def test_info_says_what_a_codec_saves_and_whether_it_loses(tmp_path):
    infos = {}
    for codec in ("zstd", "raw", "jpeg"):
        with TrajectoryDataset.create(tmp_path / codec, image_size=16, codec=codec) as dataset:
            dataset.append(photograph(60))
        infos[codec] = dataset.info()
    assert infos["jpeg"]["compression"] > 1.5 * infos["zstd"]["compression"]
    assert [infos[c]["lossless"] for c in ("zstd", "raw", "jpeg")] == [True, True, False]


@pytest.mark.parametrize("size", [7, 9])
def test_another_image_size_in_meta_json_is_found_at_reading(tmp_path, size):
    made(tmp_path, chain(40))
    meta = json.loads((tmp_path / "meta.json").read_text())
    (tmp_path / "meta.json").write_text(json.dumps({**meta, "image_size": size}))
    dataset = TrajectoryDataset.open(tmp_path)
    with pytest.raises(ValueError, match=f"Trajectory 0 .* does not hold .* images of {size} x"):
        dataset.sample(1, 4)
    assert len(dataset.validate()) == 1


def test_a_codec_of_a_newer_version_is_named(tmp_path):
    made(tmp_path, chain(3))
    meta = json.loads((tmp_path / "meta.json").read_text())
    (tmp_path / "meta.json").write_text(json.dumps({**meta, "codec": "av1"}))
    with pytest.raises(ValueError, match=r"No codec 'av1'.*There are: jpeg, raw, zstd"):
        TrajectoryDataset.open(tmp_path)


def test_the_default_codec_is_lossless_and_smaller_than_raw(tmp_path):
    small, raw = (made(tmp_path / c, chain(90), codec=c).info()["bytes"] for c in ("zstd", "raw"))
    assert small < raw / 2


def test_shards_roll_over_and_appending_goes_on_after_reopening(tmp_path, monkeypatch):
    monkeypatch.setattr(shards, "SHARD_BYTES", 2_000)
    made(tmp_path, *(chain(20, seed) for seed in range(6)), codec="raw")
    with TrajectoryDataset.open(tmp_path) as dataset:
        dataset.append(chain(20, 6))
        check_chain(dataset.sample(8, 9, 2, rng()))
    dataset = TrajectoryDataset.open(tmp_path)
    assert len(list(tmp_path.glob("shard-*.bin"))) == 7
    for seed, trajectory in enumerate(dataset):
        np.testing.assert_array_equal(trajectory.image, chain(20, seed).image)


def test_a_codec_that_is_not_there_is_refused(tmp_path):
    with pytest.raises(ValueError, match=r"No codec 'gif'\. There are: jpeg, raw, zstd"):
        TrajectoryDataset.create(tmp_path, codec="gif")


def test_an_empty_dataset_opens_and_is_not_sampled(tmp_path):
    dataset = made(tmp_path)
    assert (len(dataset), dataset.max_action_dim, dataset.validate()) == (0, 0, [])
    assert dataset.info()["transitions"] == 0
    with pytest.raises(ValueError, match="holds no trajectory"):
        dataset.sample(1, 2, 1, rng())


def test_a_folder_that_is_not_there_is_named(tmp_path):
    with pytest.raises(ValueError, match="nowhere does not exist"):
        TrajectoryDataset.open(tmp_path / "nowhere")


@pytest.mark.parametrize("meta", [None, "{", "[]", '{"kind": "Trainer"}'])
def test_a_folder_that_is_no_dataset_is_named(tmp_path, meta):
    if meta is not None:
        (tmp_path / "meta.json").write_text(meta)
    with pytest.raises(ValueError, match=f"{tmp_path.name} is not a dataset"):
        TrajectoryDataset.open(tmp_path)


def test_a_newer_version_is_refused_politely(tmp_path):
    made(tmp_path, chain(3))
    meta = json.loads((tmp_path / "meta.json").read_text())
    (tmp_path / "meta.json").write_text(json.dumps({**meta, "version": 99}))
    with pytest.raises(ValueError, match="version 99, this program reads up to 1; update"):
        TrajectoryDataset.open(tmp_path)


def test_a_folder_with_something_in_it_is_not_written_over(tmp_path):
    made(tmp_path, chain(3))
    with pytest.raises(ValueError, match="not empty; open a dataset"):
        TrajectoryDataset.create(tmp_path)
    assert len(TrajectoryDataset.open(tmp_path)) == 1


def test_images_of_another_size_are_resized_with_one_warning(tmp_path):
    with TrajectoryDataset.create(tmp_path) as dataset:
        with pytest.warns(UserWarning, match="Images of 8 x 8 are resized to 64 x 64") as warned:
            dataset.append(chain(5))
            dataset.append(chain(7))
        dataset.append(chain(5, size=64))
    assert len(warned) == 1
    small, _, large = TrajectoryDataset.open(tmp_path)
    np.testing.assert_array_equal(small.image, large.image)  # a flat colour stays what it is


def test_the_advice_for_images_that_are_not_square_works_to_the_letter(tmp_path):
    image = np.zeros((4, 8, 32, 3), np.uint8)
    image[:, :, 12:20] = 200  # the square in the middle
    wide = Trajectory(image, np.zeros((3, 2), np.float32))
    with TrajectoryDataset.create(tmp_path, image_size=8) as dataset:
        advice = r"squeezed to 8 x 8.* factor of 4\.00; .*image\[\.\.\., 0:8, 12:20, :\], or append"
        with pytest.warns(UserWarning, match=advice):
            dataset.append(wide)
        dataset.append(replace(wide, image=image[..., 0:8, 12:20, :]))
        dataset.append(wide, crop=True)
    assert [int(t.image.mean()) for t in dataset] == [50, 200, 200]


def test_padding_that_is_not_zero_is_refused(tmp_path):
    old = chain(5, action_dim=4)
    with pytest.raises(ValueError, match="past action_dim=2 must be zero"):
        made(tmp_path, Trajectory(old.image, old.action, action_dim=2))


def test_more_actions_than_the_agent_has_are_refused(tmp_path):
    dataset = made(tmp_path, chain(5, action_dim=3, embodiment="crab"))
    with pytest.raises(ValueError, match="crab has 3 actions, the agent takes 2"):
        dataset.sample(1, 4, 2, rng())


def test_a_flipped_bit_is_found_and_refused_by_name(tmp_path):
    dataset = made(tmp_path, *(chain(40, seed) for seed in range(3)))
    middle = dataset.info()["bytes"] // 2
    flip_bit(tmp_path / "shard-00000.bin", middle)
    [damage] = dataset.validate()
    assert damage.trajectory == 1
    assert "does not match its checksum" in damage.reason
    with pytest.raises(ValueError, match=f"Trajectory 1 of {tmp_path} is damaged"):
        dataset.subset([1]).sample(4, 40, 2, rng())
    check_chain(dataset.subset([0, 2]).sample(4, 40, 2, rng()))


def test_every_bit_of_a_shard_matters(tmp_path):
    dataset = made(tmp_path, chain(20))
    for at in range(0, dataset.info()["bytes"], 7):
        flip_bit(tmp_path / "shard-00000.bin", at)
        assert len(dataset.validate()) == 1
        flip_bit(tmp_path / "shard-00000.bin", at)
    assert dataset.validate() == []


def test_a_truncated_and_a_missing_shard_are_found(tmp_path, monkeypatch):
    monkeypatch.setattr(shards, "SHARD_BYTES", 10)
    dataset = made(tmp_path, *(chain(40, seed) for seed in range(4)))
    os.truncate(tmp_path / "shard-00001.bin", 100)
    (tmp_path / "shard-00003.bin").unlink()
    assert [damage.trajectory for damage in dataset.validate()] == [1, 3]
    for i in (1, 3):
        with pytest.raises(ValueError, match=f"Trajectory {i} of {tmp_path} is damaged"):
            dataset.subset([i]).sample(1, 41)


def test_damaged_trajectories_are_set_aside_and_the_rest_is_usable(tmp_path, monkeypatch):
    monkeypatch.setattr(shards, "SHARD_BYTES", 10)  # a shard a trajectory
    dataset = made(tmp_path, *(chain(20, seed) for seed in range(6)))
    flip_bit(tmp_path / "shard-00001.bin", 30)
    os.truncate(tmp_path / "shard-00005.bin", 50)
    assert [d.trajectory for d in dataset.validate(set_aside=True)] == [1, 5]
    assert (len(dataset), dataset.validate()) == (4, [])
    check_chain(dataset.sample(16, 9))
    dataset = TrajectoryDataset.open(tmp_path)
    assert (dataset.info()["trajectories"], dataset.info()["set_aside"]) == (4, 2)
    with dataset:
        dataset.append(chain(20, 6))
        assert len(dataset) == 5
    kept = [chain(20, seed).image for seed in (0, 2, 3, 4, 6)]
    np.testing.assert_array_equal([t.image for t in TrajectoryDataset.open(tmp_path)], kept)


def test_a_second_damage_joins_the_first_and_a_repair_brings_both_back(tmp_path, monkeypatch):
    monkeypatch.setattr(shards, "SHARD_BYTES", 10)
    made(tmp_path, *(chain(20, seed) for seed in range(4)))
    for shard in ("shard-00000.bin", "shard-00002.bin"):
        flip_bit(tmp_path / shard, 30)
        dataset = TrajectoryDataset.open(tmp_path)
        assert len(dataset.subset(range(len(dataset))).validate(set_aside=True)) == 1
        flip_bit(tmp_path / shard, 30)
    assert len(TrajectoryDataset.open(tmp_path)) == 2
    (tmp_path / "damaged.json").unlink()
    dataset = TrajectoryDataset.open(tmp_path)
    assert (len(dataset), dataset.validate()) == (4, [])


def test_the_writer_itself_can_set_aside_and_go_on(tmp_path):
    with TrajectoryDataset.create(tmp_path, image_size=8) as dataset:
        dataset.extend(chain(20, seed) for seed in range(2))
        flip_bit(tmp_path / "shard-00000.bin", 30)
        assert len(dataset.validate(set_aside=True)) == 1
        dataset.append(chain(20, 2))
        np.testing.assert_array_equal(dataset[1].image, chain(20, 2).image)
    assert len(TrajectoryDataset.open(tmp_path)) == 2


def test_validating_alone_sets_nothing_aside(tmp_path):
    dataset = made(tmp_path, chain(20))
    flip_bit(tmp_path / "shard-00000.bin", 30)
    assert len(dataset.validate()) == 1
    assert len(TrajectoryDataset.open(tmp_path)) == 1
    assert not (tmp_path / "damaged.json").exists()


@pytest.mark.parametrize("text", ["[{", "[1]", '[{"shard": 0}]'])
def test_a_damaged_list_of_the_damaged_is_named_with_the_remedy(tmp_path, text):
    made(tmp_path, chain(3))
    (tmp_path / "damaged.json").write_text(text)
    with pytest.raises(ValueError, match=r"damaged\.json is damaged .*; delete it"):
        TrajectoryDataset.open(tmp_path)


@pytest.mark.parametrize("order", [(0, 1, 1, 2), (0, 2, 1), (1, 0, 2)])
def test_lines_repeated_or_out_of_order_are_refused(tmp_path, order):
    made(tmp_path, chain(3), chain(4), chain(5))
    index = tmp_path / "index.jsonl"
    lines = index.read_bytes().splitlines(keepends=True)
    index.write_bytes(b"".join(lines[i] for i in order))
    with pytest.raises(ValueError, match=r"line \d is a repetition or out of order; restore"):
        TrajectoryDataset.open(tmp_path)


def test_a_damaged_line_of_the_index_is_named_with_the_remedy(tmp_path):
    made(tmp_path, chain(3), chain(4), chain(5))
    index = tmp_path / "index.jsonl"
    lines = index.read_bytes().splitlines(keepends=True)
    flip_bit(index, len(lines[0]) + 30)
    with pytest.raises(ValueError, match=r"line 2 \(trajectory 1\).*delete that line"):
        TrajectoryDataset.open(tmp_path)
    index.write_bytes(lines[0] + lines[2])
    assert TrajectoryDataset.open(tmp_path).lengths.tolist() == [3, 5]


def test_a_reader_never_sees_half_a_trajectory(tmp_path):
    made(tmp_path, chain(20))
    index = tmp_path / "index.jsonl"
    line = index.read_bytes()
    for cut in range(1, len(line)):
        index.write_bytes(line + line[:cut])  # a second one, its line not yet whole
        assert len(TrajectoryDataset.open(tmp_path)) == 1


def test_the_next_writer_removes_what_a_killed_one_left(tmp_path):
    made(tmp_path, chain(20))
    for name in ("index.jsonl", "shard-00000.bin"):
        with open(tmp_path / name, "ab") as file:
            file.write(b"0123abcd {half")
    with TrajectoryDataset.open(tmp_path) as dataset:
        dataset.append(chain(30, 1))
    dataset = TrajectoryDataset.open(tmp_path)
    assert dataset.lengths.tolist() == [20, 30]
    assert dataset.validate() == []
    assert (tmp_path / "shard-00000.bin").stat().st_size == dataset.info()["bytes"]


def test_a_second_writer_is_refused_until_the_first_is_done(tmp_path):
    first, second = TrajectoryDataset.create(tmp_path, 8), TrajectoryDataset.open(tmp_path)
    first.append(chain(3))
    with pytest.raises(ValueError, match="being written to by another process"):
        second.append(chain(4))
    first.close()
    second.append(chain(4))
    second.close()
    assert TrajectoryDataset.open(tmp_path).lengths.tolist() == [3, 4]


def test_a_reader_is_untouched_by_a_writer_at_work(tmp_path):
    reader = made(tmp_path, chain(20))
    with TrajectoryDataset.open(tmp_path) as writer:
        for seed in range(5):
            writer.append(chain(20, seed))
            assert len(TrajectoryDataset.open(tmp_path)) == seed + 2
            check_chain(reader.sample(4, 9, 2, rng(seed)))
    assert len(reader) == 1


def test_reading_changes_nothing_in_the_folder_so_it_may_be_read_only(tmp_path):
    made(tmp_path, chain(20))
    before = {file: file.stat().st_mtime_ns for file in [tmp_path, *tmp_path.iterdir()]}
    with TrajectoryDataset.open(tmp_path) as dataset:
        check_chain(dataset.sample(4, 9, 2, rng()))
        assert dataset.validate() == []
    assert {file: file.stat().st_mtime_ns for file in [tmp_path, *tmp_path.iterdir()]} == before


def test_a_fork_that_inherits_the_threads_can_sample(tmp_path):
    made(tmp_path, chain(20))
    dataset = TrajectoryDataset.open(tmp_path, workers=2)
    dataset.sample(4, 9, 2, rng())
    dataset._threads._owner = -1  # what a child sees: the threads belong to another process
    check_chain(dataset.sample(4, 9, 2, rng()))
    dataset.close()
