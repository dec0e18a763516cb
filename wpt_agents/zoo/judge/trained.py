"""A trained model: find it with its task, evaluate it and film it."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import yaml
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.type_aliases import PolicyPredictor
from wpt_envs.tasks import TASKS

from wpt_agents.agents.wpt import WPT
from wpt_agents.files.model_file import agent_of, is_of_sb3
from wpt_agents.files.names import unknown_name
from wpt_agents.zoo.judge.evaluation import NoisyPolicy, evaluate, film
from wpt_agents.zoo.judge.prediction import CONTEXT
from wpt_agents.zoo.machine import check_device
from wpt_agents.zoo.pictures import runs
from wpt_agents.zoo.pictures.animation import animate
from wpt_agents.zoo.plan.methods import METHODS, Method, find_method
from wpt_agents.zoo.plan.presets import EnvSettings
from wpt_agents.zoo.result import Score
from wpt_agents.zoo.tasks import find_tasks

POLICIES = ("wpt", "prior", "actor")  # "wpt" is the agent of any method
FILMS = (".mp4", ".gif")
MOST_NAMED = 5  # run folders that an error message names


@dataclass(frozen=True)
class Trained:
    """A model file and its task.

    :param env: keyword arguments of `gymnasium.make`
    :param method: the method that trained it
    """

    model: Path
    task: str
    env: Mapping[str, Any] = field(default_factory=dict)
    method: Method = METHODS["wpt"]

    def load(self, policy: str = "wpt", device: str = "auto") -> PolicyPredictor:
        """Load a policy, without a dataset: the agent ("wpt"), or one that `choose` takes from it.

        :raises ValueError: if the policy is unknown or the model has none of this name
        """
        return self.choose(self.load_agent(device), policy)

    def load_agent(self, device: str = "auto") -> BaseAlgorithm:
        """Load the agent, without a dataset.

        :raises ValueError: if the file is damaged, or the agent's actions are not the task's
        """
        check_device(device)
        agent = self.method.agent.load(self.model, device=device)
        needed = TASKS[self.task].action_dim
        if agent.action_space.shape != (needed,):
            raise ValueError(
                f"{self.model} acts in {agent.action_space}, and {self.task} takes {needed} "
                "actions: name a task of the robot that the model was fine-tuned for (--task)"
            )
        return agent

    def choose(self, agent: BaseAlgorithm, policy: str) -> PolicyPredictor:
        """Return the agent ("wpt"), its prior actor ("prior"), or its actor alone ("actor").

        The agent acts as before only if "actor" is not chosen.
        """
        if policy not in POLICIES:
            raise unknown_name("policy", policy, POLICIES)
        if policy == "wpt":
            return agent
        if policy == "actor":
            if not isinstance(agent, WPT):
                raise ValueError(
                    f"{self.model} is not of WPT, so its actor always acts alone: use wpt"
                )
            return actor_alone(agent)
        prior: PolicyPredictor | None = getattr(agent, "prior", None)
        if prior is None:
            raise ValueError(f"{self.model} has no prior actor: it was trained without guidance")
        return prior

    def evaluate(
        self, policy: PolicyPredictor, episodes: int, seed: int, noise: float = 0.0
    ) -> Score:
        """Return the score over seeded episodes.

        :param noise: standard deviation of Gaussian noise on the actions
        """
        if noise:
            policy = NoisyPolicy(policy, noise, seed)
        return evaluate(policy, self.task, self.env, episodes, seed, wrap=self.method.wrap)

    def record(
        self, path: Path, policy: str = "wpt", seed: int = 0, size: int = 256, device: str = "auto"
    ) -> float:
        """Film an episode to `path` and return its return.

        :param path: an `.mp4`; or a `.gif`, which also shows what the agent's world model, if it
            has one, predicts of the whole episode from its first images and the actions
        :raises ValueError: if the policy or the file type is unknown, or there is no prior actor
        """
        if path.suffix not in FILMS:
            raise ValueError(f"{path}: the name of a video must end in {' or '.join(FILMS)}")
        agent = self.load_agent(device)
        trajectory, shots, fps = film(
            self.choose(agent, policy), self.task, self.env, seed, size, wrap=self.method.wrap
        )
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.suffix == ".mp4":
            runs.video(path, shots, fps)
        elif isinstance(agent, WPT):
            dreamed = agent.open_loop(trajectory, CONTEXT, len(trajectory))
            animate(path, shots, fps, trajectory.image[: len(dreamed)], dreamed, CONTEXT)
        else:
            animate(path, shots, fps)
        assert trajectory.reward is not None
        return float(trajectory.reward.sum())


def actor_alone(agent: Any) -> PolicyPredictor:
    """Let an agent act by its actor alone, without the prior actor (`residual`, `ibrl`).

    :param agent: a `WPT`
    """
    agent.residual = False
    agent.ibrl = False
    policy: PolicyPredictor = agent
    return policy


def find_trained(path: Path, task: str = "") -> Trained:
    """Find the model in a run folder, or the model file at `path`.

    :param path: a run folder, which may have been moved or pulled; or a `.zip` that `save` wrote
    :param task: as `list` shows it; needed for a file without `config.yaml` beside it
    """
    if not path.exists():
        raise FileNotFoundError(f"There is no {path}; name a run folder or a model file (.zip)")
    folder = path if path.is_dir() else path.parent
    model = final_model(path) if path.is_dir() else path
    origin = read_origin(folder) or Origin("", method=_method_of(model))
    if not (task or origin.task):
        raise ValueError(f"{folder} has no config.yaml to say what {model.name} is for: add --task")
    rows = find_tasks("dmc", [task]) if task else []
    if len(rows) > 1:
        raise ValueError(f"--task {task} matches {len(rows)} tasks: name one as `list` shows it")
    name = rows[0].id if rows else origin.task
    if name not in TASKS:
        raise unknown_name("task", name, TASKS)
    return Trained(model, name, origin.env, find_method(origin.method))


def final_model(folder: Path) -> Path:
    """Return the model file of the run's score: the best agent if it was kept, else the last."""
    for name in ("best_model.zip", "model.zip"):
        if (folder / name).exists():
            return folder / name
    if read_origin(folder) is None:
        raise FileNotFoundError(f"{folder} holds no run: {_runs_below(folder)}")
    if names := sorted(path.parent.name for path in folder.glob("*/model.zip")):
        raise FileNotFoundError(f"{folder} holds no model.zip; name one in it: {', '.join(names)}")
    raise FileNotFoundError(f"{folder} holds no model.zip: the run is not finished")


