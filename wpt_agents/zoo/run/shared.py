"""The stages that runs share: data, pre-trained model, baselines. Made once, reused by later runs.

They stand in `<out>/cache`, each named by a hash of all that it depends on.
"""

import hashlib
import json
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, nullcontext
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.logger import Logger, TensorBoardOutputFormat
from wpt_envs.tasks import Task

from wpt_agents.agents.wpt import WPT
from wpt_agents.data.dataset import TrajectoryDataset
from wpt_agents.files.names import counted
from wpt_agents.training.distributed import World
from wpt_agents.zoo.collect.collection import collect
from wpt_agents.zoo.judge.evaluation import evaluate
from wpt_agents.zoo.judge.untrained import BASELINES
from wpt_agents.zoo.plan.presets import Preset
from wpt_agents.zoo.result import Score
from wpt_agents.zoo.run.locks import locked, write_json
from wpt_agents.zoo.run.logs import ContinuedCSV
from wpt_agents.zoo.tasks import find_tasks
from wpt_agents.zoo.terminal import say

Callback = Callable[[int, dict[str, float]], None]  # of pre-training


# Keywords of WPT that pre-training does not look at: changing them keeps the pre-trained model.
FINE_TUNING = {
    *("actor_critic_learning_rate", "gamma", "lam", "ent_coef", "imagine_horizon", "return_norm"),
    *(
        "target_fraction",
        "train_ratio",
        "train_freq",
        "learning_starts",
        "warmup_steps",
        "guidance",
        "kickstart",
    ),
    *("offline_ratio", "retrieval", "num_retrieve"),
    *("bc_steps", "bc_batch_size", "bc_learning_rate"),
}


def key(*parts: Any) -> str:
    """A short hash of settings and of the library's version."""
    text = json.dumps([version("wpt-agents"), *parts], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:10]


