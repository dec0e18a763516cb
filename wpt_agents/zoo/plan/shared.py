"""The stages that runs share, as data: the dataset, the pre-trained model, and their folders.

Shared stages are in `<out>/cache`, each in a folder named by a hash of everything it depends on.
`wpt_agents.zoo.run.shared` executes them.
"""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

from stable_baselines3.common.base_class import BaseAlgorithm

from wpt_agents.agents.base import PixelAgent
from wpt_agents.agents.wpt import WPT
from wpt_agents.data.dataset import TrajectoryDataset
from wpt_agents.files.names import unknown_name
from wpt_agents.training.hyperparameters import FINE_TUNING
from wpt_agents.training.keywords import Stage
from wpt_agents.training.model_files import shipped
from wpt_agents.zoo.plan.presets import Preset
from wpt_agents.zoo.tasks import find_tasks


def key(*parts: Any) -> str:
    """Return a short hash of settings and of the library's version."""
    text = json.dumps([version("wpt-agents"), *parts], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:10]


def given_for(preset: Preset, agent: type[BaseAlgorithm]) -> str:
    """Return the pre-trained model that replaces an agent's pre-training, or "".

    These models are WPT's; other agents that need one are pre-trained.
    """
    return preset.pretrain.model if agent is WPT else ""


def given_file(model: str) -> Path:
    """Return the file of a pre-trained model, which a path or the name of a shipped model gives.

    :raises ValueError: neither a file nor a shipped model
    """
    if Path(model).is_file():
        return Path(model)
    if model in shipped():
        return shipped()[model]
    if Path(model).suffix or Path(model).name != model:
        raise ValueError(f"pretrain.model={model}: there is no such file")
    raise unknown_name("shipped model", model, shipped())


def named(model: str) -> str:
    """Return a pre-trained model's path or name for a message."""
    return f"the shipped model {model}" if model in shipped() else f"the model {model}"


@dataclass(frozen=True)
class Shared:
    """The shared stages of a preset.

    :param cache: their parent folder
    :param workers: the number of processes that collect
    :param device: the device to pre-train on
    :param given_data: a dataset to use instead of the preset's
    :param accumulate: the number of passes over a batch of pre-training
    :param agent: the class that is pre-trained
    """

    preset: Preset
    suite: str
    cache: Path
    workers: int = 2
    device: str = "auto"
    given_data: Path | None = None
    accumulate: int = 1
    agent: type[BaseAlgorithm] = WPT

    @property
    def log(self) -> Path:
        """The file with the output of the stages if an engine executes them."""
        return self.cache / "log.txt"

    @property
    def env(self) -> dict[str, Any]:
        """Keyword arguments of `gymnasium.make`."""
        return asdict(self.preset.env)

    @property
    def tasks(self) -> list[str]:
        """The ids of the tasks to collect data on."""
        return [row.id for row in find_tasks(self.suite, self.preset.collect.tasks)]

    @property
    def data_path(self) -> Path:
        """The dataset's folder."""
        if self.given_data is not None:
            return self.given_data.resolve()
        return self.cache / f"data-{key(self.preset.collect.as_dict(), self.tasks, self.env)}"

    @property
    def episodes(self) -> int:
        """The number of episodes of the preset's dataset."""
        return len(self.tasks) * self.preset.collect.episodes

    @property
    def stored(self) -> int:
        """The number of episodes that are collected already; 0 if the dataset cannot be read."""
        try:
            return TrajectoryDataset.open(self.data_path).appended
        except (OSError, ValueError):
            return 0

    @property
    def missing(self) -> int:
        """The number of episodes that are still to be collected."""
        return 0 if self.given_data is not None else max(self.episodes - self.stored, 0)

    @property
    def given_model(self) -> str:
        """The path or name of the model that replaces pre-training, or ""."""
        return given_for(self.preset, self.agent)

    @property
    def model_path(self) -> Path:
        """The folder of the pre-training: the model, its log, and `done.json` once it finished."""
        parts = [asdict(self.preset.pretrain), self.pretraining, self.data_source]
        if self.agent is not WPT:
            parts.append(self.agent.__name__)
        return self.cache / f"model-{key(*parts)}"

    @property
    def data_source(self) -> str:
        """A name of the data that does not depend on their path."""
        if self.given_data is None:
            return self.data_path.name
        return TrajectoryDataset.open(self.data_path).fingerprint

    @property
    def pretraining(self) -> Mapping[str, Any]:
        """The preset's keywords of the agent that affect pre-training."""
        if self.agent is not WPT and issubclass(self.agent, PixelAgent):
            stages = Stage.SIZE, Stage.DRAWING, Stage.PRETRAINING
            looked_at = self.agent.keywords.of_stages(*stages)
            return {k: v for k, v in self.preset.of_agent(self.agent).items() if k in looked_at}
        return {k: v for k, v in self.preset.wpt.items() if k not in FINE_TUNING}
