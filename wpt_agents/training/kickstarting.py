"""Kickstarting: the weight with which the actor imitates the prior actor.

The weight depends on the steps or on the returns. Kickstarting is not in the paper. Source:
https://arxiv.org/abs/1803.03835; the rule for returns is ours, similar to PPO's adaptive KL penalty
(https://arxiv.org/abs/1707.06347, section 4).
"""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from wpt_agents.training.guidance import Schedule, parse_schedule

RECENT = 5  # episodes whose mean return is compared
FACTOR = 0.8  # by which an episode multiplies or divides the weight


@dataclass(frozen=True)
class Adaptive:
    """A weight that falls while collected returns are at least those of the prior actor.

    If the policy is as good as the prior actor, it may move away from it. If it is worse, even if
    only because its actions are noisy, it stays close.

    :ivar start: the first and largest weight
    :ivar end: the smallest weight
    """

    start: float
    end: float

    def weight(self, prior: Sequence[float], later: Sequence[float]) -> float:
        """Return the weight after these episodes.

        Each of the later episodes multiplies the weight by 0.8 if the mean of the five newest
        returns at that time was at least the prior actor's mean, and divides it by 0.8 if not.

        :param prior: returns of the episodes in which the prior actor acted alone; without any, the
            weight does not change
        :param later: returns of the episodes after these, in their order
        """
        weight = self.start
        if not len(prior):
            return weight
        enough = np.mean(prior)
        for number in range(1, len(later) + 1):
            recent = np.mean(later[max(number - RECENT, 0) : number])
            weight *= FACTOR if recent >= enough else 1 / FACTOR
            weight = min(max(weight, self.end), self.start)
        return weight


def parse_kickstart(text: str | float) -> Schedule | Adaptive:
    """Read the keyword `kickstart`: what `parse_schedule` reads, or 'adaptive(20,1)'.

    :param text: the value of the keyword
    :raises ValueError: anything else
    """
    number = r"([-+0-9.eE_]+)"
    match = re.fullmatch(rf"adaptive\({number},{number}\)", str(text).replace(" ", ""))
    try:
        if match is None:
            return parse_schedule(text, math.inf, "kickstart")
        start, end = map(float, match.groups())
        if math.inf > start >= end >= 0:
            return Adaptive(start, end)
        wrong = f"kickstart={text!r} is not understood"
    except ValueError as error:
        wrong = str(error)
    raise ValueError(
        f"{wrong}. 'adaptive(start,end)', which depends on returns, needs start >= end >= 0, for "
        "example 'adaptive(20,1)'"
    )


def check_kickstart(name: str, value: str | float) -> None:
    """Raise an error if the value is not one of `kickstart`."""
    parse_kickstart(value)
