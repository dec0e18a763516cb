"""The paper's tasks from pixels, under one Gymnasium namespace. Importing registers them.

>>> import gymnasium as gym, wpt_envs
>>> env = gym.make("wpt/dmc-walker-run-v0", pad_action_to="suite")
>>> obs, info = env.reset(seed=0)  # (64, 64, 3) uint8
"""

import gymnasium

from wpt_envs.tasks import ANT_SEQUENCE, TASKS, Task

__all__ = ["ANT_SEQUENCE", "TASKS", "Task"]

for _task in TASKS.values():
    gymnasium.register(
        _task.id,
        entry_point=f"wpt_envs.{_task.suite}:make",
        kwargs={"task": _task.name},
    )
