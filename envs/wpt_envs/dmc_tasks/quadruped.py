"""Quadruped: stand, jump and roll, beside the stock walk and run."""

from typing import Any

import numpy as np
from dm_control.rl import control
from dm_control.suite import base, common, quadruped
from dm_control.utils import containers, rewards

SUITE = containers.TaggedTasks()

_FLOOR = 10  # half length, for all of these


class Stand(quadruped.Move):
    """Torso upright."""

    def __init__(self, random: Any = None) -> None:
        super().__init__(desired_speed=0, random=random)

    def get_reward(self, physics: quadruped.Physics) -> float:
        """U = (1 + torso's zz) / 2."""
        return rewards.tolerance(
            physics.torso_upright(),
            bounds=(1, float("inf")),
            margin=2,
            value_at_margin=0,
            sigmoid="linear",
        )


class Jump(Stand):
    """Upright, and the centre of mass a metre high."""

    def get_reward(self, physics: quadruped.Physics) -> float:
        """U times the height's part: 1 from 1 m on, 0.5 at the ground."""
        height = physics.named.data.sensordata["center_of_mass"][2]
        high = _linear(height, 1.0)
        return super().get_reward(physics) * high


class Roll(Stand):
    """Upright and fast in any direction, by the speed of the torso in 3-D."""

    def __init__(self, speed: float, random: Any = None) -> None:
        super().__init__(random=random)
        self._speed = speed

    def get_reward(self, physics: quadruped.Physics) -> float:
        """U times the speed's part: 1 from `speed` on, 0.5 at rest."""
        fast = _linear(float(np.linalg.norm(physics.torso_velocity())), self._speed)
        return super().get_reward(physics) * fast


def _linear(value: float, target: float) -> float:
    return rewards.tolerance(
        value, bounds=(target, float("inf")), margin=target, value_at_margin=0.5, sigmoid="linear"
    )


def _environment(task: base.Task, time_limit: float) -> control.Environment:
    xml = quadruped.make_model(floor_size=_FLOOR)
    physics = quadruped.Physics.from_xml_string(xml, common.ASSETS)
    return control.Environment(physics, task, time_limit=time_limit, control_timestep=0.02)


@SUITE.add("custom")
def stand(time_limit: float = 20, random: Any = None) -> control.Environment:
    """Stand upright."""
    return _environment(Stand(random), time_limit)


@SUITE.add("custom")
def jump(time_limit: float = 20, random: Any = None) -> control.Environment:
    """Jump a metre high."""
    return _environment(Jump(random), time_limit)


@SUITE.add("custom")
def roll(time_limit: float = 20, random: Any = None) -> control.Environment:
    """Move at 0.5 m/s in any direction."""
    return _environment(Roll(0.5, random), time_limit)


@SUITE.add("custom")
def roll_fast(time_limit: float = 20, random: Any = None) -> control.Environment:
    """Move at 5 m/s in any direction."""
    return _environment(Roll(5, random), time_limit)
