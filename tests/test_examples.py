"""Every script in examples/ runs, at a small size."""

import importlib
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from debug_agent import SETTINGS, recorded

EXAMPLES = Path(__file__).parents[1] / "examples"
SMALL = {name: value for name, value in SETTINGS.items() if name not in ("size", "seed")}
pytestmark = pytest.mark.filterwarnings("ignore:rich is experimental", "ignore:Training and eval")


@pytest.fixture
def example(monkeypatch):
    monkeypatch.syspath_prepend(str(EXAMPLES))
    return importlib.import_module


@pytest.fixture
def recordings(tmp_path):
    """A folder of episodes in .npz, the first action of each a placeholder."""
    folder = tmp_path / "recordings"
    folder.mkdir()
    for seed in range(3):
        trajectory = recorded(seed=seed)
        action = np.concatenate([np.zeros((1, 2), np.float32), trajectory.action])
        np.savez_compressed(folder / f"{seed}.npz", image=trajectory.image, action=action)
    return folder


@pytest.mark.slow
def test_a_model_is_pretrained_from_a_folder_and_fine_tuned(
    example, recordings, tmp_path, monkeypatch, capsys
):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    pretrain = example("pretrain_from_folder").main
    model = pretrain(recordings, 2, tmp_path / "run", "debug", **SMALL)
    assert model.pretrain_steps == 2 and "step 2: reconstruction" in capsys.readouterr().out
    dot = example("custom_environment").PushDot
    model_file = tmp_path / "run" / "model.zip"
    example("fine_tune").main(model_file, recordings, dot(), dot(), 100, tmp_path / "best")
    assert re.search(r"policy: return \d+.*prior actor: return \d+", capsys.readouterr().out, re.S)


def test_an_environment_of_ones_own_is_learnt_in(example, capsys):
    example("custom_environment").main(75, **SMALL | {"size": "debug"})
    assert "of at most 25" in capsys.readouterr().out


@pytest.mark.slow
def test_a_continue_head_is_compared_with_none(example, capsys):
    changes = SMALL | {"size": "debug", "imagine_starts": None, "learning_starts": 20}
    returns = example("episodes_that_end").main("InvertedPendulum-v5", 60, 1, **changes)
    assert {name: len(values) for name, values in returns.items()} == {"without": 1, "with": 1}
    assert "seed 0, with a continue head: return" in capsys.readouterr().out


@pytest.mark.slow
def test_pretraining_is_compared_with_scratch(example, tmp_path, capsys):
    compare = example("compare_baseline").main
    scores = compare(3, 50, tmp_path / "data", pretrain_steps=2, **SMALL | {"size": "debug"})
    assert {name: len(values) for name, values in scores.items()} == {
        "pre-trained": 3,
        "from scratch": 3,
    }
    assert capsys.readouterr().out.count("(95 % interval ") == 2


def test_learning_in_blocks_goes_on_from_the_last_one(example, tmp_path, capsys):
    resume, small = example("resume").main, SMALL | {"size": "debug"}
    resume(50, tmp_path, block=25, **small)
    model = resume(75, tmp_path, block=25, **small)
    assert model.num_timesteps == 75 and len(model.replay_buffer) == 75
    assert "continuing after 50 steps" in capsys.readouterr().out
    assert sorted(path.name for path in tmp_path.iterdir()) == ["model.zip", "replay-75.zip"]


@pytest.mark.slow
def test_a_killed_run_is_resumed(tmp_path):
    script = (
        "import sys; sys.path.insert(0, sys.argv[1]); from pathlib import Path; import resume; "
        f"resume.main(int(sys.argv[2]), Path(sys.argv[3]), block=25, size='debug', **{SMALL!r})"
    )
    command = [sys.executable, "-c", script, str(EXAMPLES)]
    process = subprocess.Popen([*command, "100000", str(tmp_path)])
    model_file = tmp_path / "model.zip"
    deadline = time.monotonic() + 300
    while not model_file.exists():
        assert process.poll() is None and time.monotonic() < deadline
        time.sleep(0.05)
    process.send_signal(signal.SIGKILL)
    process.wait()
    again = subprocess.run([*command, "1", str(tmp_path)], capture_output=True, text=True)
    assert again.returncode == 0 and "continuing after" in again.stdout


def test_every_script_is_listed():
    page = (EXAMPLES / "README.md").read_text()
    assert {path.name for path in EXAMPLES.glob("*.py")} == set(re.findall(r"\[(\w+\.py)\]", page))


@pytest.mark.nightly
@pytest.mark.slow
def test_the_script_for_a_gpu_runs_on_a_cpu(tmp_path):
    words = ["bash", str(EXAMPLES / "gpu.sh"), "--quick"]
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    environment = os.environ | {"OUT": str(tmp_path), "PATH": path}
    ran = subprocess.run(words, env=environment, capture_output=True, text=True, timeout=900)
    assert ran.returncode == 0, ran.stdout + ran.stderr
    assert (tmp_path / "bench.jsonl").read_text().count("pre-training") >= 1
    assert len(list((tmp_path / "runs").glob("debug/wpt/*/result.json"))) == 1
