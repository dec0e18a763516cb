"""The paper's tasks from pixels, in one Gymnasium namespace. Importing this package registers them.

>>> import gymnasium as gym, wpt_envs
>>> env = gym.make("wpt/dmc-walker-run-v0", pad_action_to="suite")
>>> obs, info = env.reset(seed=0)  # (64, 64, 3) uint8
"""

from typing import Any

import gymnasium

from wpt_envs.headless import prefer_egl
from wpt_envs.tasks import ANT_SEQUENCE, TASKS, Task

__all__ = ["ANT_SEQUENCE", "TASKS", "Task", "pixels"]

prefer_egl()  # before anybody imports MuJoCo
for _task in TASKS.values():
    gymnasium.register(
        _task.id,
        entry_point=f"wpt_envs.{_task.suite}:make",
        kwargs={"task": _task.name},
    )


def __getattr__(name: str) -> Any:
    if name == "pixels":  # loaded at its first use
        from wpt_envs.any_env import pixels

        return pixels
    raise AttributeError(f"module 'wpt_envs' has no attribute {name!r}")
