"""`open_dataset` takes whatever can serve as a dataset."""

import copy
import inspect

import numpy as np
import pytest
from chain import chain

from wpt_agents.data import reading
from wpt_agents.data.convert import open_dataset
from wpt_agents.data.dataset import TrajectoryDataset
from wpt_agents.data.importers.formats import FORMATS
from wpt_agents.data.replay import ReplayBuffer


def stored(path, *trajectories):
    with TrajectoryDataset.create(path) as dataset:
        dataset.extend(trajectories)
    return dataset


def test_a_dataset_is_itself_and_a_path_is_opened(tmp_path, monkeypatch):
    dataset = stored(tmp_path / "a", chain(5, size=64))
    assert open_dataset(dataset) is dataset
    assert open_dataset(str(dataset.path)).fingerprint == dataset.fingerprint
    monkeypatch.setenv("HOME", str(tmp_path))
    assert open_dataset("~/a").fingerprint == dataset.fingerprint


def test_a_list_of_datasets_and_paths_is_a_view_of_all(tmp_path):
    one = stored(tmp_path / "a", chain(5, size=64))
    two = stored(tmp_path / "b", chain(6, size=64), chain(7, size=64))
    replay = ReplayBuffer()
    replay.add(chain(8, size=64))
    for data in ([one, two.path, replay, chain(9, size=64)], (str(one.path), two, replay)):
        dataset = open_dataset(data)
        assert dataset.lengths.tolist() == [5, 6, 7, 8, 9][: len(dataset)]
    assert (tmp_path / "a").exists()


def test_trajectories_one_or_many_are_stored_in_a_temporary_folder():
    one = chain(5, size=64)
    for data in (one, [one], iter([one]), (one for _ in range(1))):
        dataset = open_dataset(data)
        np.testing.assert_array_equal(dataset[0].image, one.image)
        assert len(dataset) == 1 and dataset.path.exists()
    path = dataset.path
    view = dataset.subset([0])
    del dataset
    assert len(view[0]) == 5 and path.exists()  # a view keeps the folder
    del view
    assert not path.exists()


def test_a_copy_keeps_the_temporary_folder_of_its_original():
    dataset = open_dataset(chain(5, size=64))
    path, copied = dataset.path, copy.deepcopy(dataset)
    del dataset
    assert len(copied[0]) == 5
    del copied
    assert not path.exists()


def test_a_dataset_of_a_relative_path_is_read_from_another_working_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    dataset = stored("a", chain(5, size=64))
    monkeypatch.chdir(tmp_path / "a")
    monkeypatch.setattr(reading, "PAUSES", ())
    assert len(dataset[0]) == 5


def test_the_constructors_are_documented_functions():
    for form in FORMATS:
        door = getattr(TrajectoryDataset, f"from_{form}")
        assert inspect.isfunction(door) and door.__qualname__ == f"TrajectoryDataset.from_{form}"
        assert FORMATS[form].__name__ in door.__doc__
        assert list(inspect.signature(door).parameters)[:2] == ["source", "path"]


def test_the_doors_of_the_class_lead_here(tmp_path):
    assert TrajectoryDataset.of is open_dataset
    with pytest.raises(ValueError, match=r"holds no \.npz"):
        TrajectoryDataset.from_npz(tmp_path, tmp_path / "out")