def _runs_below(folder: Path) -> str:
    """Return what to name instead of a folder that is no run folder: up to five below it."""
    runs = {path.parent for name in ("**/config.yaml", "*/model.zip") for path in folder.glob(name)}
    if not runs:
        return "name a run folder, or a model file (.zip)"
    names = ", ".join(map(str, sorted(runs)[:MOST_NAMED]))
    rest = len(runs) - MOST_NAMED
    return f"name one below it: {names}" + (f", and {rest} more" if rest > 0 else "")


@dataclass(frozen=True)
class Origin:
    """The task, environment and method of the model in a run folder."""

    task: str
    env: Mapping[str, Any] = field(default_factory=dict)
    method: str = "wpt"


def _method_of(model: Path) -> str:
    """Return a method whose agent wrote a model file, "wpt" if the file does not say it.

    :raises ValueError: if Stable-Baselines3 wrote the file, which does not name the algorithm
    """
    if is_of_sb3(model):
        raise ValueError(
            f"{model} was saved by Stable-Baselines3 and does not name its algorithm, and the "
            "config.yaml of its run, which does, is not beside it: copy it there, or name the run "
            "folder"
        )
    kind = agent_of(model)
    return next((name for name, row in METHODS.items() if row.agent.__name__ == kind), "wpt")


def read_origin(folder: Path) -> Origin | None:
    """Read the origin of the models in a run folder, or in the folder of a task of a sequence.

    :return: None if there is no `config.yaml`
    """
    path = folder / "config.yaml"
    if path.exists():
        return _read_config(path)
    folder = folder.absolute()
    task = f"wpt/{folder.name}-v0"
    sequence = folder.parent / "config.yaml"
    return (
        replace(_read_config(sequence), task=task) if task in TASKS and sequence.exists() else None
    )


def _read_config(path: Path) -> Origin:
    try:
        config = SimpleNamespace(**yaml.safe_load(path.read_text(encoding="utf-8")))
        env = EnvSettings.of("env", config.env)
        return Origin(config.task, asdict(env), getattr(config, "method", "wpt"))
    except (yaml.YAMLError, AttributeError, TypeError) as error:
        raise ValueError(f"{path} is not the configuration of a run ({error!r})") from None
