"""The hard variant of a reward: zero below a threshold, with a cost for effort."""

import numpy as np
from dm_control.mujoco import Physics
from dm_control.suite.base import Task


class HardReward(Task):
    """A mixin to list before a task's class: r' = (r if r >= threshold else 0) - 0.1 ||a||.

    The action is the agent's own, before actuators clip it, at every control step.
    """

    threshold = 0.6
    price = 0.1

    def before_step(self, action: np.ndarray, physics: Physics) -> None:
        """Store the norm of the action.

        :param action: (A,)
        """
        self._effort = float(np.linalg.norm(action))
        super().before_step(action, physics)

    def get_reward(self, physics: Physics) -> float:
        """Return the task's reward if it reaches the threshold, minus the cost of the action."""
        reward = super().get_reward(physics)
        return (reward if reward >= self.threshold else 0.0) - self.price * self._effort
