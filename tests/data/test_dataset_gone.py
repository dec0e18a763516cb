"""A dataset whose folder disappears while it is read, as a disk does that is unmounted."""

import errno
import os

import pytest
from debug_agent import pretrained, recorded, same, weights

from wpt_agents.data import reading
from wpt_agents.data.dataset import TrajectoryDataset
from wpt_agents.data.folder import Folder
from wpt_agents.training import pretraining


@pytest.fixture
def store(tmp_path):
    with TrajectoryDataset.create(tmp_path / "data") as dataset:
        dataset.extend(recorded(seed=i) for i in range(4))
    return dataset


@pytest.fixture
def paused(monkeypatch):
    """The pauses that were made, none of which takes time."""
    seconds = []
    monkeypatch.setattr(reading.time, "sleep", seconds.append)
    return seconds


def unmount(store):
    store.path.rename(store.path.with_name("elsewhere"))


def mount(store):
    store.path.with_name("elsewhere").rename(store.path)


def test_pretraining_stops_by_name_and_goes_on_exactly_when_the_dataset_is_back(
    store, paused, tmp_path, monkeypatch
):
    monkeypatch.setattr(pretraining, "SAVE_EVERY", 2)
    whole = pretrained(store, steps=8)

    def disappear(step, _):
        if step == 3:
            unmount(store)

    with pytest.raises(FileNotFoundError, match=r"data cannot be reached any more.*mounting"):
        pretrained(store, steps=8, run_dir=tmp_path / "run", callback=disappear)
    assert paused[:3] == list(reading.PAUSES)
    mount(store)
    steps = []
    resumed = pretrained(
        store, steps=8, run_dir=tmp_path / "run", callback=lambda step, _: steps.append(step)
    )
    assert 3 <= steps[0] <= 7 and steps[-1] == 8
    assert same(weights(resumed), weights(whole))


def test_a_folder_that_comes_back_in_time_is_read_on(store, monkeypatch):
    expected = store[2].image
    unmount(store)
    monkeypatch.setattr(reading.time, "sleep", lambda _: mount(store))
    assert (store[2].image == expected).all()


@pytest.mark.parametrize("number", [errno.EMFILE, errno.EACCES])
def test_what_says_nothing_about_a_file_is_not_called_damage(store, monkeypatch, number):
    dataset = TrajectoryDataset.open(store.path)

    def read(*_):
        raise OSError(number, os.strerror(number), "shard-00000.bin")

    monkeypatch.setattr(Folder, "read", read)
    with pytest.raises(OSError, match=f"{os.strerror(number)}: 'shard-00000.bin'"):
        dataset.validate(set_aside=True)
    assert not (store.path / "damaged.json").exists()


def test_a_stale_handle_of_a_network_disk_is_tried_again(store, paused, monkeypatch):
    dataset = TrajectoryDataset.open(store.path)
    read = Folder.read
    errors = [OSError(errno.ESTALE, "Stale file handle")]

    def stale(folder, *arguments):
        if errors:
            raise errors.pop()
        return read(folder, *arguments)

    monkeypatch.setattr(Folder, "read", stale)
    assert len(dataset[0]) > 0
    assert not errors


def test_trajectories_that_cannot_be_reached_are_not_called_damaged(store, paused, tmp_path):
    unmount(store)
    with pytest.raises(FileNotFoundError, match="cannot be reached any more"):
        store.validate(set_aside=True)
    with (
        TrajectoryDataset.create(tmp_path / "copy") as copy,
        pytest.raises(FileNotFoundError, match="cannot be reached any more"),
    ):
        copy.extend(store)
    mount(store)
    assert store.validate() == [] and len(TrajectoryDataset.open(store.path)) == 4
    (store.path / "shard-00000.bin").unlink()  # this is damage, at once
    paused.clear()
    with pytest.raises(ValueError, match=r"Trajectory 0 of .* is damaged"):
        store[0]
    assert paused == []
