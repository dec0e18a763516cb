"""Non-curated data: trajectories without rewards, of noise or of noised scripts, as a dataset.

Example::

    dataset = collect("data", ["wpt/dmc-walker-stand-v0", "wpt/dmc-cartpole-swingup-v0"], 30)
"""

import json
import os
import warnings
import zlib
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from contextlib import closing
from dataclasses import dataclass, field, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import wpt_envs
from gymnasium import spaces

from wpt_agents.dataset import TrajectoryDataset
from wpt_agents.trajectory import Trajectory
from wpt_agents.zoo.progress import progress

COLOURS = ("white", "pink", "ou-4", "ou-16", "ou-64")  # ou-n: correlated over n steps
AMPLITUDES = (0.3, 1.5)  # standard deviation, drawn once an episode, before clipping to [-1, 1]
SIGMAS = (0.1, 0.3, 0.5, 1.0, 2.0)  # Gaussian noise on the scripts' actions, in turn by episode
MAX_STEPS = 1000  # where an environment without a time limit is cut
EPISODES_A_JOB = 4

Act = Callable[[np.ndarray, dict[str, Any], int], np.ndarray]
"""(obs, info, step) -> action (A,) in [-1, 1]."""


def coloured_noise(rng: np.random.Generator, colour: str, length: int, width: int) -> np.ndarray:
    """Stationary noise of unit variance: white, pink (1/f), or Ornstein-Uhlenbeck.

    :return: (length, width)
    """
    white = rng.standard_normal((length, width))
    if colour == "white":
        return white
    if colour == "pink":
        frequency = np.maximum(np.fft.rfftfreq(length), 1 / length)
        gain = frequency**-0.5
        gain /= np.sqrt((gain[:-1] ** 2).mean())
        return np.fft.irfft(np.fft.rfft(white, axis=0) * gain[:, None], n=length, axis=0)
    keep = np.exp(-1 / int(colour.removeprefix("ou-")))
    noise = white.copy()
    for step in range(1, length):
        noise[step] = keep * noise[step - 1] + np.sqrt(1 - keep**2) * white[step]
    return noise


def noise_actions(rng: np.random.Generator, width: int, length: int) -> tuple[Act, str]:
    """An episode's worth of noise of a random colour and amplitude, and its name."""
    colour, amplitude = str(rng.choice(COLOURS)), rng.uniform(*AMPLITUDES)
    noise = np.clip(amplitude * coloured_noise(rng, colour, length, width), -1, 1)
    return lambda obs, info, step: noise[step], f"{colour} noise, amplitude {amplitude:.2f}"


def random_actions(rng: np.random.Generator, width: int, length: int) -> tuple[Act, str]:
    """Uniform actions, each step's drawn anew, and their name."""
    return lambda obs, info, step: rng.uniform(-1, 1, width), "uniform random actions"


def scripted_actions(rng: np.random.Generator, task: str, sigma: float) -> tuple[Act, str]:
    """Meta-World's own scripted policy with Gaussian noise, and its name."""
    from metaworld.policies import ENV_POLICY_MAP  # loads a simulator

    policy = ENV_POLICY_MAP[f"{wpt_envs.TASKS[task].name}-v3"]()  # type: ignore[abstract]

    def act(obs: np.ndarray, info: dict[str, Any], step: int) -> np.ndarray:
        action = policy.get_action(np.asarray(info["state"], np.float64))
        return np.clip(action + rng.normal(0, sigma, len(action)), -1, 1)

    return act, f"scripted policy, sigma {sigma}"


def record(env: gym.Env, act: Act, seed: int, max_steps: int = MAX_STEPS) -> Trajectory:
    """Plays one episode, cut after `max_steps`, and returns it with its rewards."""
    obs, info = env.reset(seed=seed)
    images, actions, rewards = [obs], list[np.ndarray](), list[float]()
    terminated = truncated = False
    while not (terminated or truncated or len(actions) == max_steps):
        action = np.asarray(act(obs, info, len(actions)), np.float32)
        obs, reward, terminated, truncated, info = env.step(action)
        images.append(obs)
        actions.append(action)
        rewards.append(float(reward))
    return Trajectory(
        np.stack(images), np.stack(actions), np.array(rewards, np.float32), bool(terminated)
    )


@dataclass(frozen=True)
class Job:
    """Consecutive episodes of one task, all that a worker needs to know of them."""

    task: str
    first: int
    count: int
    seed: int
    behaviour: str
    env: Mapping[str, Any] = field(default_factory=dict)


def play(job: Job) -> list[Trajectory]:
    """The episodes of a job: a function of the job alone."""
    scripted = job.behaviour == "scripted" and _has_script(job.task)
    env = gym.make(job.task, **job.env, **({"state_in_info": True} if scripted else {}))
    if env.action_space != spaces.Box(-1, 1, env.action_space.shape, np.float32):
        env = gym.wrappers.RescaleAction(env, np.float32(-1), np.float32(1))
    with closing(env), warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Constant\\(s\\) may be too high")  # scripts ask for more
        episodes = range(job.first, job.first + job.count)
        return [_play_episode(env, job, episode) for episode in episodes]


