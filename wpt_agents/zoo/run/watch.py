"""The progress of the runs of a plan, one line each, read from their folders."""

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
from rich.live import Live
from rich.table import Table

from wpt_agents.zoo.learning_curves import MONITOR, TrainingEpisodes
from wpt_agents.zoo.locks import is_locked
from wpt_agents.zoo.numbers import number
from wpt_agents.zoo.plan.runs import Run
from wpt_agents.zoo.tasks import short_name
from wpt_agents.zoo.terminal import console

RECENT = 10  # number of episodes for the means of return and speed


@dataclass(frozen=True)
class Standing:
    """The progress of a run.

    :param state: "waiting", "preparing", "learning", "evaluating", "stopped", "failed", "finished"
    :param steps: calls of `env.step` so far
    :param mean_return: of the last episodes
    :param speed: calls of `env.step` per second, including updates
    """

    state: str
    steps: int = 0
    mean_return: float | None = None
    speed: float | None = None


def standing(job: Run) -> Standing:
    """Read a run's folder without writing; the run may be on another machine."""
    folder = job.folder
    played = TrainingEpisodes.read(folder / MONITOR)
    steps = int(played.lengths.sum())
    recent = float(played.returns[-RECENT:].mean()) if len(played) else None
    if (folder / "result.json").exists():
        return Standing("finished", job.preset.steps, recent)
    if (folder / "error.txt").exists():
        return Standing("failed", steps, recent)
    if not (folder / "config.yaml").exists():
        return Standing("waiting")
    if not is_locked(folder / "lock"):
        return Standing("stopped", steps, recent)
    if not len(played):
        return Standing("preparing")
    state = "evaluating" if steps >= job.preset.steps else "learning"
    return Standing(state, steps, recent, speed(played.lengths, played.times))


def speed(lengths: np.ndarray, times: np.ndarray) -> float | None:
    """Return the steps per second over the last episodes of the process, None for fewer than 2."""
    begins = np.flatnonzero(np.diff(times) < 0)  # the clock of a resumed run restarts at 0
    since = max(begins[-1] + 1 if len(begins) else 0, len(times) - RECENT)
    lengths, times = lengths[since:], times[since:]
    if len(times) < 2 or times[-1] <= times[0]:
        return None
    return float(lengths[1:].sum() / (times[-1] - times[0]))


def overview(jobs: Sequence[Run]) -> Table:
    """Return a table with a line per run: progress, return, speed, remaining time."""
    table = Table("task", "method", "seed", "state")
    for heading in ("frames", "done", "return", "steps/s", "time left"):
        table.add_column(heading, justify="right")
    for job in jobs:
        now = standing(job)
        steps = job.preset.steps
        left = (steps - now.steps) / now.speed if now.speed else None
        table.add_row(
            *(short_name(job.task), job.method, str(job.seed), now.state),
            f"{now.steps * job.preset.env.action_repeat:,}",
            f"{min(now.steps / steps, 1):.0%}",
            number(now.mean_return),
            number(now.speed),
            "-" if left is None else clock(left),
        )
    return table


def clock(seconds: float) -> str:
    """Format a duration as '1:02:03'."""
    minutes, rest = divmod(round(max(seconds, 0)), 60)
    return f"{minutes // 60}:{minutes % 60:02}:{rest:02}"


@contextmanager
def shown(jobs: Sequence[Run], every: float = 1.0) -> Iterator[Callable[[], None]]:
    """Keep `overview` on the terminal; yield a function that waits briefly and updates it."""
    with Live(overview(jobs), console=console, auto_refresh=False) as live:

        def tick() -> None:
            time.sleep(every)
            live.update(overview(jobs), refresh=True)

        yield tick
        live.update(overview(jobs), refresh=True)


def watch(jobs: Sequence[Run]) -> None:
    """Show `overview` until every run is finished or has failed, without side effects."""
    with shown(jobs) as tick:
        while not all(standing(job).state in ("finished", "failed") for job in jobs):
            tick()
