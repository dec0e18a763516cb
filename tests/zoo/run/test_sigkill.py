"""Runs that SIGKILL ends in their own process, each method of the paper: they end alike."""

import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from dot_runs import dot, job  # noqa: F401  (dot registers the task for each test)
from test_resume import CHANGES, METHODS, assert_equal, data_of, left

from wpt_agents.zoo.run.runner import run

pytestmark = pytest.mark.slow  # whole runs

SCRIPT = """
import sys; sys.path[:0] = {tests!r}
from pathlib import Path
import dot_runs, gymnasium
from wpt_envs.tasks import TASKS
from test_resume import CHANGES
from wpt_agents.zoo.run.runner import run
TASKS[dot_runs.DOT.id] = dot_runs.DOT
gymnasium.register(dot_runs.DOT.id, entry_point=dot_runs.make_dot)
run(dot_runs.job(Path({out!r}), {method!r}, data={data} and Path({data}), **CHANGES))
"""


@pytest.mark.parametrize(
    ("method", "moments"),
    [
        ("wpt", (1, 2, 4)),
        *(pytest.param(m, (2,), marks=pytest.mark.nightly) for m in METHODS if m != "wpt"),
    ],
)
def test_sigkill_at_random_moments_costs_nothing_that_was_kept(method, moments, tmp_path):
    data = data_of(method, tmp_path)
    whole, broken = (
        job(tmp_path / name, method, data=data, **CHANGES) for name in ("whole", "broken")
    )
    run(whole)
    here = Path(__file__).parent
    script = SCRIPT.format(
        tests=[str(here), str(here.parents[1] / "helpers")],
        out=str(tmp_path / "broken"),
        method=method,
        data=repr(data and str(data)),
    )
    rng, monitor = random.Random(0), broken.folder / "0.monitor.csv"
    for episodes in (*moments, None):  # after which it is killed, at some moment of the next one
        child = subprocess.Popen(
            [sys.executable, "-c", script],
            env={**os.environ, "OMP_NUM_THREADS": "1"},
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
        )
        if episodes is not None:
            while not monitor.exists() or monitor.read_text().count("\n") < 2 + episodes:
                assert child.poll() is None, child.communicate()
                time.sleep(0.005)
            time.sleep(rng.uniform(0, 0.2))
            child.send_signal(signal.SIGKILL)
        _, said = child.communicate(timeout=300)
        assert child.returncode == (0 if episodes is None else -signal.SIGKILL), said.decode()
    assert_equal(left(broken.folder), left(whole.folder))
