"""A benchmark of several runs that is killed, or of which one run always fails."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from dot_runs import dot, job  # noqa: F401  (dot registers the task for each test)

from wpt_agents.zoo.result import read_result
from wpt_agents.zoo.results import find_results
from wpt_agents.zoo.run import runner

pytestmark = pytest.mark.slow  # whole runs
SEEDS = range(4)
LEARN = {"learn": {"frames": 75, "checkpoint_every": 25}}

SCRIPT = """
import signal, sys; sys.path[:0] = {places!r}
from pathlib import Path
import dot_runs, gymnasium
from engine_work import do_dot
from test_interrupted_benchmark import SEEDS
from wpt_envs.tasks import TASKS
from wpt_agents.zoo.run import engines
engines.do = do_dot
if __name__ == "__main__":
    TASKS[dot_runs.DOT.id] = dot_runs.DOT
    signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored in background jobs
    gymnasium.register(dot_runs.DOT.id, entry_point=dot_runs.make_dot)
    jobs = [dot_runs.job(Path({out!r}), "scratch", seed, learn={learn!r}) for seed in SEEDS]
    sys.exit(not engines.run_on("local", jobs, False, engines.Resources(workers=4)))
"""


def orchestrator(folder, **learn):
    """The process that does all runs, with a worker for each."""
    tests = Path(__file__).parents[2]
    places = [str(tests / "zoo" / "run"), str(tests / "helpers"), str(tests / "agents")]
    script = folder / "benchmark.py"
    learn = LEARN["learn"] | learn
    script.write_text(SCRIPT.format(places=places, out=str(folder / "runs"), learn=learn))
    path = os.pathsep.join([*places, *filter(None, sys.path)])
    return subprocess.Popen(
        [sys.executable, str(script)],
        env=os.environ | {"PYTHONPATH": path, "OMP_NUM_THREADS": "1"},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        start_new_session=True,
    )


def until(true, process, seconds=300):
    end = time.monotonic() + seconds
    while not true():
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < end
        time.sleep(0.02)


def untimed(result):
    return {name: score.returns for name, score in result.scores.items()}, result.updates


@pytest.mark.nightly
def test_a_benchmark_killed_twice_ends_with_each_run_once_and_finished_ones_untouched(tmp_path):
    broken = [job(tmp_path / "runs", "scratch", seed, **LEARN) for seed in SEEDS]

    def finished():
        return [one for one in broken if (one.folder / "result.json").exists()]

    process = orchestrator(tmp_path)
    until(lambda: all((one.folder / "0.monitor.csv").exists() for one in broken), process)
    process.send_signal(signal.SIGKILL)  # with four runs in flight
    process.communicate()
    assert finished() == []
    process = orchestrator(tmp_path)
    until(finished, process)
    process.send_signal(signal.SIGKILL)
    process.communicate()
    done = {one.folder: (one.folder / "result.json").stat().st_mtime_ns for one in finished()}
    process = orchestrator(tmp_path)
    _, said = process.communicate(timeout=600)
    assert process.returncode == 0, said.decode()
    for folder, when in done.items():
        assert (folder / "result.json").stat().st_mtime_ns == when
    whole = [job(tmp_path / "whole", "scratch", seed, **LEARN) for seed in SEEDS]
    assert runner.run_all(whole)
    assert len(find_results(tmp_path / "runs")) == len(SEEDS)
    for one, other in zip(broken, whole, strict=True):
        assert untimed(read_result(one.folder)) == untimed(read_result(other.folder))


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_stopped_benchmark_has_a_checkpoint_of_each_runs_last_episode(number, tmp_path):
    runs = [job(tmp_path / "runs", "scratch", seed, **LEARN) for seed in SEEDS]
    process = orchestrator(tmp_path, checkpoint_every=1000, frames=2000)
    logs = [one.folder / "0.monitor.csv" for one in runs]
    until(lambda: all(log.exists() and log.read_text().count("\n") > 2 for log in logs), process)
    if number == signal.SIGINT:
        os.killpg(process.pid, number)  # as a terminal does
    else:
        process.send_signal(number)
    _, said = process.communicate(timeout=300)
    assert process.returncode == -number, said.decode()
    for one, log in zip(runs, logs, strict=True):
        steps = sum(int(row.split(",")[1]) for row in log.read_text().splitlines()[2:])
        (written,) = (one.folder / "checkpoints").iterdir()
        assert written.name == f"step-{steps:09}"


def test_a_run_that_always_fails_leaves_the_others_and_is_named_with_its_log(
    tmp_path, monkeypatch, capsys
):
    jobs = [job(tmp_path, "scratch", seed) for seed in range(3)]
    learn = runner.learn

    def fail_seed_1(one, *rest):
        if one.seed == 1:
            raise RuntimeError("out of luck")
        return learn(one, *rest)

    monkeypatch.setattr(runner, "learn", fail_seed_1)
    assert not runner.run_all(jobs)  # the command then ends with exit code 1
    said = capsys.readouterr().out
    assert [read_result(one.folder) is not None for one in jobs] == [True, False, True]
    assert "out of luck" in said and "error.txt" in said
    assert len(find_results(tmp_path)) == 2  # means are over two, and their number is shown
