"""A trained model again: where it stands, what it was trained on, how good it is, how it looks."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml
from stable_baselines3.common.type_aliases import PolicyPredictor
from wpt_envs.tasks import TASKS

from wpt_agents.agents.wpt import WPT
from wpt_agents.files.names import unknown_name
from wpt_agents.zoo.judge.evaluation import evaluate, film
from wpt_agents.zoo.machine import check_device
from wpt_agents.zoo.pictures import runs
from wpt_agents.zoo.plan.presets import EnvSettings
from wpt_agents.zoo.result import Score
from wpt_agents.zoo.tasks import find_tasks

POLICIES = ("wpt", "prior")


@dataclass(frozen=True)
class Trained:
    """A model file and the task that it is to act on.

    :param env: keyword arguments of `gymnasium.make`
    """

    model: Path
    task: str
    env: dict[str, Any] = field(default_factory=dict)

    def load(self, policy: str = "wpt", device: str = "auto") -> PolicyPredictor:
        """The policy: "wpt", or the "prior" actor that guided it. Needs no dataset."""
        if policy not in POLICIES:
            raise unknown_name("policy", policy, POLICIES)
        check_device(device)
        model = WPT.load(self.model, device=device)
        if policy == "wpt":
            return model
        if model.prior is None:
            raise ValueError(f"{self.model} has no prior actor: it was trained without guidance")
        return model.prior

    def evaluate(self, policy: PolicyPredictor, episodes: int, seed: int) -> Score:
        """Returns over seeded episodes."""
        return evaluate(policy, self.task, self.env, episodes, seed)

    def record(self, policy: PolicyPredictor, path: Path, seed: int, size: int = 256) -> float:
        """Films an episode to `path` (mp4) and gives its return."""
        trajectory, frames, fps = film(policy, self.task, self.env, seed, size)
        path.parent.mkdir(parents=True, exist_ok=True)
        runs.video(path, frames, fps)
        assert trajectory.reward is not None
        return float(trajectory.reward.sum())


def find_trained(path: Path, task: str = "") -> Trained:
    """The model in a run folder, or the model file at `path`.

    :param path: a run folder as it was left, moved or pulled; or a `.zip` that `save` wrote
    :param task: as `list` shows it, for a file without `config.yaml` beside it, or to act elsewhere
    """
    if not path.exists():
        raise FileNotFoundError(f"There is no {path}; name a run folder or a model file (.zip)")
    folder, model = (path, _best(path)) if path.is_dir() else (path.parent, path)
    config = _config(folder)
    if not task and not config:
        raise ValueError(f"{folder} has no config.yaml to say what {model.name} is for: add --task")
    row = find_tasks("dmc", [task])[0] if task else TASKS.get(config["task"])
    if row is None:
        raise unknown_name("task", config["task"], TASKS)
    return Trained(model, row.id, config.get("env", {}))


def _best(folder: Path) -> Path:
    """The file that the run's score is of: the best policy in between, or the last."""
    for name in ("best_model.zip", "model.zip"):
        if (folder / name).exists():
            return folder / name
    raise FileNotFoundError(f"{folder} holds no model.zip: the run is not finished")


def _config(folder: Path) -> dict[str, Any]:
    """What the run folder says about task and environment; empty if it says nothing."""
    path = folder / "config.yaml"
    if not path.exists():
        return {}
    try:
        config = yaml.safe_load(path.read_text())
        EnvSettings.of("env", config["env"])
        return {"task": config["task"], "env": config["env"]}
    except (yaml.YAMLError, KeyError, TypeError) as error:
        raise ValueError(f"{path} is no run's configuration ({error!r})") from None