@dataclass(frozen=True)
class Shared:
    """Where the shared stages of a preset stand, and how they are made.

    :param cache: the folder that holds them
    :param workers: processes that collect
    :param device: where to pre-train
    :param given_data: a dataset to use in the place of the preset's
    :param accumulate: passes over a batch of pre-training
    """

    preset: Preset
    suite: str
    cache: Path
    workers: int = 2
    device: str = "auto"
    given_data: Path | None = None
    accumulate: int = 1

    @property
    def env(self) -> dict[str, Any]:
        """Keyword arguments of `gymnasium.make`."""
        return asdict(self.preset.env)

    @property
    def tasks(self) -> list[str]:
        """The ids of the tasks that data are collected on."""
        return [row.id for row in find_tasks(self.suite, self.preset.collect.tasks)]

    @property
    def data_path(self) -> Path:
        """The dataset's folder."""
        if self.given_data is not None:
            return self.given_data.resolve()
        return self.cache / f"data-{key(asdict(self.preset.collect), self.tasks, self.env)}"

    @property
    def model_path(self) -> Path:
        """The folder of the pre-training: model, log, and `done.json` when it is finished."""
        parts = asdict(self.preset.pretrain), self.pretraining, self.data_source
        return self.cache / f"model-{key(*parts)}"

    @property
    def data_source(self) -> str:
        """What the data are, wherever they lie."""
        if self.given_data is None:
            return self.data_path.name
        return TrajectoryDataset.open(self.data_path).fingerprint

    @property
    def pretraining(self) -> dict[str, Any]:
        """The preset's keywords of WPT that pre-training looks at."""
        return {k: v for k, v in self.preset.wpt.items() if k not in FINE_TUNING}

    def data(self) -> TrajectoryDataset:
        """Stage 1: the dataset, collected unless it is there; half of one is continued."""
        if self.given_data is not None:
            dataset = TrajectoryDataset.open(self.given_data)
            say("collect", f"given, {counted(len(dataset), 'episode')}  [dim]{self.data_path}")
            self._say_what_differs()
            return dataset
        with locked(self.cache / f"lock-{self.data_path.name}", wait=True):
            return self._collected()

    def _collected(self) -> TrajectoryDataset:
        wanted, given = len(self.tasks) * self.preset.collect.episodes, self.preset.collect
        try:
            there = self.data_path.exists()
            found = TrajectoryDataset.open(self.data_path).appended if there else 0
        except ValueError:
            found = 0  # `collect` says what is wrong
        state = "reused" if found == wanted else f"continued at {found} of" if found else "making"
        names = ", ".join(given.tasks) or f"all tasks of {self.suite}"
        episodes = counted(wanted, "reward-free episode")
        say("collect", f"{state} {episodes} of {names}  [dim]{self.data_path}")
        return collect(
            self.data_path,
            self.tasks,
            given.episodes,
            given.seed,
            self.workers,
            given.behaviour,
            self.env,
        )

    def _say_what_differs(self) -> None:
        """Warns of given data that `collect` recorded in another environment than the task's."""
        label = self.data_path / "collect.json"
        recorded = json.loads(label.read_text())["env"] if label.exists() else {}
        for name, value in recorded.items():
            if self.env.get(name, value) != value:
                say("warning", f"data of {name}={value}, but the task has {name}={self.env[name]}")

    def model(self, dataset: TrajectoryDataset) -> Path:
        """Stage 2: the file of the pre-trained model; half a pre-training is continued."""
        given, folder, world = self.preset.pretrain, self.model_path, World.current()
        model, done = folder / "model.zip", folder / "done.json"
        with locked(folder / "lock", wait=True) if world.rank == 0 else nullcontext():
            finished = world.rank_0s(done.exists())
            state = "reused" if finished else "continued" if model.exists() else "making"
            updates = counted(given.steps, "update")
            say("pretrain", f"{state} a world model of {updates}  [dim]{folder}")
            if not finished:
                start = time.perf_counter()
                with log_in(folder) if world.rank == 0 else nullcontext() as callback:
                    self._pretrain(dataset, folder, callback)
                if world.rank == 0:
                    write_json(done, {"seconds": round(time.perf_counter() - start, 1)})
        return model

    def _pretrain(
        self, dataset: TrajectoryDataset, folder: Path, callback: Callback | None
    ) -> None:
        WPT.pretrain(
            dataset,
            steps=self.preset.pretrain.steps,
            run_dir=folder,
            seed=self.preset.pretrain.seed,
            device=self.device,
            progress_bar=True,
            callback=callback,
            accumulate=self.accumulate,
            **self.pretraining,
        )

    def index(self, model: WPT) -> None:
        """Stage 3: the features of every first image, kept beside the dataset."""
        assert model.dataset is not None
        before = set(Path(model.dataset.path).iterdir())
        retriever = model.build_index(progress_bar=True)
        state = "made" if set(Path(model.dataset.path).iterdir()) - before else "reused"
        share = retriever.own_share()
        told = "" if share is None else f", {share:.0%} of the nearest are of the query's own robot"
        say("index", f"{state}, {len(retriever)} first images{told}  [dim]{model.dataset.path}")

    def baseline(self, name: str, task: Task, seed: int) -> Score:
        """The score of doing nothing or of the random policy, played unless it is there."""
        episodes = self.preset.evaluate.episodes
        path = self.cache / f"{name}-{key(task.id, self.env, episodes, seed)}.json"
        if path.exists():
            return Score.of(json.loads(path.read_text()))
        space = spaces.Box(-1.0, 1.0, (task.action_dim,), np.float32)
        policy = BASELINES[name](space, seed)
        score = evaluate(policy, task.id, self.env, episodes, seed, name)
        write_json(path, score.as_dict())
        return score


@contextmanager
def log_in(folder: Path) -> Iterator[Callback]:
    """A callback of pre-training that logs to `folder`, as a table and for TensorBoard."""
    table = ContinuedCSV(folder / "progress.csv")
    logger = Logger(str(folder), [table, TensorBoardOutputFormat(str(folder))])
    with closing(logger):
        yield writing_to(logger, table)


def writing_to(logger: Logger, table: ContinuedCSV) -> Callback:
    """A callback of pre-training that logs the metrics' means over 50 updates."""
    begun = False

    def write(step: int, metrics: dict[str, float]) -> None:
        nonlocal begun
        if not begun:  # what came after the checkpoint is made again
            table.keep(rows=(step - 1) // 50)
            begun = True
        for name, value in metrics.items():
            logger.record_mean(name, value)
        if step % 50 == 0:
            logger.dump(step)

    return write
