"""How many threads the zoo computes with and how they wait, and the table that compares them."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from typer.testing import CliRunner

from wpt_agents.zoo import machine
from wpt_agents.zoo.bench import threads as bench
from wpt_agents.zoo.commands.app import app

ROOT = Path(__file__).parents[3]


@pytest.fixture
def threads(monkeypatch):
    """The numbers of threads that are set."""
    chosen = []
    monkeypatch.setattr(machine.torch, "set_num_threads", chosen.append)
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    return chosen


def test_narrow_networks_compute_on_one_thread_and_wide_ones_on_all_cores(threads, monkeypatch):
    for size in ("debug", "tiny", "small", "mid", "medium", "paper"):
        machine.choose_threads(size)
    assert threads == [1, 1]
    monkeypatch.setenv("OMP_NUM_THREADS", "2")
    machine.choose_threads("tiny")  # the user has chosen
    assert threads == [1, 1]


@pytest.mark.slow
def test_the_commands_that_compute_here_choose_the_threads_of_their_size(tmp_path, monkeypatch):
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    from wpt_agents.zoo.run import dispatch

    chosen = []
    monkeypatch.setattr(dispatch, "choose_threads", chosen.append)
    monkeypatch.setattr(dispatch, "run_all", lambda *_: True)
    words = ["run", "--tasks", "walker-run", "--preset", "tiny", "--out", str(tmp_path)]
    assert CliRunner().invoke(app, words).exit_code == 0
    assert chosen == ["tiny"]


POLICY = """
import os, runpy, sys
sys.argv = ["zoo", "--help"]
loaded = "torch" in sys.modules
try:
    runpy.run_module("wpt_agents.zoo", run_name="__main__")
except SystemExit:
    print("POLICY", os.environ["OMP_WAIT_POLICY"], loaded)
"""


@pytest.mark.parametrize(("policy", "expected"), [(None, "PASSIVE"), ("ACTIVE", "ACTIVE")])
def test_the_zoo_lets_threads_wait_by_sleeping_unless_told_otherwise(policy, expected):
    environment = {name: v for name, v in os.environ.items() if name != "OMP_WAIT_POLICY"}
    if policy:
        environment["OMP_WAIT_POLICY"] = policy
    words = [sys.executable, "-c", POLICY]
    process = subprocess.run(words, env=environment, cwd=ROOT, capture_output=True, text=True)
    assert process.stdout.splitlines()[-1] == f"POLICY {expected} False", process.stderr


def test_the_table_compares_threads_and_policies_with_and_without_a_neighbour(monkeypatch):
    monkeypatch.setattr(bench, "measured", lambda threads, policy, *_: threads + 0.5)
    ran = CliRunner().invoke(app, ["bench", "threads", "--quick", "--json"])
    assert ran.exit_code == 0, ran.output
    rows = [json.loads(line) for line in ran.stdout.splitlines()]
    cases = [(row["threads"] > 1, row["wait policy"], row["busy neighbours"] > 0) for row in rows]
    kinds = [(False, "default"), (True, "default"), (True, "passive")]
    assert cases == [(*kind, busy) for busy in (False, True) for kind in kinds]
    assert all(row["updates_per_s"] == row["threads"] + 0.5 for row in rows)


@pytest.mark.slow
def test_a_case_is_measured_in_a_process_of_its_own_beside_a_busy_one():
    with bench.busy(1):
        assert bench.measured(2, "passive", "debug", 2, 4, 0.2) > 0
    assert torch.get_num_threads() == 1  # this process is left alone
