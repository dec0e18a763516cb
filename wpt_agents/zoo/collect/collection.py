"""Collect reward-free trajectories of noise, noisy policies or curious agents.

Example::

    dataset = collect("data", ["wpt/dmc-walker-stand-v0", "wpt/dmc-cartpole-swingup-v0"], 30)
"""

import json
import math
import os
import shutil
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from tqdm.auto import tqdm

from wpt_agents.agents.curious import EXPLORE, EXPLORERS
from wpt_agents.data.dataset import TrajectoryDataset
from wpt_agents.files.archive import replacing
from wpt_agents.files.names import unknown_name
from wpt_agents.training.hyperparameters import Hyperparameters
from wpt_agents.zoo.collect.behaviours import EXPLORATION_KEYWORDS
from wpt_agents.zoo.collect.curious import Expedition, explore_each
from wpt_agents.zoo.collect.episodes import (
    SIGMAS,
    STATE_CURIOSITY,
    Job,
    Recipe,
    has_script,
    make_env,
    play,
    robot_of,
)
from wpt_agents.zoo.collect.policies import load_policy
from wpt_agents.zoo.collect.state_curiosity import STAGES, exploration_folder, write_stages
from wpt_agents.zoo.collect.workers import worker_pool
from wpt_agents.zoo.terminal import progress

NOISY = ("scripted", "policy")  # behaviours with noise of `sigmas`
CURIOUS = (STATE_CURIOSITY, *EXPLORERS)  # behaviours with `settings`
BEHAVIOURS = ("random", "noise", *NOISY, *CURIOUS)
EPISODES_A_JOB = 4
LABEL = "collect.json"  # beside the data: `Recipe.label`, tasks and episodes
Work = TypeVar("Work")
Result = TypeVar("Result")


def collect(
    path: str | os.PathLike[str],
    tasks: str | Sequence[str],
    episodes: int,
    seed: int = 0,
    workers: int = 2,
    behaviour: str = "noise",
    env: Mapping[str, Any] | None = None,
    progress_bar: bool = True,
    *,
    rewards: bool = False,
    sigmas: Sequence[float] = SIGMAS,
    policy: str | None = None,
    settings: Mapping[str, Any] | None = None,
) -> TrajectoryDataset:
    """Play episodes of each task and store them in a dataset, without rewards by default.

    The same arguments and seed give the same data with any number of workers, and after
    interruptions. Several workers are separate processes, so call this from a script
    under `if __name__ == "__main__":`.

    :param path: a folder; a finished collection is returned unchanged, an unfinished one continued
    :param tasks: ids for `gymnasium.make`, or one of them
    :param episodes: number of episodes of each task
    :param seed: seed of the episodes
    :param workers: number of processes
    :param behaviour: "noise", of random colour and strength; "random", uniform; "scripted",
        Meta-World's scripts with noise, elsewhere "noise"; "policy", a saved one with noise; "icm"
        or "plan2explore", a curious agent for each task, which learns from pixels;
        "explore-state", one that learns from the simulator's state, at five stages of its training
    :param env: keyword arguments of `gymnasium.make`
    :param progress_bar: show a progress bar
    :param rewards: store the rewards, too
    :param sigmas: standard deviations of the Gaussian noise on scripted and saved policies, which
        the episodes use in turn
    :param policy: a model file of WPT or a baseline, or one of SB3's as "sac:expert.zip". It takes
        images, or the simulator's state if it was trained on states
    :param settings: keywords of WPT for a curious agent, in addition to `curious.EXPLORE`; `steps`
        of "explore-state"
    :return: the dataset at `path`
    :raises ValueError: names, options or settings that do not fit, or another collection at `path`
    """
    tasks = [tasks] if isinstance(tasks, str) else list(tasks)
    _check(tasks, episodes, behaviour, policy)
    _check_options(behaviour, sigmas, settings or {})
    _check_settings(behaviour, settings or {})
    recipe = Recipe(
        seed, behaviour, dict(env or {}), rewards, tuple(sigmas), policy, dict(settings or {})
    )
    description = {"tasks": list(tasks), "episodes": episodes, **recipe.label()}
    dataset = _open(Path(path), description)
    total = len(tasks) * episodes
    if dataset.appended > total:
        raise ValueError(
            f"{path} holds {dataset.appended} episodes, more than the {total} of this collection: "
            "two processes have collected into it at once; delete it and collect again"
        )
    if dataset.appended == total:
        return dataset
    gather = _collect_played
    if behaviour in EXPLORERS:
        gather = _collect_curious
    if behaviour == STATE_CURIOSITY:
        gather = _collect_state_curious
    label = f"collect {behaviour}"
    with dataset:
        dataset.reserve()  # before counting the missing episodes
        with progress(total, label, "episodes", dataset.appended, not progress_bar) as bar:
            try:
                gather(dataset, tasks, episodes, recipe, workers, bar)
            finally:
                # the folder of a mistake, such as another robot's policy, is free for another call
                if dataset.appended == 0 and not any(dataset.path.glob("exploring-*")):
                    (dataset.path / LABEL).unlink()
        for folder in dataset.path.glob("exploring-*"):
            shutil.rmtree(folder)
    return TrajectoryDataset.open(path)


