"""What the suites share: a MuJoCo task at its control rate, seen by one camera."""

from typing import Any

import gymnasium as gym
import numpy as np

from wpt_envs.rendering import View
from wpt_envs.tasks import Task

StepResult = tuple[np.ndarray, float, bool, bool, dict[str, Any]]


class Simulated(gym.Env):
    """Observes the state; is looked at through `look`. Subclasses reset, step and set `view`.

    ## Arguments
    Of every family, given to `gymnasium.make`:

    - `image_size=64`: the side of the observed picture.
    - `action_repeat`: control steps a step, their rewards summed; 2, and 1 for robotics.
    - `pad_action_to=None`: widens the actions to a number, or to the `"suite"`'s widest.
    - `rendering="near"`: or `"exact"` (the simulator's own settings), `"fast"` (no shadows).
    - `camera`: a camera's name or number, -1 the free one, or the free one's attributes as a
      dict, such as `{"distance": 3.0}`; by default the family's.
    - `state_in_info=False`: puts the simulator's own observation, flat, into `info["state"]`.
    - `seed=None`: of the first reset, if that is given none.
    - `render_mode="rgb_array"` or `None`, `render_size=None`: what `render()` answers, and its
      side; `None` is the observation's.
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
        """The picture now: (size, size, 3) uint8."""
        return self.view.look(size)

    def render(self) -> np.ndarray | None:
        """The picture at 240 x 240."""
        return None if self.render_mode is None else self.look(240)

    def close(self) -> None:
        """Frees the GL contexts."""
        self.view.close()

    def _seeded(self, seed: int | None) -> int | None:
        """The seed of this reset: the one given, else at the first reset the constructor's."""
        seed = self._first_seed if seed is None else seed
        self._first_seed = None
        gym.Env.reset(self, seed=seed)
        return seed


class Achieved(Simulated):
    """Counts success: now, and at any step of the episode. Never ends by it."""

    def _began(self) -> dict[str, Any]:
        """The info of a reset."""
        self._frame, self._ever = 0, False
        return self._achieved(False)

    def _stepped(self, success: float) -> tuple[bool, dict[str, Any]]:
        """Whether the episode is over by its length, and the info of a step."""
        self._frame += 1
        return self._frame >= self.task.frames, self._achieved(bool(success))

    def _achieved(self, success: bool) -> dict[str, Any]:
        """`is_success` is `success` under the name which Stable-Baselines3 looks for."""
        self._ever = self._ever or success
        return {"success": success, "success_any": self._ever, "is_success": success}
