"""Collect data with curious agents: one agent per task, which learns from its own episodes.

Each agent has its own folder, with a dataset and a model file that is written after every episode.
They are sufficient to resume exactly.
"""

from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import wait as wait_for
from contextlib import closing
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from wpt_agents.agents.curious import EXPLORE, EXPLORERS, Explorer
from wpt_agents.data.dataset import TrajectoryDataset
from wpt_agents.data.trajectory import Trajectory
from wpt_agents.zoo.collect.workers import worker_pool
from wpt_agents.zoo.machine import one_thread


@dataclass(frozen=True)
class Expedition:
    """All episodes of one task, with everything that a worker needs.

    :param folder: the agent's folder
    :param settings: keywords of WPT in addition to `EXPLORE`
    """

    task: str
    episodes: int
    seed: int
    behaviour: str
    folder: Path
    make: Callable[[], gym.Env]
    settings: Mapping[str, Any] = field(default_factory=dict)
    embodiment: str | None = None
    rewards: bool = False


def explore(trip: Expedition) -> Iterator[int]:
    """Play the missing episodes of an expedition; yield each episode's number once stored."""
    trip.folder.mkdir(parents=True, exist_ok=True)
    store = TrajectoryDataset.open_or_create(trip.folder / "data")
    if len(store) == trip.episodes:
        return
    # On one thread, the data depend only on the seed.
    with one_thread(), store, closing(trip.make()) as env:
        model = _explorer(trip, env, store)
        for trajectory in model.explore(trip.episodes):
            if len(store) < model.episodes:  # otherwise it was stored before the model
                store.append(_labelled(trajectory, trip, model.episodes))
            model.save(trip.folder / "explorer.zip")
            yield model.episodes


def _explorer(trip: Expedition, env: gym.Env, store: TrajectoryDataset) -> Explorer:
    """Return a new agent, or the one that played the stored episodes."""
    kind = EXPLORERS[trip.behaviour]
    file = trip.folder / "explorer.zip"
    if not file.exists():
        assert env.action_space.shape is not None
        keywords = {**EXPLORE, "max_action_dim": env.action_space.shape[0], **trip.settings}
        return kind("WPTPolicy", env, seed=trip.seed, **keywords)
    model = kind.load(file, env=env)
    for trajectory in store.subset(range(model.episodes)):
        # The agent does not learn from the rewards, but known rewards mark the task's episodes.
        reward = trajectory.reward if trip.rewards else np.zeros(len(trajectory), np.float32)
        model.replay_buffer.add(replace(trajectory, reward=reward))
    return model


def _labelled(trajectory: Trajectory, trip: Expedition, episode: int) -> Trajectory:
    return replace(
        trajectory,
        reward=trajectory.reward if trip.rewards else None,
        embodiment=trip.embodiment,
        task=trip.task,
        source=f"{trip.behaviour}, episode {episode}",
    )


def _explore_all(trip: Expedition) -> None:
    for _ in explore(trip):
        pass


def explore_each(
    trips: list[Expedition], workers: int, moved: Callable[[int], Any]
) -> Iterator[TrajectoryDataset]:
    """Run the expeditions, and return their datasets in order.

    :param moved: called regularly with the number of stored episodes
    """
    if workers < 2 or len(trips) < 2:
        for trip in trips:
            for _ in explore(trip):
                moved(_stored(trips))
            yield TrajectoryDataset.open(trip.folder / "data")
        return
    with worker_pool(workers) as pool:
        futures = [pool.submit(_explore_all, trip) for trip in trips]
        try:
            for trip, future in zip(trips, futures, strict=True):
                while not wait_for([future], timeout=1).done:
                    moved(_stored(trips))
                future.result()
                yield TrajectoryDataset.open(trip.folder / "data")
        finally:
            pool.shutdown(wait=True, cancel_futures=True)


def _stored(trips: list[Expedition]) -> int:
    paths = [trip.folder / "data" for trip in trips]
    return sum(len(TrajectoryDataset.open(p)) for p in paths if (p / "meta.json").exists())
