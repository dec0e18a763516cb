"""What the dataset promises when processes die, disks fill up and bytes change: a test each."""

import errno
import os
import random
import signal

import numpy as np
import pytest
from chain import chain, check_chain, tensors
from faults import (
    done,
    failing,
    kill_oneself,
    mount,
    mounts_of_its_own,
    no_space,
    small_disk,
    started,
)

from wpt_agents.data import shards
from wpt_agents.data.dataset import TrajectoryDataset

pytestmark = pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")


def empty(path):
    TrajectoryDataset.create(path, image_size=8).close()
    return path


def content(path):
    return {file.name: file.read_bytes() for file in path.iterdir() if file.stat().st_size}


@pytest.fixture
def small_shards(monkeypatch):
    monkeypatch.setattr(shards, "SHARD_BYTES", 1_000)  # a few trajectories


def append_until_killed(path, acknowledged, seed):
    rng, write = random.Random(seed), os.write
    log = os.open(acknowledged, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    with failing(rng.randrange(60), kill_oneself, rng):
        dataset = TrajectoryDataset.open(path)
        while True:
            dataset.append(chain(40, seed=len(dataset)))
            write(log, b".")


@pytest.mark.slow
def test_a_writer_killed_50_times_loses_at_most_what_it_was_writing(tmp_path, small_shards):
    path, acknowledged, kept = empty(tmp_path / "data"), tmp_path / "acknowledged", 0
    for seed in range(50):
        acknowledged.write_bytes(b"")
        writer = started(append_until_killed, path, acknowledged, seed)
        writer.join(60)
        assert writer.exitcode == -signal.SIGKILL
        committed = kept + acknowledged.stat().st_size
        dataset = TrajectoryDataset.open(path)
        assert committed <= len(dataset) <= committed + 1
        assert dataset.subset(range(kept, len(dataset))).validate() == []
        kept = len(dataset)
    assert kept > 150
    for seed, trajectory in enumerate(dataset):
        np.testing.assert_array_equal(trajectory.image, chain(40, seed).image)
        np.testing.assert_array_equal(trajectory.action, chain(40, seed).action)


def create_until_killed(path, call):
    with failing(call, kill_oneself, random.Random(0)):
        TrajectoryDataset.create(path, image_size=8)


def test_a_create_killed_at_any_moment_can_be_repeated(tmp_path):
    codes = []
    for call in range(3):
        process = started(create_until_killed, tmp_path / str(call), call)
        process.join(60)
        codes.append(process.exitcode)
    assert codes == [-signal.SIGKILL, -signal.SIGKILL, 0]  # meta.json, then its name, made durable
    assert not (tmp_path / "0" / "meta.json").exists()
    empty(tmp_path / "0")
    assert [len(TrajectoryDataset.open(tmp_path / str(call))) for call in range(3)] == [0, 0, 0]


def test_a_disk_that_fills_up_at_any_write_leaves_the_dataset_as_it_was(tmp_path, monkeypatch):
    monkeypatch.setattr(shards, "SHARD_BYTES", 10)  # so that beginning a shard fails too
    path, failed = empty(tmp_path / "data"), 0
    with TrajectoryDataset.open(path) as dataset:
        for seed in range(50):
            before, rng = content(path), random.Random(seed)
            try:
                with failing(rng.randrange(8), no_space, rng):
                    dataset.append(chain(40, len(dataset)))
            except OSError as error:
                assert error.errno == errno.ENOSPC
                assert content(path) == before
                failed += 1
            assert len(TrajectoryDataset.open(path)) == len(dataset)
    assert 20 < failed < 50
    for seed, trajectory in enumerate(TrajectoryDataset.open(path)):
        np.testing.assert_array_equal(trajectory.image, chain(40, seed).image)


def test_a_disk_that_fills_up_while_another_dataset_is_copied_is_not_called_damage(tmp_path):
    with TrajectoryDataset.open(empty(tmp_path / "1")) as other:
        other.extend(chain(40, seed) for seed in range(3))
    with TrajectoryDataset.open(empty(tmp_path / "2")) as dataset:
        dataset.append(chain(40, 9))
        with pytest.raises(OSError, match="No space"), failing(6, no_space, random.Random(0)):
            dataset.extend(other)
        assert len(dataset) == len(TrajectoryDataset.open(tmp_path / "2")) == 2
    assert TrajectoryDataset.open(tmp_path / "2").validate() == []


def fill_a_small_disk(path):
    small_disk(path, b"256k")
    ballast = path / "ballast"
    ballast.write_bytes(bytes(128 * 1024))
    with TrajectoryDataset.create(path / "data", image_size=8, codec="raw") as dataset:
        with pytest.raises(OSError, match="No space"):
            while True:
                dataset.append(chain(90, len(dataset)))
        kept = len(dataset)
        opened = TrajectoryDataset.open(path / "data")
        assert (len(opened), opened.validate()) == (kept, [])
        assert kept > 1
        ballast.unlink()
        dataset.append(chain(90, kept))
    assert TrajectoryDataset.open(path / "data").lengths.tolist() == [90] * (kept + 1)
    assert TrajectoryDataset.open(path / "data").validate() == []


def test_a_full_disk_leaves_the_dataset_as_it_was(tmp_path):
    done(started(fill_a_small_disk, tmp_path))


def make_read_only(path):
    mounts_of_its_own()
    where, bind, read_only = os.fsencode(path), 0x1000, 0x1000 | 0x20 | 0x1
    mount(where, where, None, bind)
    mount(None, where, None, read_only)


def use_what_is_read_only(path):
    make_read_only(path)
    dataset = TrajectoryDataset.open(path)
    check_chain(dataset.sample(4, 9))
    check_chain(next(dataset.batches(4, 9, 2, seed=0)))
    assert dataset.validate() == []
    with pytest.raises(OSError, match=r"Read-only file system.*index\.jsonl"):
        dataset.append(chain(20))


def test_a_read_only_folder_is_read(tmp_path):
    with TrajectoryDataset.create(tmp_path, image_size=8) as dataset:
        dataset.append(chain(20))
    done(started(use_what_is_read_only, tmp_path))


def use_a_cache_that_is_read_only(path):
    make_read_only(path)
    assert TrajectoryDataset.of(path / "in").lengths.tolist() == [20]
    with pytest.raises(ValueError, match=r"which cannot be made .* set XDG_CACHE_HOME"):
        TrajectoryDataset.of(path / "other")


def test_a_finished_conversion_in_a_read_only_cache_is_used(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    for name in ("in", "other"):
        (tmp_path / name).mkdir()
        old = chain(20, size=64)
        action = np.concatenate([np.zeros((1, 2)), old.action])
        np.savez(tmp_path / name / "0.npz", observation=old.image, action=action)
    TrajectoryDataset.of(tmp_path / "in")
    done(started(use_a_cache_that_is_read_only, tmp_path))


def append_in_turns(path, seed):
    for _ in range(10):
        while True:
            try:
                with TrajectoryDataset.open(path) as dataset:
                    dataset.append(chain(20, seed, source=str(seed)))
                break
            except ValueError as error:
                assert "is being written to by another process" in str(error)


def test_two_processes_that_append_at_once_lose_nothing(tmp_path):
    empty(tmp_path)
    done(*(started(append_in_turns, tmp_path, seed) for seed in range(2)))
    dataset = TrajectoryDataset.open(tmp_path)
    assert sorted(dataset.sources) == ["0"] * 10 + ["1"] * 10
    for trajectory in dataset:
        np.testing.assert_array_equal(trajectory.image, chain(20, int(trajectory.source)).image)


def be_refused(path):
    with pytest.raises(ValueError, match="being written to by another process; wait for it"):
        TrajectoryDataset.open(path).append(chain(20))


def test_a_second_process_is_refused_with_the_reason(tmp_path):
    with TrajectoryDataset.create(tmp_path, image_size=8) as dataset:
        dataset.append(chain(20))
        done(started(be_refused, tmp_path))
    assert len(TrajectoryDataset.open(tmp_path)) == 1


def test_a_process_forked_off_keeps_nobody_from_writing_on(tmp_path):
    with TrajectoryDataset.create(tmp_path, image_size=8) as dataset:
        dataset.append(chain(20))
        other = started(signal.pause)
    try:
        with TrajectoryDataset.open(tmp_path) as dataset:
            dataset.append(chain(20))
    finally:
        other.kill()
        other.join()


def read_on(path, expected):
    for _ in range(20):
        dataset = TrajectoryDataset.open(path)
        assert dataset.subset(range(len(dataset) - 1, len(dataset))).validate() == []
        batch = tensors(dataset.subset(range(3)).sample(4, 9, rng=np.random.default_rng(0)))
        for name, stream in expected.items():
            np.testing.assert_array_equal(batch[name], stream)


def test_several_processes_read_at_once_while_another_writes(tmp_path, small_shards):
    with TrajectoryDataset.create(tmp_path, image_size=8) as dataset:
        dataset.extend(chain(20, seed) for seed in range(3))
        expected = tensors(dataset.subset(range(3)).sample(4, 9, rng=np.random.default_rng(0)))
        readers = [started(read_on, tmp_path, expected) for _ in range(3)]
        dataset.extend(chain(20, seed) for seed in range(3, 40))
        done(*readers)
