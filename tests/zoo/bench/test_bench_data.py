import json

import numpy as np
import pytest

from wpt_agents.data.dataset import TrajectoryDataset
from wpt_agents.zoo.bench import data, formats

pytestmark = pytest.mark.slow  # it runs simulators or whole runs


def test_every_case_of_the_quick_benchmark_has_its_row(tmp_path):
    rows = list(data.rows(quick=True, folder=tmp_path))
    json.dumps(rows)
    assert [row["format"] for row in rows if row["what"] == "format"] == list(formats.FORMATS)
    [sampling] = [row for row in rows if row["what"] == "sampling"]
    assert sampling["times_faster"] == pytest.approx(
        sampling["update_ms"] / sampling["batch_ms"], rel=0.1
    )
    [large] = [row for row in rows if row["what"] == "large store"]
    assert (large["trajectories"], large["transitions"]) == (20, 20 * 167)
    assert large["resident_mib"] < 2048


def test_a_format_whose_package_is_missing_is_named(monkeypatch):
    monkeypatch.setattr(data, "find_spec", lambda name: None)
    [row] = {row["absent"] for row in data.compare("x", [], 1) if row["format"] == "Minari"}
    assert row == "pip install minari"


@pytest.mark.parametrize("form", formats.FORMATS)
def test_every_format_gives_back_what_it_took(tmp_path, form):
    pytest.importorskip(formats.FORMATS[form][1], reason="this format's package is not installed")
    trajectories = data.synthetic(2, 40)
    read = formats.FORMATS[form][0](tmp_path, trajectories)
    for i, trajectory in enumerate(trajectories):
        error = np.abs(read(i, 5, 30).astype(int) - trajectory.image[5:30]).mean()
        assert (error == 0) == (form not in ("Minari", "store, jpeg"))
        assert error < 20  # a noisy patchwork is hard on JPEG, another image is 80 away


def test_a_large_store_begun_is_gone_on_with(tmp_path):
    data.make_store(tmp_path / "store", 3, 2)
    base = TrajectoryDataset.open(tmp_path / "store-base")
    data.make_store(tmp_path / "store", 3, 4)
    dataset = TrajectoryDataset.open(tmp_path / "store")
    assert (len(base), len(dataset)) == (3, 12)
    np.testing.assert_array_equal(dataset[10].image, base[1].image)


def test_synthetic_frames_compress_but_are_not_constant():
    [trajectory] = data.synthetic(1, 40)
    assert all(len(np.unique(image)) > 100 for image in trajectory.image)
    assert (np.diff(trajectory.image.astype(int), axis=0) != 0).any((1, 2, 3)).all()
