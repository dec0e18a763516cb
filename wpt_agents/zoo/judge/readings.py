"""Readings of a finished run: numbers of its log, of its imagination and of its prior actor.

`progress.csv` has rows for episodes and for evaluations. Both can belong to the same step, and each
row has only the columns that were logged since the last one.
"""

import csv
import math
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from rich.table import Table

from wpt_agents.model.actor_critic import Actor
from wpt_agents.zoo.judge.diagnosis import Promise
from wpt_agents.zoo.learning_curves import damaged
from wpt_agents.zoo.numbers import number
from wpt_agents.zoo.result import PRIOR_ACTOR, read_result
from wpt_agents.zoo.terminal import console

STEP, UPDATES = "time/total_timesteps", "train/updates"
REWARD_ERROR, ENTROPY = "train/heldout_reward_error", "train/entropy"
NOTHING = 1e-6  # reward per step


@dataclass(frozen=True)
class Reading:
    """A number of a run, beside the one that it is compared with."""

    what: str
    value: str
    beside: str


@dataclass(frozen=True)
class Logged:
    """A logged value, and the number of updates at that time."""

    value: float
    updates: int


def readings(
    folder: Path, promised: Sequence[Promise], actions: int, update: int = 600
) -> list[Reading]:
    """Return the readings of a run folder that its files allow.

    :param promised: the result of `diagnose` for the run
    :param actions: number of the task's actions
    :param update: logged values are the last ones up to this update of fine-tuning
    """
    rows = []
    earned = f"earned {sum(p.earned for p in promised) / len(promised):.2f} per step"
    if error := last_logged(folder / "progress.csv", REWARD_ERROR, update):
        what = f"error of the reward head on a new episode, update {error.updates:,}"
        rows.append(Reading(what, f"{error.value:.2f}", earned))
    if entropy := last_logged(folder / "progress.csv", ENTROPY, update):
        what = f"entropy of the actor in nats, update {entropy.updates:,}"
        floor = f"{narrowest_entropy(actions):.2f} with means of 0 and the smallest deviations"
        rows.append(Reading(what, f"{entropy.value:.2f}", floor))
    what = "imagined reward of the same actions, largest difference"
    largest = largest_difference(promised)
    share = f"{100 * largest:.0f} %" if math.isfinite(largest) else "undefined"
    beside = "of the earned reward" if math.isfinite(largest) else "a step earned nothing"
    rows.append(Reading(what, share, beside))
    result = read_result(folder)
    if result is not None and PRIOR_ACTOR in result.scores:
        metric = "success rate" if result.metric == "success" else "mean return"
        beside = f"{metric}; the final policy {number(result.counted())}"
        rows.append(Reading(PRIOR_ACTOR, number(result.counted(PRIOR_ACTOR)), beside))
    return rows


def last_logged(path: Path, column: str, update: int) -> Logged | None:
    """Return the last value of a column of `progress.csv` up to an update, None without one.

    :raises ValueError: if the file is damaged
    """
    if not path.exists():
        return None
    try:
        known = _logged(path, column)
    except (KeyError, TypeError, ValueError, csv.Error) as error:
        raise damaged(path, error) from None
    return next((one for one in reversed(known) if one.updates <= update), None)


def _logged(path: Path, column: str) -> list[Logged]:
    steps: dict[str, dict[str, str]] = defaultdict(dict)
    with open(path, newline="", encoding="utf-8") as file:
        for row in csv.DictReader(file):
            steps[row[STEP]] |= {name: text for name, text in row.items() if text}
    return [
        Logged(float(row[column]), int(float(row[UPDATES])))
        for row in steps.values()
        if column in row and UPDATES in row
    ]


def narrowest_entropy(actions: int) -> float:
    """Return the entropy of an actor with the smallest standard deviations and means of 0."""
    outputs = torch.tensor([*[0.0] * actions, *[-torch.inf] * actions])
    return float(Actor.truncated(outputs, torch.ones(actions, dtype=torch.bool)).entropy())


def largest_difference(promised: Sequence[Promise]) -> float:
    """Return the largest `|imagined - earned| / |earned|` for the actions that were executed.

    It is infinite if the reward of a step is practically 0, as Meta-World's is far from the goal.
    """
    return max(
        abs(p.same_actions - p.earned) / abs(p.earned) if abs(p.earned) > NOTHING else math.inf
        for p in promised
    )


def show(rows: Sequence[Reading]) -> None:
    """Print the readings as a table."""
    table = Table(title="Readings of the run")
    for name in ("reading", "value", "beside"):
        table.add_column(name)
    for row in rows:
        table.add_row(row.what, row.value, row.beside)
    console.print(table)
