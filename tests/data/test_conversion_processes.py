"""Several processes and one foreign file; systems with another encoding, or without locks."""

import ast
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from chain import chain
from test_importers import save_npz

from wpt_agents.data.convert import cache_folder
from wpt_agents.data.dataset import TrajectoryDataset
from wpt_agents.files.locks import locked

ROOT = Path(__file__).parents[2]
OPEN = """
import sys, time
from wpt_agents.data.convert import open_dataset
from wpt_agents.data.importers.npz import NpzEpisodes
read = NpzEpisodes.__getitem__
def slowly(self, i):
    time.sleep(float(sys.argv[2]))
    print("reads", i, flush=True)
    return read(self, i)
NpzEpisodes.__getitem__ = slowly
print("lengths", open_dataset(sys.argv[1]).lengths.tolist(), flush=True)
"""


def opener(source, cache, pause):
    environment = {**os.environ, "XDG_CACHE_HOME": str(cache), "PYTHONPATH": str(ROOT)}
    return subprocess.Popen(
        [sys.executable, "-c", OPEN, str(source), str(pause)],
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


@pytest.fixture
def source(tmp_path):
    for i in range(4):
        save_npz(tmp_path / "in" / f"{i}.npz", chain(5 + i, i, size=64))
    return tmp_path / "in"


@pytest.mark.slow
def test_of_several_processes_one_converts_and_the_others_wait(tmp_path, source):
    started = [opener(source, tmp_path / "cache", 0.2) for _ in range(3)]
    outputs = [process.communicate(timeout=300) for process in started]
    for process, (out, err) in zip(started, outputs, strict=True):
        assert process.returncode == 0, err
        assert "lengths [5, 6, 7, 8]" in out
    # Those who waited read the last episode alone, to compare it.
    assert sorted(out.count("reads") for out, _ in outputs) == [1, 1, 4]


@pytest.mark.slow
def test_a_killed_converter_holds_nobody_up_and_its_work_is_continued(tmp_path, source):
    killed = opener(source, tmp_path / "cache", 0.3)
    while "reads 1" not in killed.stdout.readline():
        pass
    waiting = opener(source, tmp_path / "cache", 0)
    time.sleep(0.1)
    killed.send_signal(signal.SIGKILL)
    out, err = waiting.communicate(timeout=300)
    killed.communicate()
    assert waiting.returncode == 0, err
    assert "lengths [5, 6, 7, 8]" in out
    assert out.count("reads") < 5  # not all of them again


def test_a_cache_that_was_locked_before_anything_was_written_is_used(tmp_path, source, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    with locked(cache_folder(source) / "convert.lock"):
        pass
    assert TrajectoryDataset.of(source).lengths.tolist() == [5, 6, 7, 8]


def test_labels_in_any_script_are_read_where_the_locale_is_ascii(tmp_path):
    task = "Würfel 方块"
    with TrajectoryDataset.create(tmp_path / "data", image_size=8) as dataset:
        dataset.append(chain(5, task=task))
    program = (
        "import sys; from wpt_agents.data.dataset import TrajectoryDataset as D; "
        "print(ascii(D.open(sys.argv[1]).tasks[0]))"
    )
    environment = {"PATH": os.environ["PATH"], "PYTHONPATH": str(ROOT), "LC_ALL": "C"}
    environment |= {"PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0", "HOME": str(tmp_path)}
    process = subprocess.run(
        [sys.executable, "-c", program, str(tmp_path / "data")],
        env=environment,
        capture_output=True,
        text=True,
        check=True,
    )
    assert process.stdout.strip() == ascii(task)


def opens_text(call):
    """Whether a call opens a text file: read_text, write_text, or open with no "b" in its mode."""
    name = getattr(call.func, "attr", getattr(call.func, "id", ""))
    if name != "open" or isinstance(call.func, ast.Attribute):
        return name in ("read_text", "write_text")
    modes = [a.value for a in call.args[1:2] if isinstance(a, ast.Constant)]
    return "b" not in (modes or ["r"])[0]


@pytest.mark.parametrize("package", ["wpt_agents", "envs"])
def test_every_text_file_is_opened_with_an_encoding(package):
    for path in (ROOT / package).rglob("*.py"):
        for call in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(call, ast.Call) and opens_text(call):
                keywords = [keyword.arg for keyword in call.keywords]
                assert "encoding" in keywords, f"{path}:{call.lineno}"


def test_without_locks_a_dataset_is_read_and_not_written(tmp_path, monkeypatch):
    with TrajectoryDataset.create(tmp_path, image_size=8) as dataset:
        dataset.append(chain(5))
    monkeypatch.setitem(sys.modules, "fcntl", None)  # as on Windows
    dataset = TrajectoryDataset.open(tmp_path)
    np.testing.assert_array_equal(dataset[0].image, chain(5).image)
    with pytest.raises(OSError, match=r"needs file locks \(fcntl\), .*it can be read anywhere"):
        dataset.append(chain(5))
    assert len(TrajectoryDataset.open(tmp_path)) == 1
