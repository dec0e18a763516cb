"""Acrobot: the hard swing-up."""

from typing import Any

from dm_control.rl import control
from dm_control.suite import acrobot
from dm_control.utils import containers

from wpt_envs.dmc_tasks.hard import HardReward

SUITE = containers.TaggedTasks()


class HardBalance(HardReward, acrobot.Balance):
    """Swing up, rewarded only near the target."""


@SUITE.add("custom")
def swingup_hard(time_limit: float = 10, random: Any = None) -> control.Environment:
    """Swing-up with the hard reward, threshold 0.6."""
    physics = acrobot.Physics.from_xml_string(*acrobot.get_model_and_assets())
    task = HardBalance(sparse=False, random=random)
    return control.Environment(physics, task, time_limit=time_limit)
