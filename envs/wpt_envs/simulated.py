"""The base class of the suites: a MuJoCo task at its control rate with one camera."""

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.utils import EzPickle

from wpt_envs.rendering import View
from wpt_envs.tasks import Task

StepResult = tuple[np.ndarray, float, bool, bool, dict[str, Any]]


class Simulated(gym.Env, EzPickle):
    """A task that observes the state and returns its image with `look`.

    Subclasses define `reset` and `step`, set `view`, and pass their arguments to `EzPickle`: a
    simulator cannot be stored, so a pickled or copied task is made again and begins with `reset`.

    ## Arguments
    `gymnasium.make` takes these for every family:

    - `image_size=64`: side of the observed image.
    - `action_repeat`: number of control steps in a step, whose rewards are summed; 2, and 1 for
      robotics.
    - `pad_action_to=None`: width to which actions are padded; `"suite"` is the suite's widest.
    - `rendering="near"`: quality of the image; `"exact"` has the simulator's own settings,
      `"fast"` no shadows.
    - `camera`: name or number of a camera, -1 for the free camera, or attributes of the free
      camera as a dict, such as `{"distance": 3.0}`; the family has its default.
    - `state_in_info=False`: puts the simulator's own observation, flattened, into
      `info["state"]`.
    - `seed=None`: seed of the first reset, unless that has its own.
    - `render_mode="rgb_array"`: with `None`, `render()` returns nothing.
    - `render_size=None`: side of what `render()` returns; `None` for the observation's.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 50}  # noqa: RUF012
    view: View

    def __init__(self, task: Task, seed: int | None, render_mode: str | None, fps: float) -> None:
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"No render_mode {render_mode!r}. There are: 'rgb_array', None")
        self.task, self.render_mode = task, render_mode
        self.metadata = self.metadata | {"render_fps": fps}
        self._first_seed = seed

    def look(self, size: int) -> np.ndarray:
        """Return the current image, (size, size, 3) uint8."""
        return self.view.look(size)

    def render(self) -> np.ndarray | None:
        """Return the image at 240 x 240."""
        return None if self.render_mode is None else self.look(240)

    def close(self) -> None:
        """Free the GL contexts."""
        self.view.close()

    def _seeded(self, seed: int | None) -> int | None:
        """Return the seed of this reset: its own, or at the first reset the constructor's."""
        seed = self._first_seed if seed is None else seed
        self._first_seed = None
        gym.Env.reset(self, seed=seed)
        return seed


class Achieved(Simulated):
    """A task that reports success at this step and so far, and continues after it."""

    def _began(self) -> dict[str, Any]:
        """Return the info of a reset."""
        self._frame, self._ever = 0, False
        return self._achieved(False)

    def _stepped(self, success: float) -> tuple[bool, dict[str, Any]]:
        """Return whether the episode has reached its length, and the info of a step."""
        self._frame += 1
        return self._frame >= self.task.frames, self._achieved(bool(success))

    def _achieved(self, success: bool) -> dict[str, Any]:
        """Return the info; `is_success` is the name that Stable-Baselines3 looks for."""
        self._ever = self._ever or success
        return {"success": success, "success_any": self._ever, "is_success": success}
