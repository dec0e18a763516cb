"""The cost of an environment step, compared with the renderers of dm_control and Gymnasium."""

from collections.abc import Iterator
from typing import Any

from wpt_envs.measure import THE_FOUR, speed
from wpt_envs.tasks import TASKS

_USUAL = {"dmc": "dm_control", "metaworld": "gymnasium"}


def rows(quick: bool = False) -> Iterator[dict[str, Any]]:
    """Yield the CPU time in ms of an agent step (two control steps, one 64 x 64 image) by renderer.

    :param quick: one round instead of five
    """
    for name in THE_FOUR:
        task = TASKS[name]
        costs = speed(task, rounds=1 if quick else 5)
        costs[_USUAL[task.suite]] = costs.pop("usual")
        for rendering, cost in costs.items():
            yield {
                "what": "agent step",
                "task": f"{task.suite}-{task.name}",
                "rendering": rendering,
                "cpu_ms_per_step": round(cost, 2),
                "ratio_to_exact": round(costs["exact"] / cost, 2),
                "reference": "exact",
            }
