"""The accuracy of retrieval in a mixed dataset, and the cost of the index at the paper's size.

Queries are the first images of fresh episodes, as in fine-tuning; the search knows neither the
robot's name nor its action width. Data and model are kept in `runs/bench/retrieval`.
"""

import time
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from wpt_envs.tasks import TASKS

from wpt_agents.agents.wpt import WPT
from wpt_agents.data.dataset import TrajectoryDataset
from wpt_agents.data.retrieval import Retriever
from wpt_agents.zoo.bench.timing import memory_mib
from wpt_agents.zoo.collect.collection import collect
from wpt_agents.zoo.collect.workers import worker_pool

FOLDER = Path("runs") / "bench" / "retrieval"
DMC = ("cartpole-swingup", "acrobot-swingup", "cheetah-run", "walker-run", "quadruped-run")
METAWORLD = (
    *("assembly", "button-press-topdown", "coffee-pull", "door-open", "drawer-close", "hammer"),
    *("pick-place", "plate-slide", "soccer", "window-open"),
)
TASK_IDS = [f"wpt/dmc-{name}-v0" for name in DMC] + [f"wpt/metaworld-{n}-v0" for n in METAWORLD]
LOOK: dict[str, Any] = {"rendering": "fast"}
EPISODES = 20  # of each task
STEPS = 2000  # updates of the world model
NEAREST = 10  # trajectories that a query searches for
QUERIES = 10  # for each task
MODEL: dict[str, Any] = {"size": "tiny", "max_action_dim": 12, "batch_size": 8, "batch_length": 16}
PAPER = 60_000, 3072  # trajectories, and the width of `paper`'s features

# A suite, the column of its share, and the column of the share for a random choice.
COLUMNS = (
    ("dmc", "own robot, DMControl", "by chance"),
    ("metaworld", "own task, Meta-World", "by chance "),  # a unique key
)

Embed = Callable[[np.ndarray], np.ndarray]  # (n, 64, 64, 3) uint8 -> (n, E) float32


class Queries(NamedTuple):
    """The first images of new episodes."""

    image: np.ndarray  # (N, 64, 64, 3) uint8
    task: list[str]


def rows(quick: bool = False) -> Iterator[dict[str, Any]]:
    """Yield the share of nearest neighbours of the query's own kind, then time and memory."""
    if quick:
        yield index_cost(2_000, 64)
        return
    dataset = collect(FOLDER / "data", TASK_IDS, EPISODES, 0, 2, "scripted", LOOK)
    asked = fresh_queries(TASK_IDS, QUERIES)
    trained = WPT.pretrain(
        dataset, steps=STEPS, seed=0, run_dir=FOLDER / "model", device="cpu", progress_bar=True,
        **MODEL,
    )  # fmt: skip
    encoders: dict[str, Embed] = {f"pre-trained, {STEPS} updates": trained.policy.embed}
    for seed in range(3):
        untrained = WPT("WPTPolicy", seed=seed, device="cpu", **MODEL)
        encoders[f"untrained, seed {seed}"] = untrained.policy.embed
    encoders["raw pixels"] = pixels
    for name, embed in encoders.items():
        yield {"features": name, **shares(dataset, embed, asked, NEAREST)}
    yield index_cost(*PAPER)


def pixels(image: np.ndarray) -> np.ndarray:
    """(n, 64, 64, 3) uint8 -> (n, 12288) float32."""
    return image.reshape(len(image), -1).astype(np.float32)


def fresh_queries(tasks: list[str], number: int) -> Queries:
    """Return first images of `number` episodes of each task, with seeds not used for collecting."""
    images = []
    for task in tasks:
        with closing(gym.make(task, **LOOK)) as env:
            images += [env.reset(seed=10**6 + i)[0] for i in range(number)]
    return Queries(np.stack(images), [task for task in tasks for _ in range(number)])


def shares(dataset: TrajectoryDataset, embed: Embed, asked: Queries, k: int) -> dict[str, Any]:
    """Return the share of the k nearest of the right robot (DMControl) or task (Meta-World)."""
    retriever = Retriever.build(dataset, embed, "bench")
    robots, tasks = np.array(dataset.embodiments), np.array(dataset.tasks)
    hits: dict[str, list[float]] = {suite: [] for suite, *_ in COLUMNS}
    chance: dict[str, list[float]] = {suite: [] for suite, *_ in COLUMNS}
    for task, feature in zip(asked.task, embed(asked.image), strict=True):
        row = TASKS[task]
        same = robots == row.embodiment if row.suite == "dmc" else tasks == task
        hits[row.suite].append(float(same[retriever.search(feature, k)[0]].mean()))
        chance[row.suite].append(float(same.mean()))
    columns: dict[str, Any] = {"queries": len(asked.task)}
    for suite, share, share_by_chance in COLUMNS:
        columns |= {share: _mean(hits[suite]), share_by_chance: _mean(chance[suite])}
    return columns


def _mean(values: list[float]) -> float | None:
    return round(float(np.mean(values)), 3) if values else None


class _Blank:
    """The part of a dataset that the index uses: black first images."""

    def __init__(self, length: int) -> None:
        self.length = length
        self.embodiments = [None] * length
        self.fingerprint = "blank"
        self.action_dims = np.full(length, 6)

    def __len__(self) -> int:
        return self.length

    def first_observations(self, batch: int = 1024) -> Iterator[np.ndarray]:
        for at in range(0, self.length, batch):
            yield np.zeros((min(batch, self.length - at), 64, 64, 3), np.uint8)


def index_cost(trajectories: int, width: int) -> dict[str, Any]:
    """Measure time and peak memory of building and searching, in a new process."""
    with worker_pool(1) as pool:
        return pool.submit(_index_cost, trajectories, width).result()


def _index_cost(trajectories: int, width: int) -> dict[str, Any]:
    rng = np.random.default_rng(0)
    before = memory_mib("VmHWM")

    def embed(image: np.ndarray) -> np.ndarray:
        return rng.standard_normal((len(image), width), np.float32)

    start = time.process_time()
    retriever = Retriever.build(_Blank(trajectories), embed, "bench")  # type: ignore[arg-type]
    built = time.process_time()
    for query in embed(np.zeros(10)):
        retriever.search(query, 500, action_dim=6)
    searched = time.process_time()
    return {
        "features": f"index of {trajectories:,} x {width:,}",
        "cpu seconds to build": round(built - start, 1),
        "cpu seconds a search": round((searched - built) / 10, 3),
        "peak MiB": round(memory_mib("VmHWM"), 0),
        "of which imports": round(before, 0),
    }
