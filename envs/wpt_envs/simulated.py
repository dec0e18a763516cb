"""What the suites share: a MuJoCo task at its control rate, seen by one camera."""

from typing import Any

import gymnasium as gym
import numpy as np

from wpt_envs.rendering import View
from wpt_envs.tasks import Task


class Simulated(gym.Env):
    """Observes the state; is looked at through `look`. Subclasses reset, step and set `view`."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 50}  # noqa: RUF012
    view: View

    def __init__(self, task: Task, seed: int | None, render_mode: str | None, fps: float) -> None:
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


StepResult = tuple[np.ndarray, float, bool, bool, dict[str, Any]]
