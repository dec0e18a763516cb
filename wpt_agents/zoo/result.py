"""What a run found, typed; this module alone reads and writes `result.json`."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, Self

import numpy as np

from wpt_agents.zoo.statistics import mean_interval


@dataclass(frozen=True)
class Score:
    """The returns of one policy, and successes where the task reports them."""

    returns: list[float]
    successes: list[bool]

    @property
    def interval(self) -> tuple[float, float | None, float | None]:
        """Mean return, and its 95 % interval."""
        return mean_interval(self.returns)

    def as_dict(self) -> dict[str, Any]:
        """What `result.json` holds."""
        mean, low, high = self.interval
        rate = float(np.mean(self.successes)) if self.successes else None
        return asdict(self) | {"mean": mean, "low": low, "high": high, "success_rate": rate}

    @classmethod
    def of(cls, given: Mapping[str, Any]) -> Self:
        """Reads back `as_dict`."""
        return cls(given["returns"], given["successes"])
