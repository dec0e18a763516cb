"""A batch divided over processes or passes teaches what the undivided one does, to rounding."""

import json
import os
import signal
import subprocess
import sys
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pytest
import torch
from debug_agent import recorded, weights
from two_processes import together, train

from wpt_agents.data.dataset import TrajectoryDataset
from wpt_agents.files.model_file import read_model
from wpt_agents.model.distributions import Share, exponential
from wpt_agents.model.world_model import world_model_loss
from wpt_agents.training.distributed import World
from wpt_agents.training.divided import part_total
from wpt_agents.zoo.commands import app as command_line

JOBS = {
    "mean": {},  # free nats that the KL crosses on its way are put in below
    "element": {"free_nats_mode": "element"},
    "passes": {"accumulate": 2},
    "bf16": {"precision": "bf16"},
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("many")
    with TrajectoryDataset.create(path / "data") as dataset:
        dataset.extend(recorded(length=12, seed=i) for i in range(6))
    return path


@pytest.fixture(scope="module")
def jobs(folder):
    _, seen = train(folder / "data")
    free = float(np.median([metrics["train/kl"] for metrics in seen.values()]))
    return {name: changes | {"free_nats": free} for name, changes in JOBS.items()}


@pytest.fixture(scope="module")
def alone(folder, jobs):
    """Metrics and weights of the jobs, each done by one process in one pass."""
    settings = {name: job for name, job in jobs.items() if "accumulate" not in job}
    done = {name: train(folder / "data", **job) for name, job in settings.items()}
    done = {name: (seen, weights(model)) for name, (model, seen) in done.items()}
    return done | {"passes": done["mean"]}


@pytest.fixture(scope="module")
def pair(folder, jobs):
    """The folder after two processes have done the jobs together, and the second has died."""
    train(folder / "data", run_dir=folder / "alone", **jobs["mean"] | {"steps": 3})
    resumed = jobs["mean"] | {"run_dir": folder / "alone"}
    more = {"resumed": resumed, "unseeded": {"seed": None, "steps": 1}}
    spawn = get_context("spawn")
    processes = [
        spawn.Process(target=together, args=(rank, folder, jobs | more)) for rank in (0, 1)
    ]
    for process in processes:
        process.start()
    for process in processes:
        process.join(600)
    assert [process.exitcode for process in processes] == [0, -signal.SIGKILL]
    return folder


def assert_equal(seen, after, expected, expected_after, rtol=1e-4):
    assert seen.keys() <= expected.keys() and seen
    for step, metrics in seen.items():
        assert metrics == pytest.approx(expected[step], rel=rtol), step
    assert_close(after, expected_after, rtol)


def assert_close(after, expected_after, rtol=1e-4):
    for name, weight in after.items():
        # Adam's first steps divide by the gradient itself: where that is nearly zero, rounding
        # moves a weight by up to the learning rate, 1e-3; hardly any is
        assert (weight - expected_after[name]).abs().mean() < 0.2 * rtol, name


# ------------------------------------------------------------------------------- in one process


def test_shares_of_the_draws_are_the_draws():
    whole = exponential(torch.empty(6, 3, 2), torch.Generator().manual_seed(1))
    shares = [Share("cpu", 6, first).manual_seed(1) for first in (0, 2, 4)]
    assert torch.cat([exponential(torch.empty(2, 3, 2), s) for s in shares]).equal(whole)


def test_shares_of_a_batch_are_the_batch(folder):
    dataset = TrajectoryDataset.open(folder / "data")
    whole, *shares = (
        dataset.sample(6, 20, rng=np.random.default_rng(1), share=share)
        for share in (slice(None), *(World(rank, 3).share(6) for rank in range(3)))
    )
    assert torch.cat([share.image for share in shares]).equal(whole.image)
    assert torch.cat([share.action for share in shares]).equal(whole.action)
    assert [len(part.image) for part in whole.split(2)] == [3, 3]
    assert torch.cat([part.is_first for part in whole.split(3)]).equal(whole.is_first)


@pytest.mark.parametrize("free_nats", [0.1, 0.4, 2.0])
def test_shares_clip_the_kl_where_the_whole_batch_does(free_nats):
    error = torch.zeros(2, 1)
    # one sequence's KL(q || p) is .8 ln(.8 / .5) + .2 ln(.2 / .5) = .193, the other's .95 ln(1.9) +
    # .05 ln(.1) = .495; the mean is .344: .4 clips the whole batch, but not the second row alone
    post = torch.tensor([[0.8, 0.2], [0.95, 0.05]]).log().view(2, 1, 1, 2).requires_grad_()
    prior = torch.full((2, 1, 1, 2), 0.5).log().requires_grad_()
    whole = world_model_loss(error, post, prior, free_nats=free_nats)
    totals = []
    for row in (slice(0, 1), slice(1, 2)):
        part = world_model_loss(error[row], post[row], prior[row], free_nats=0.0)
        totals.append(part_total(part, whole.kl, free_nats))
    if free_nats < whole.kl:  # else the whole batch's total has a constant
        assert sum(totals).item() / 2 == pytest.approx(whole.total.item(), rel=1e-5)
    expected = torch.autograd.grad(whole.total, (post, prior))
    gradients = torch.autograd.grad(sum(totals) / 2, (post, prior))
    torch.testing.assert_close(gradients, expected, atol=1e-6, rtol=0)


@pytest.mark.parametrize("name", ["mean", "element"])
def test_several_passes_over_a_batch_are_one(folder, jobs, alone, name):
    model, seen = train(folder / "data", **jobs[name], accumulate=4)
    assert_equal(seen, weights(model), *alone[name])
    kls, free = [metrics["train/kl"] for metrics in seen.values()], jobs[name]["free_nats"]
    assert min(kls) < free < max(kls)


@pytest.mark.parametrize("accumulate", [0, 3])
def test_a_batch_that_cannot_be_divided_is_refused(folder, accumulate):
    with pytest.raises(ValueError, match=rf"batch_size=4 cannot.*accumulate={accumulate}"):
        train(folder / "data", accumulate=accumulate)


def test_run_is_refused_under_torchrun(monkeypatch, capsys):
    monkeypatch.setenv("RANK", "0")
    monkeypatch.setenv("WORLD_SIZE", "2")
    monkeypatch.setattr(sys, "argv", ["zoo", "run", "--dry-run"])
    with pytest.raises(SystemExit):
        command_line.main()
    assert "torchrun is for `pretrain`" in capsys.readouterr().err


# ------------------------------------------------------------------------------ in two processes


@pytest.mark.slow
@pytest.mark.parametrize("name", JOBS)
def test_two_processes_learn_what_one_does(pair, alone, name):
    seen, after = torch.load(pair / f"{name}-0.pt")
    assert list(seen) == [1, 2, 3, 4, 5, 6]
    # bf16 keeps 8 bits, and rounding can change which class of a latent is drawn
    assert_equal(seen, after, *alone[name], 5e-2 if name == "bf16" else 1e-4)


@pytest.mark.parametrize("name", [*JOBS, "unseeded"])
def test_both_processes_end_with_the_same_model(pair, name):
    after, also = (torch.load(pair / f"{name}-{rank}.pt")[1] for rank in (0, 1))
    assert all(after[key].equal(also[key]) for key in after)


def test_two_processes_go_on_from_the_checkpoint_of_one(pair, alone):
    seen, after = torch.load(pair / "resumed-0.pt")
    assert list(seen) == [4, 5, 6]
    assert_equal(seen, after, *alone["mean"])


def test_one_process_goes_on_from_what_a_pair_left_of_which_one_was_killed(pair, jobs, alone):
    left = {path.name.partition(".")[0] for path in (pair / "killed").iterdir()}
    assert left == {"model", "progress", "events"}
    header, _ = read_model(pair / "killed" / "model.zip")
    assert header["counters"]["pretrain_steps"] == 4  # of the five made, SAVE_EVERY being 2
    model, seen = train(pair / "data", run_dir=pair / "killed", **jobs["mean"])
    assert list(seen) == [5, 6]
    assert_equal(seen, weights(model), *alone["mean"])


def test_processes_called_differently_are_refused(pair):
    refused, _ = json.loads((pair / "messages.json").read_text())
    assert "differ in steps, by rank: [6, 7]" in refused


def torchrun(*words):
    """Two processes of it, and what they said; they must end well."""
    root = Path(__file__).parents[2]
    path = os.pathsep.join([str(root), str(root / "envs"), os.environ.get("PYTHONPATH", "")])
    start = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node=2"]
    done = subprocess.run(
        [*start, *words],
        env=os.environ | {"PYTHONPATH": path, "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    return done


@pytest.mark.nightly  # half a minute
@pytest.mark.slow
def test_processes_connect_again_after_they_parted_and_after_one_was_restarted():
    said = torchrun(
        "--max-restarts=1", Path(__file__).parents[1] / "helpers" / "restarted.py"
    ).stdout
    for rank in range(2):
        for meeting in range(2):
            assert f"rank {rank}, attempt 1, meeting {meeting}" in said
    assert "rank 1, attempt 0, meeting 1" not in said


@pytest.mark.slow
def test_a_sigterm_to_one_process_stops_all_and_torchrun_goes_on_to_the_same_model(
    folder, tmp_path
):
    script = Path(__file__).parents[1] / "helpers" / "terminated.py"
    torchrun("--max-restarts=1", script, folder / "data", tmp_path)
    # all stopped, at an update of which both have the weights, and no earlier than the last
    # checkpoint; rank 0 had not finished
    (attempt,) = tmp_path.glob("attempt-*.json")
    assert attempt.name == "attempt-1.json"
    updates = json.loads(attempt.read_text())
    assert updates[0] in (5, 6) and updates[-1] == 6
    model, _ = train(folder / "data")
    header, tensors = read_model(tmp_path / "model.zip")
    assert header["counters"]["pretrain_steps"] == 6
    assert_close(tensors["policy"], weights(model))


@pytest.mark.slow
def test_torchrun_pretrains_by_the_command_line_and_only_rank_0_speaks(folder, tmp_path):
    sizes = ["batch_size=2", "batch_length=4", "size=debug", "pretrain.steps=3"]
    options = ["--data", folder / "data", "--out", tmp_path, "--preset", "debug", "--device", "cpu"]
    done = torchrun("-m", "wpt_agents.zoo", "pretrain", *options, "--set", *sizes)
    said = [line.split()[0] for line in done.stdout.splitlines()]
    assert said == ["collect", "pretrain", "Model:"]
    [model] = (tmp_path / "cache").glob("model-*")
    assert {"model.zip", "done.json", "progress.csv"} <= {path.name for path in model.iterdir()}
    assert len(list(model.glob("events.*"))) == 1
    assert read_model(model / "model.zip")[0]["counters"]["pretrain_steps"] == 3
