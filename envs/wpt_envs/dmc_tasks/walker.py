"""Walker: backwards, backflip and the hard walk."""

from typing import Any

from dm_control.rl import control
from dm_control.suite import base, walker
from dm_control.utils import containers, rewards

from wpt_envs.dmc_tasks.hard import HardReward

SUITE = containers.TaggedTasks()


class HardWalker(HardReward, walker.PlanarWalker):
    """The stock walk, rewarded only above a threshold."""


class BackwardsWalker(walker.PlanarWalker):
    """Stand, and move backwards at `speed`: S (5 M + 1) / 6."""

    def __init__(self, speed: float, random: Any = None) -> None:
        super().__init__(move_speed=0, random=random)  # whose reward is S, for standing
        self._speed = speed

    def get_reward(self, physics: walker.Physics) -> float:
        """S (5 M + 1) / 6, M falls from 1 at the speed to 0.5 at half of it."""
        moving = rewards.tolerance(
            -physics.horizontal_velocity(),
            bounds=(self._speed, float("inf")),
            margin=self._speed / 2,
            value_at_margin=0.5,
            sigmoid="linear",
        )
        return super().get_reward(physics) * (5 * moving + 1) / 6


class Backflip(walker.PlanarWalker):
    """Feet and thighs above the head, and backwards."""

    def __init__(self, random: Any = None) -> None:
        super().__init__(move_speed=0, random=random)

    def get_reward(self, physics: walker.Physics) -> float:
        """U (5 M + 1) / 6 with U = (3 feet + 2 thighs) / 5."""
        height = physics.named.data.xpos
        feet = height[["right_foot", "left_foot"], "z"].mean()
        thighs = height[["right_thigh", "left_thigh"], "z"].mean()
        feet_up = rewards.tolerance(feet, bounds=(1.1, float("inf")), margin=1.1 / 2)
        thighs_up = rewards.tolerance(thighs, bounds=(1.0, float("inf")), margin=1.0 / 2)
        moving = rewards.tolerance(
            -physics.horizontal_velocity(),
            bounds=(6, float("inf")),
            margin=3,
            value_at_margin=0.5,
            sigmoid="linear",
        )
        return (3 * feet_up + 2 * thighs_up) / 5 * (5 * moving + 1) / 6


def _environment(task: base.Task, time_limit: float) -> control.Environment:
    physics = walker.Physics.from_xml_string(*walker.get_model_and_assets())
    return control.Environment(physics, task, time_limit=time_limit, control_timestep=0.025)


@SUITE.add("custom")
def walk_backwards(time_limit: float = 25, random: Any = None) -> control.Environment:
    """Walk backwards at 1 m/s."""
    return _environment(BackwardsWalker(1, random), time_limit)


@SUITE.add("custom")
def run_backwards(time_limit: float = 25, random: Any = None) -> control.Environment:
    """Run backwards at 8 m/s."""
    return _environment(BackwardsWalker(8, random), time_limit)


@SUITE.add("custom")
def backflip(time_limit: float = 25, random: Any = None) -> control.Environment:
    """Flip backwards."""
    return _environment(Backflip(random), time_limit)


@SUITE.add("custom")
def walk_hard(time_limit: float = 25, random: Any = None) -> control.Environment:
    """Walk with the hard reward, threshold 0.6."""
    return _environment(HardWalker(1, random), time_limit)
