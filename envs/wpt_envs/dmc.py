"""DMControl: the paper's 22 tasks and the other stock tasks of their five domains."""

import warnings
from importlib import import_module
from importlib.util import find_spec
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.error import ResetNeeded
from gymnasium.utils import EzPickle

from wpt_envs import tasks
from wpt_envs.rendering import Camera, View  # before dm_control: it chooses the GL backend
from wpt_envs.simulated import Simulated, StepResult
from wpt_envs.wrappers import dress

# isort: split
import mujoco
from dm_control.rl.control import Environment

_PLANE = mujoco.mjtGeom.mjGEOM_PLANE
_CAMERAS = {"quadruped": 2}  # the other domains use their first camera


def make(
    task: str,
    *,
    image_size: int = 64,
    action_repeat: int = 2,
    pad_action_to: int | str | None = None,
    rendering: str = "near",
    camera: Camera | None = None,
    state_in_info: bool = False,
    seed: int | None = None,
    render_mode: str | None = "rgb_array",
    render_size: int | None = None,
    rescale_action: bool = False,
    floor: float | None = None,
) -> gym.Env:
    """Make a task of DMControl from pixels, for example `walker-run`; see `DMControl`."""
    row = tasks.find("dmc", task)
    env = DMControl(row, rendering, camera, seed, render_mode, rescale_action, floor)
    return dress(
        env,
        image_size=image_size,
        action_repeat=action_repeat,
        pad_action_to=tasks.pad_width("dmc", pad_action_to),
        state_in_info=state_in_info,
        render_size=render_size,
    )


class DMControl(Simulated):
    """A task of DMControl at its control rate; `make` puts the pixels around it.

    ## Description
    The paper's 22 tasks of cartpole, acrobot, cheetah, walker and quadruped, `cheetah-run-hard`
    of its Fig. 2, and the other stock tasks of these domains. Stock tasks are dm_control's own;
    the others are written in its layout in `wpt_envs.dmc_tasks`.

    ## Action Space
    `Box(-1, 1, (n,), float32)`: n is 1 for cartpole and acrobot, 6 for cheetah and walker, 12
    for quadruped; `pad_action_to` widens it, and entries beyond n have no effect. Actions go to
    the actuators unchanged, which clip them to their own range (the quadruped's lift is
    [-1, 1.1], its extend [-0.8, 0.8]).

    ## Observation Space
    `Box(0, 255, (image_size, image_size, 3), uint8)`: the image after the last repeat, by the
    first camera, for quadruped by the third. dm_control's own observation, flattened, is in
    `info["state"]` with `state_in_info`.

    ## Rewards
    The task's, 0 to 1 a control step, summed over `action_repeat`. The hard tasks give nothing
    below a threshold (0.6, cheetah 0.2) and take 0.1 times the norm of the action.

    ## Starting State
    The task's own. `reset(seed=s)` sets its random state to `numpy.random.RandomState(s)`, as
    dm_control's `random=s` does; `reset()` continues the same stream.

    ## Episode End
    Truncated after 1000 control steps; never terminated.

    ## Arguments
    Those of `wpt_envs.simulated.Simulated`, with `pad_action_to="suite"` being 12, and

    - `rescale_action=False`: map [-1, 1] onto the actuators' range.
    - `floor=None`: half the drawn length of the floor in metres; the stock walker's floor ends
      2 m behind it.

    ## Version History
    v0: dm_control 1.0.28, mujoco 3.3.0.
    """

    def __init__(
        self,
        task: tasks.Task,
        rendering: str = "near",
        camera: Camera | None = None,
        seed: int | None = None,
        render_mode: str | None = "rgb_array",
        rescale_action: bool = False,
        floor: float | None = None,
    ) -> None:
        EzPickle.__init__(self, task, rendering, camera, seed, render_mode, rescale_action, floor)
        self.dm_env = _load(task)
        super().__init__(task, seed, render_mode, fps=1 / self.dm_env.control_timestep())
        physics = self.dm_env.physics
        spec = self.dm_env.action_spec()
        self._range = (spec.minimum, spec.maximum) if rescale_action else None
        if floor is not None:  # the simulator's plane is infinite; this is the part that is drawn
            physics.model.geom_size[physics.model.geom_type == _PLANE, 0] = floor
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
        """Start an episode; a seed s sets the task's `numpy.random.RandomState(s)`."""
        seed = self._seeded(seed)
        if seed is not None:
            # RandomState takes seeds of 32 bits only, Gymnasium larger ones, too
            words = [seed >> shift & 0xFFFFFFFF for shift in range(0, seed.bit_length(), 32)]
            self.dm_env.task.random.seed(words if len(words) > 1 else seed)
        timestep = self.dm_env.reset()
        self.view.upload_terrain()
        return _flat(timestep.observation), {}

    def step(self, action: np.ndarray) -> StepResult:
        """Take one control step."""
        if self._range is not None:
            low, high = self._range
            action = low + (action + 1) / 2 * (high - low)
        timestep = self.dm_env.step(action)
        if timestep.first():  # dm_control has started a new episode on its own
            raise ResetNeeded("The episode has ended: call reset() before the next step()")
        terminated = timestep.last() and timestep.discount == 0
        truncated = timestep.last() and not terminated
        return _flat(timestep.observation), float(timestep.reward), terminated, truncated, {}


def _load(task: tasks.Task) -> Environment:
    """Load the dm_control environment of a row: the project's own task, or the stock one."""
    name = task.name.removeprefix(f"{task.embodiment}-").replace("-", "_")
    ours = f"wpt_envs.dmc_tasks.{task.embodiment}"
    if find_spec(ours) is not None and name in import_module(ours).SUITE:
        return import_module(ours).SUITE[name]()
    return import_module(f"dm_control.suite.{task.embodiment}").SUITE[name]()


def _flat(observation: dict[str, Any]) -> np.ndarray:
    return np.concatenate([np.ravel(part) for part in observation.values()]).astype(np.float64)