def _collect_state_curious(
    dataset: TrajectoryDataset,
    tasks: Sequence[str],
    episodes: int,
    recipe: Recipe,
    workers: int,
    bar: "tqdm[None]",
) -> None:
    """Explore each task by its state, then record images of the exploration's stages."""
    left = [t for at, t in enumerate(tasks) if _done(dataset, at, episodes) < episodes]
    write = partial(
        write_stages, dataset.path, env=recipe.env, seed=recipe.seed, settings=recipe.settings
    )
    for _ in _in_order(write, left, workers):
        bar.refresh()
    _collect_played(
        dataset, tasks, episodes, replace(recipe, stages=str(dataset.path)), workers, bar
    )


def _collect_played(
    dataset: TrajectoryDataset,
    tasks: Sequence[str],
    episodes: int,
    recipe: Recipe,
    workers: int,
    bar: "tqdm[None]",
) -> None:
    jobs = [
        Job(task, first, min(EPISODES_A_JOB, episodes - first), recipe)
        for at, task in enumerate(tasks)
        for first in range(_done(dataset, at, episodes), episodes, EPISODES_A_JOB)
    ]
    for trajectories in _in_order(play, jobs, workers):
        for trajectory in trajectories:
            dataset.append(trajectory)
        dataset.flush()
        bar.update(len(trajectories))


def _collect_curious(
    dataset: TrajectoryDataset,
    tasks: Sequence[str],
    episodes: int,
    recipe: Recipe,
    workers: int,
    bar: "tqdm[None]",
) -> None:
    """Let one agent per task collect into a separate folder, then add its data to the dataset."""
    trips = [
        Expedition(
            task,
            episodes,
            recipe.seed,
            recipe.behaviour,
            exploration_folder(dataset.path, task),
            partial(make_env, task, recipe),
            recipe.settings,
            robot_of(task),
            recipe.rewards,
        )
        for at, task in enumerate(tasks)
        if _done(dataset, at, episodes) < episodes
    ]
    finished = (len(tasks) - len(trips)) * episodes

    def moved(stored: int) -> None:
        bar.update(finished + stored - bar.n)

    for gathered in explore_each(trips, workers, moved):
        dataset.extend(gathered.subset(range(dataset.appended % episodes, episodes)))
        dataset.flush()
    moved(len(trips) * episodes)


def _done(dataset: TrajectoryDataset, at: int, episodes: int) -> int:
    """Return the number of stored episodes of task number `at`; they are stored task by task."""
    return min(max(dataset.appended - at * episodes, 0), episodes)


