"""The stages that runs share: data, pre-trained model, and the scores of untrained policies.

Each is executed once and reused by later runs; an unfinished one is continued.
"""

import time
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces
from wpt_envs.tasks import Task

from wpt_agents.agents.wpt import WPT
from wpt_agents.data.dataset import TrajectoryDataset
from wpt_agents.files.names import counted
from wpt_agents.training.distributed import World
from wpt_agents.zoo.collect.collection import collect, read_label
from wpt_agents.zoo.judge.evaluation import evaluate
from wpt_agents.zoo.judge.untrained import BASELINES
from wpt_agents.zoo.locks import locked
from wpt_agents.zoo.plan.shared import Shared, given_file, key, named
from wpt_agents.zoo.result import Score, read_score, write_score
from wpt_agents.zoo.terminal import say
from wpt_agents.zoo.text_files import write_json


def collect_data(shared: Shared) -> TrajectoryDataset:
    """Stage 1: collect the dataset, unless it is complete."""
    if shared.given_data is not None:
        dataset = TrajectoryDataset.open(shared.given_data)
        size = counted(len(dataset), "episode")
        say("collect", f"your own data, {size}", shared.data_path)
        _warn_of_differences(shared)
        return dataset
    with locked(shared.cache / f"lock-{shared.data_path.name}", wait=True):
        return _collected(shared)


def _collected(shared: Shared) -> TrajectoryDataset:
    settings = shared.preset.collect
    total = shared.episodes
    stored = shared.stored  # 0 for a damaged dataset, for which `collect` raises the error
    state = "reused" if stored == total else f"continued at {stored} of" if stored else "making"
    names = ", ".join(settings.tasks) or f"all tasks of {shared.suite}"
    episodes = counted(total, "reward-free episode")
    say("collect", f"{state} {episodes} of {names}", shared.data_path)
    return collect(
        shared.data_path,
        shared.tasks,
        settings.episodes,
        settings.seed,
        shared.workers,
        settings.behaviour,
        shared.env,
        settings={"steps": settings.steps} if settings.steps else None,
    )


def _warn_of_differences(shared: Shared) -> None:
    """Warn about data that `collect` recorded with other environment settings than the task's."""
    recorded = read_label(shared.data_path)
    for name, value in recorded.get("env", {}).items():
        ours = shared.env.get(name, value)
        if ours != value:
            say("warning", f"data of {name}={value}, but the task has {name}={ours}")


def pretrain(shared: Shared, dataset: TrajectoryDataset) -> Path:
    """Stage 2: pre-train the model unless it is finished, and return its file."""
    if its_model := shared.given_model:
        say("pretrain", named(its_model), given_file(its_model))
        return given_file(its_model)
    folder = shared.model_path
    world = World.current()
    model = folder / "model.zip"
    done = folder / "done.json"
    with locked(folder / "lock", wait=True) if world.rank == 0 else nullcontext():
        finished = world.rank_0s(done.exists())
        state = "reused" if finished else "continued" if model.exists() else "making"
        updates = counted(shared.preset.pretrain.steps, "update")
        what = "a world model" if shared.agent is WPT else f"the encoder of {shared.agent.__name__}"
        say("pretrain", f"{state} {what} of {updates}", folder)
        if not finished:
            start = time.perf_counter()
            _pretrain(shared, dataset)
            if world.rank == 0:
                write_json(done, {"seconds": round(time.perf_counter() - start, 1)})
    return model


def _pretrain(shared: Shared, dataset: TrajectoryDataset) -> None:
    agent: Any = shared.agent  # SB3's class has no `pretrain`; those of pre-trained methods do
    agent.pretrain(
        dataset,
        steps=shared.preset.pretrain.steps,
        run_dir=shared.model_path,
        seed=shared.preset.pretrain.seed,
        device=shared.device,
        progress_bar=True,
        accumulate=shared.accumulate,
        **shared.pretraining,
    )


def play_untrained(shared: Shared, name: str, task: Task, seed: int) -> Score:
    """Return the score of an untrained policy on a task, evaluated unless it is cached."""
    episodes = shared.preset.evaluate.episodes
    path = shared.cache / f"{name}-{key(task.id, shared.env, episodes, seed)}.json"
    if (known := read_score(path)) is not None:
        return known
    space = spaces.Box(-1.0, 1.0, (task.action_dim,), np.float32)
    score = evaluate(BASELINES[name](space, seed), task.id, shared.env, episodes, seed, name)
    write_score(path, score)
    return score
