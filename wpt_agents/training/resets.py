"""How often an environment was reset, also by others than its agent."""

from collections.abc import Callable
from typing import Any

from stable_baselines3.common.vec_env import VecEnv

from wpt_agents.training.environments import innermost


class CountedReset:
    """A replacement of a VecEnv's method `reset` that counts its calls.

    :param reset: the method
    """

    def __init__(self, reset: Callable[..., Any]) -> None:
        self.reset = reset
        self.calls = 0

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        """Reset the environments."""
        self.calls += 1
        return self.reset(*args, **kwargs)


def resets(env: VecEnv) -> int:
    """Return how often `reset` was called since the first call of this function, by anyone.

    A VecEnv does not count its resets, and an evaluation may call any of the wrappers.
    """
    inner: Any = innermost(env)
    if not isinstance(inner.reset, CountedReset):
        inner.reset = CountedReset(inner.reset)
    calls: int = inner.reset.calls
    return calls
