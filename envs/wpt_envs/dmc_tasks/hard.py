"""The hard variant of a reward: nothing below a threshold, and effort costs."""

import numpy as np
from dm_control.mujoco import Physics
from dm_control.suite.base import Task


class HardReward(Task):
    """Put before a task's class: r' = (r if r >= threshold else 0) - 0.1 ||a||.

    The action is the agent's own, before actuators clip it, at every control step.
    """

    threshold = 0.6
    price = 0.1

    def before_step(self, action: np.ndarray, physics: Physics) -> None:
        """Remembers the effort.

        :param action: (A,)
        """
        self._effort = float(np.linalg.norm(action))
        super().before_step(action, physics)

    def get_reward(self, physics: Physics) -> float:
        """The task's reward if it is high enough, less the effort's price."""
        reward = super().get_reward(physics)
        return (reward if reward >= self.threshold else 0.0) - self.price * self._effort
