"""A conversion that is killed at any moment is continued to the same bytes."""

import shutil
from itertools import count

import pytest
from chain import chain
from faults import kill_at_change, killed
from test_importers import record_minari, save_npz

from wpt_agents.data import shards
from wpt_agents.data.dataset import TrajectoryDataset
from wpt_agents.data.importers.formats import open_episodes

pytestmark = pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")


def convert(source, target):
    TrajectoryDataset.from_npz(source, target, image_size=8).close()


def convert_until_killed(source, target, number):
    kill_at_change(number)
    convert(source, target)


def content(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.stat().st_size}


@pytest.mark.slow
def test_killed_at_any_write_a_conversion_is_continued_to_the_same_bytes(tmp_path, monkeypatch):
    monkeypatch.setattr(shards, "SHARD_BYTES", 10)  # so that each trajectory begins a shard
    for i in range(3):
        save_npz(tmp_path / f"in/{i}.npz", chain(30 + i, i))
    convert(tmp_path / "in", tmp_path / "whole")
    expected = content(tmp_path / "whole")
    assert sum(name.startswith("shard") for name in expected) >= 3
    for number in count():
        over = not killed(convert_until_killed, tmp_path / "in", tmp_path / "out", number)
        convert(tmp_path / "in", tmp_path / "out")
        assert content(tmp_path / "out") == expected, number
        shutil.rmtree(tmp_path / "out")
        if over:
            break
    assert number > 10


@pytest.mark.filterwarnings("ignore::UserWarning:minari")
def test_a_minari_file_that_is_cut_short_is_named(tmp_path, monkeypatch):
    record_minari(tmp_path, monkeypatch, [chain(9)], jpeg_encoding=False)
    (file,) = tmp_path.rglob("main_data.hdf5")
    file.write_bytes(file.read_bytes()[:2000])
    with pytest.raises(ValueError, match=r"test-v0.* damaged"):
        list(open_episodes(tmp_path / "chain" / "test-v0", "minari", image_size=8))
