"""What two connected processes do, for test_distributed.py; rank 0 keeps the outcomes."""

import json
import os
import signal

import torch
import torch.distributed as dist
from debug_agent import SETTINGS, weights

from wpt_agents.agents.wpt import WPT
from wpt_agents.training import pretraining
from wpt_agents.training.learner import Learner


def train(dataset, **changes):
    """The model, and the metrics of each update."""
    seen = {}
    settings = SETTINGS | {"batch_size": 4, "batch_length": 6, "steps": 6} | changes
    model = WPT.pretrain(
        dataset, callback=lambda step, metrics: seen.update({step: metrics}), **settings
    )
    return model, seen


def together(rank, folder, jobs):
    """Does the jobs, keywords of `train` by name; then rank 1 dies in the middle of the first."""
    torch.set_num_threads(1)
    pretraining.SAVE_EVERY = 2
    meeting = f"file://{folder}/meeting"
    dist.init_process_group("gloo", init_method=meeting, rank=rank, world_size=2)
    for name, changes in jobs.items():
        model, seen = train(folder / "data", **changes)
        assert not seen or rank == 0
        torch.save((seen, weights(model)), folder / f"{name}-{rank}.pt")
    refused = differing(rank, folder)
    if rank == 1:
        die_at_the_fifth_update()
    try:
        train(folder / "data", run_dir=folder / "killed", **next(iter(jobs.values())))
    except RuntimeError as error:
        (folder / "messages.json").write_text(json.dumps([refused, str(error)]))
    # gloo's threads must not outlive the interpreter: one that asks for its lock then aborts
    dist.destroy_process_group()


def differing(rank, folder):
    """What is said to processes that were called differently."""
    try:
        train(folder / "data", steps=6 + rank)
    except ValueError as error:
        return str(error)


def die_at_the_fifth_update():
    step, taken = Learner.take_step, []

    def dying(self, *args):
        taken.append(0)
        if len(taken) == 5:
            os.kill(os.getpid(), signal.SIGKILL)
        return step(self, *args)

    Learner.take_step = dying
