"""DMControl: the paper's 22 tasks and the other stock tasks of their five domains."""

import warnings
from importlib import import_module
from importlib.util import find_spec
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from wpt_envs import tasks
from wpt_envs.rendering import View  # before dm_control: it chooses the GL backend
from wpt_envs.simulated import Simulated, StepResult
from wpt_envs.wrappers import dress

# isort: split
from dm_control.rl.control import Environment

_CAMERAS = {"quadruped": 2}  # the other domains are seen by their first camera


def make(
    task: str,
    *,
    image_size: int = 64,
    action_repeat: int = 2,
    pad_action_to: int | str | None = None,
    rendering: str = "near",
    camera: str | int | None = None,
    state_in_info: bool = False,
    seed: int | None = None,
    render_mode: str | None = "rgb_array",
    render_size: int | None = None,
) -> gym.Env:
    """A task of DMControl from pixels, for example `walker-run`."""
    row = tasks.find("dmc", task)
    env = DMControl(row, rendering, camera, seed, render_mode)
    return dress(
        env,
        image_size=image_size,
        action_repeat=action_repeat,
        pad_action_to=tasks.pad_width("dmc", pad_action_to),
        state_in_info=state_in_info,
        render_size=render_size,
    )


class DMControl(Simulated):
    """One task at its control rate."""

    def __init__(
        self,
        task: tasks.Task,
        rendering: str = "near",
        camera: str | int | None = None,
        seed: int | None = None,
        render_mode: str | None = "rgb_array",
    ) -> None:
        self.dm_env = _load(task)
        super().__init__(task, seed, render_mode, fps=1 / self.dm_env.control_timestep())
        physics = self.dm_env.physics
        camera = _CAMERAS.get(task.embodiment, 0) if camera is None else camera
        self.view = View(physics.model.ptr, physics.data.ptr, rendering, camera)
        self.action_space = spaces.Box(-1.0, 1.0, (task.action_dim,), np.float32)
        with warnings.catch_warnings():  # quadruped looks its sensors up once, with np.in1d
            warnings.simplefilter("ignore", DeprecationWarning)
            specs = self.dm_env.observation_spec().values()
        size = sum(int(np.prod(spec.shape)) for spec in specs)
        self.observation_space = spaces.Box(-np.inf, np.inf, (size,), np.float64)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Starts an episode; seed s gives the task `numpy.random.RandomState(s)`."""
        seed = self._seeded(seed)
        if seed is not None:
            self.dm_env.task.random.seed(seed)
        timestep = self.dm_env.reset()
        self.view.upload_terrain()
        return _flat(timestep.observation), {}

    def step(self, action: np.ndarray) -> StepResult:
        """One control step."""
        timestep = self.dm_env.step(action)
        terminated = timestep.last() and timestep.discount == 0
        truncated = timestep.last() and not terminated
        return _flat(timestep.observation), float(timestep.reward), terminated, truncated, {}


def _load(task: tasks.Task) -> Environment:
    """The dm_control environment behind a row: the project's own task, or the stock one."""
    name = task.name.removeprefix(f"{task.embodiment}-").replace("-", "_")
    ours = f"wpt_envs.dmc_tasks.{task.embodiment}"
    if find_spec(ours) is not None and name in import_module(ours).SUITE:
        return import_module(ours).SUITE[name]()
    return import_module(f"dm_control.suite.{task.embodiment}").SUITE[name]()


def _flat(observation: dict[str, Any]) -> np.ndarray:
    return np.concatenate([np.ravel(part) for part in observation.values()]).astype(np.float64)
