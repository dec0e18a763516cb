"""Cheetah: backwards, jump, on its front or back foot, and the hard run."""

from typing import Any

from dm_control.rl import control
from dm_control.suite import base, cheetah
from dm_control.utils import containers, rewards
from lxml import etree

from wpt_envs.dmc_tasks.hard import HardReward

SUITE = containers.TaggedTasks()

_GROUND = 200  # half length; the stock value 100 is too short for running backwards


class HardCheetah(HardReward, cheetah.Cheetah):
    """The stock run, rewarded only from 2 m/s."""

    threshold = 0.2


class BackwardsCheetah(cheetah.Cheetah):
    """Run backwards."""

    def get_reward(self, physics: cheetah.Physics) -> float:
        """The reward rises from 0 at rest to 1 at 8 m/s backwards."""
        return _speed(-physics.speed(), 8)


class Jump(cheetah.Cheetah):
    """Torso and both feet high, standing still."""

    def get_reward(self, physics: cheetah.Physics) -> float:
        """The mean over the feet of (5 up + still) / 6."""
        still = rewards.tolerance(
            physics.speed(), bounds=(-0.5, 0.5), margin=0.5, value_at_margin=0, sigmoid="linear"
        )
        torso = _height(physics, "torso")
        up = [_up((torso + _height(physics, foot)) / 2) for foot in ("bfoot", "ffoot")]
        return sum((5 * part + still) / 6 for part in up) / 2


class OneFoot(cheetah.Cheetah):
    """Run upright with one foot in the air."""

    def __init__(self, raised: str, random: Any = None) -> None:
        super().__init__(random=random)
        self._raised = raised

    def get_reward(self, physics: cheetah.Physics) -> float:
        """U (5 M + 1) / 6 with U = (3 foot + 2 torso) / 5; M is 1 from 6 m/s on."""
        foot, torso = _up(_height(physics, self._raised)), _up(_height(physics, "torso"))
        return (3 * foot + 2 * torso) / 5 * (5 * _speed(physics.speed(), 6) + 1) / 6


def _height(physics: cheetah.Physics, body: str) -> float:
    return physics.named.data.xpos[body, "z"]


def _up(height: float) -> float:
    return rewards.tolerance(height, bounds=(1.2, float("inf")), margin=1.2 / 2)


def _speed(speed: float, target: float) -> float:
    return rewards.tolerance(
        speed, bounds=(target, float("inf")), margin=target, value_at_margin=0, sigmoid="linear"
    )


def _environment(
    task: base.Task, time_limit: float, ground: float = _GROUND
) -> control.Environment:
    xml, assets = cheetah.get_model_and_assets()
    mjcf = etree.fromstring(xml)
    floor = mjcf.find("./worldbody/geom[@name='ground']")
    floor.set("size", " ".join([str(ground), *floor.get("size").split()[1:]]))
    physics = cheetah.Physics.from_xml_string(etree.tostring(mjcf), assets)
    return control.Environment(physics, task, time_limit=time_limit)


@SUITE.add("custom")
def run_backwards(time_limit: float = 10, random: Any = None) -> control.Environment:
    """Run backwards at 8 m/s."""
    return _environment(BackwardsCheetah(random), time_limit)


@SUITE.add("custom")
def jump(time_limit: float = 10, random: Any = None) -> control.Environment:
    """Jump on the spot."""
    return _environment(Jump(random), time_limit)


@SUITE.add("custom")
def run_front(time_limit: float = 10, random: Any = None) -> control.Environment:
    """Run on the front foot, the back foot up."""
    return _environment(OneFoot("bfoot", random), time_limit)


@SUITE.add("custom")
def run_back(time_limit: float = 10, random: Any = None) -> control.Environment:
    """Run on the back foot, the front foot up."""
    return _environment(OneFoot("ffoot", random), time_limit)


@SUITE.add("custom")
def run_hard(time_limit: float = 10, random: Any = None) -> control.Environment:
    """Run with the hard reward, threshold 0.2; on the stock ground."""
    physics = cheetah.Physics.from_xml_string(*cheetah.get_model_and_assets())
    return control.Environment(physics, HardCheetah(random), time_limit=time_limit)
