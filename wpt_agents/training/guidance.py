"""Execution guidance: how often, and for which steps of an episode, the prior actor acts.

Also the schedules by which guidance and kickstarting fade out.
"""

import math
import re
import sys
from collections.abc import Callable

import numpy as np

Schedule = Callable[[int], float]
SHARES = np.arange(1, 11) / 10  # a window is 10 %, 20 %, ... or 100 % of the episode


def linear(start: float, end: float, duration: float) -> Schedule:
    """Return a schedule from `start` to `end` over `duration` steps, constant afterwards.

    The unit is the agent's step, a call of `env.step`: linear(1, 0, 50000) ends after 100,000
    frames at action repeat 2.
    """
    return lambda step: start + (end - start) * min(max(step / duration, 0.0), 1.0)


def parse_schedule(text: str | float, most: float = 1.0, name: str = "guidance") -> Schedule:
    """Read a schedule: 'linear(1,0,50000)', or a constant.

    :param text: the schedule
    :param most: the largest value allowed: 1 for a probability, infinite for a weight
    :param name: the name of the keyword, for the message
    :raises ValueError: anything else
    """
    number = r"([-+0-9.eE_]+)"
    match = re.fullmatch(rf"linear\({number},{number},{number}\)", str(text).replace(" ", ""))
    try:
        start, end, duration = map(float, match.groups() if match else (text, text, 1))
        if duration > 0 and all(0 <= x <= most and x < math.inf for x in (start, end)):
            return linear(start, end, duration)
    except (ValueError, TypeError):
        pass
    to = f"to {most:g}" if most < math.inf else "on"
    raise ValueError(
        f"{name}={text!r} is not understood: write a number from 0 {to}, or "
        "'linear(start,end,steps)' of two of them and steps > 0, for example 'linear(1,0,50000)'"
    )


def ever(schedule: Schedule) -> bool:
    """Return whether a schedule is ever above 0. Schedules are monotonic: both ends are enough."""
    return schedule(0) > 0 or schedule(sys.maxsize) > 0


def draw_window(probability: float, length: int, rng: np.random.Generator) -> tuple[int, int]:
    """Draw the steps k .. k + H - 1 of an episode at which the prior actor acts.

    :param probability: the probability that the episode is guided
    :param length: number of steps of an episode
    :return: (k, k + H), of which the first is included and the second is not; (0, 0) if the episode
        is not guided
    """
    if rng.random() >= probability:
        return 0, 0
    duration = max(1, round(rng.choice(SHARES) * length))
    # Half-open, and uniform over all windows that fit; the paper prints k <= t <= H.
    start = int(rng.integers(0, length - duration + 1))
    return start, start + duration