def _play_episode(env: gym.Env, job: Job, episode: int) -> Trajectory:
    task = zlib.crc32(job.task.encode())  # by name: the list of tasks may grow
    source = np.random.SeedSequence([job.seed, task, episode])
    rng = np.random.default_rng(source)
    if job.behaviour == "scripted" and _has_script(job.task):
        act, name = scripted_actions(rng, job.task, SIGMAS[episode % len(SIGMAS)])
    else:
        assert env.action_space.shape is not None
        act, name = noise_actions(rng, env.action_space.shape[0], MAX_STEPS)
    played = record(env, act, int(source.generate_state(1)[0]))
    row = wpt_envs.TASKS.get(job.task)
    robot = row.embodiment if row else None
    return replace(played, reward=None, embodiment=robot, task=job.task, source=name)


def collect(
    path: str | os.PathLike[str],
    tasks: Sequence[str],
    episodes: int,
    seed: int = 0,
    workers: int = 2,
    behaviour: str = "noise",
    env: Mapping[str, Any] | None = None,
    progress_bar: bool = True,
) -> TrajectoryDataset:
    """Plays `episodes` of each task and stores them; what `path` holds already is kept.

    The data are a function of the arguments, `workers` and interruptions apart. Workers are fresh
    processes: call this from a script under `if __name__ == "__main__":`.

    :param path: a folder; a finished one is returned as it is, half of one is continued
    :param tasks: ids for `gymnasium.make`
    :param behaviour: "noise", or "scripted": Meta-World's scripts with noise, elsewhere "noise"
    :param env: keyword arguments of `gymnasium.make`
    """
    _check(tasks, episodes, behaviour)
    env = dict(env or {})
    told = {"tasks": list(tasks), "episodes": episodes, "seed": seed, "behaviour": behaviour}
    dataset = _open(Path(path), {**told, "env": env})
    jobs = [
        Job(task, first, min(EPISODES_A_JOB, episodes - first), seed, behaviour, env)
        for at, task in enumerate(tasks)
        for first in range(_done(dataset, at, episodes), episodes, EPISODES_A_JOB)
    ]
    total = len(tasks) * episodes
    bar = progress(total, "collect", "episodes", len(dataset), hide=not progress_bar or not jobs)
    with bar, dataset:
        for trajectories in _played(jobs, workers):
            for trajectory in trajectories:
                dataset.append(trajectory)
            dataset.flush()
            bar.update(len(trajectories))
    return TrajectoryDataset.open(path)


def _done(dataset: TrajectoryDataset, at: int, episodes: int) -> int:
    """How many episodes of the task number `at` the dataset holds: they come task by task."""
    return min(max(len(dataset) - at * episodes, 0), episodes)


def _check(tasks: Sequence[str], episodes: int, behaviour: str) -> None:
    if not tasks or len(set(tasks)) < len(tasks) or episodes < 1:
        raise ValueError(
            f"collect wants different tasks and at least 1 episode of each, got {list(tasks)} "
            f"and {episodes}"
        )
    if behaviour not in ("noise", "scripted"):
        raise ValueError(f"No behaviour {behaviour!r}. There are: noise, scripted.")
    if behaviour == "scripted" and not any(map(_has_script, tasks)):
        raise ValueError("Scripted policies exist for Meta-World's tasks only; use 'noise'.")


def _has_script(task: str) -> bool:
    row = wpt_envs.TASKS.get(task)
    return row is not None and row.suite == "metaworld"


def _open(path: Path, told: dict[str, Any]) -> TrajectoryDataset:
    """The dataset to append to: a new one, or the one that the same call began."""
    label = path / "collect.json"
    begun = path.exists() and any(path.iterdir())
    dataset = TrajectoryDataset.open(path) if begun else TrajectoryDataset.create(path)
    if not label.exists() and len(dataset) == 0:
        label.write_text(json.dumps(told, indent=1))
    found = json.loads(label.read_text()) if label.exists() else {}
    differ = [key for key in told if found.get(key) != told[key]]
    if differ:
        raise ValueError(
            f"{path} holds something else than this collection (different: {', '.join(differ)}); "
            "give another path, or delete it"
        )
    return dataset


def _played(jobs: Sequence[Job], workers: int) -> Iterator[list[Trajectory]]:
    """The results of the jobs in their order, at most two a worker ahead of the reader."""
    if workers < 2 or len(jobs) < 2:
        yield from map(play, jobs)
        return
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        ahead: deque[Future[list[Trajectory]]] = deque()
        try:
            for job in jobs:
                ahead.append(pool.submit(play, job))
                if len(ahead) >= 2 * workers:
                    yield ahead.popleft().result()
            while ahead:
                yield ahead.popleft().result()
        finally:
            pool.shutdown(wait=True, cancel_futures=True)