def _check(tasks: Sequence[str], episodes: int, behaviour: str, policy: str | None) -> None:
    if not tasks or len(set(tasks)) < len(tasks) or episodes < 1:
        raise ValueError(
            f"collect needs different tasks and at least 1 episode of each, got {list(tasks)} "
            f"and {episodes}"
        )
    if behaviour not in BEHAVIOURS:
        raise unknown_name("behaviour", behaviour, BEHAVIOURS)
    if behaviour == "scripted" and not any(map(has_script, tasks)):
        raise ValueError(
            "Scripted policies exist for Meta-World's tasks only; use the behaviour 'noise'."
        )
    if (behaviour == "policy") != (policy is not None):
        raise ValueError(
            "policy=FILE (--policy FILE) belongs to the behaviour 'policy', which needs it."
        )
    if policy is not None:
        load_policy(policy)  # raises an error if the policy is invalid


def _check_options(behaviour: str, sigmas: Sequence[float], settings: Mapping[str, Any]) -> None:
    """Raise an error for options that are invalid or have no effect on the behaviour."""
    if not sigmas or not all(0 <= sigma < math.inf for sigma in sigmas):
        raise ValueError(f"sigmas (--sigma) must be numbers of at least 0, got {list(sigmas)}")
    if tuple(sigmas) != SIGMAS and behaviour not in NOISY:
        raise ValueError(
            f"sigmas (--sigma) have no effect on the behaviour {behaviour!r}: leave them out, or "
            f"take {' or '.join(NOISY)}"
        )
    if settings and behaviour not in CURIOUS:
        raise ValueError(
            f"settings (--set) have no effect on the behaviour {behaviour!r}: leave them out, or "
            f"take {', '.join(CURIOUS)}"
        )


def _check_settings(behaviour: str, settings: Mapping[str, Any]) -> None:
    if behaviour != STATE_CURIOSITY:
        Hyperparameters.of({**EXPLORE, **settings})
        return
    for name, value in settings.items():
        if name not in EXPLORATION_KEYWORDS:
            raise unknown_name("setting of explore-state", name, EXPLORATION_KEYWORDS)
        if not isinstance(value, int) or value < STAGES:
            raise ValueError(f"steps must be a whole number of at least {STAGES}, got {value!r}")


def _open(path: Path, description: dict[str, Any]) -> TrajectoryDataset:
    """Return the dataset to append to: a new one, or the unfinished one of the same call."""
    label = path / LABEL
    dataset = TrajectoryDataset.open_or_create(path)
    if not label.exists() and dataset.appended == 0:
        with replacing(label) as temporary:
            temporary.write_text(json.dumps(description, indent=1), encoding="utf-8")
    stored = read_label(path)
    differ = [key for key in {**description, **stored} if stored.get(key) != description.get(key)]
    if differ:
        raise ValueError(
            f"{path} contains another collection (different: {', '.join(differ)}); choose another "
            "path, or delete it"
        )
    return dataset


def read_label(folder: Path) -> dict[str, Any]:
    """Return how a dataset was collected, empty if its folder does not say it.

    :raises ValueError: if the file is damaged
    """
    file = folder / LABEL
    try:
        return json.loads(file.read_text(encoding="utf-8")) if file.exists() else {}
    except ValueError as error:
        raise ValueError(
            f"{file} is damaged ({error}); restore the file, or use another path"
        ) from error


def _in_order(
    function: Callable[[Work], Result], jobs: Sequence[Work], workers: int
) -> Iterator[Result]:
    """Yield results in the jobs' order, at most two per worker ahead of the consumer."""
    if workers < 2 or len(jobs) < 2:
        yield from map(function, jobs)
        return
    with worker_pool(workers) as pool:
        ahead: deque[Future[Result]] = deque()
        try:
            for job in jobs:
                ahead.append(pool.submit(function, job))
                if len(ahead) >= 2 * workers:
                    yield ahead.popleft().result()
            while ahead:
                yield ahead.popleft().result()
        finally:
            pool.shutdown(wait=True, cancel_futures=True)
