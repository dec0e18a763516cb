"""The record: one CSV line per task, method, seed and policy, small enough for a repository.

Run folders are large and may be deleted; the record keeps their results. Lines of runs that no
longer exist are kept, and lines of the same run are replaced, also those of policies that it no
longer has.
"""

import csv
import io
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from wpt_agents.files.archive import replacing
from wpt_agents.zoo.plan.methods import METHODS
from wpt_agents.zoo.plan.runs import Run
from wpt_agents.zoo.report.aggregates import BEST_RETURN
from wpt_agents.zoo.report.folders import Finished
from wpt_agents.zoo.report.names import policy_name
from wpt_agents.zoo.result import PRIOR_ACTOR, UNTRAINED, Result, Variant
from wpt_agents.zoo.tasks import short_name

Identity = tuple[str, str, str, int, int]  # task, method or policy, preset, frames, seed


@dataclass(frozen=True)
class Line:
    """The score of one policy of one run.

    :param method: the run's method for its final policy, else the policy's name
    :param score: 0 to 100 as in the paper: the return / 10, or the share of successes x 100
    :param hours: hours of the whole run, including shared stages that it executed
    :param updates: gradient updates of fine-tuning; None where unknown, as in version 0.1
    :param cpu_hours: CPU hours of fine-tuning by the learner's process; a worker process in which
        the environment steps, as the model-free agents have, is not counted; None where unknown
    :param model_hash: the first digits of the SHA-256 of the pre-trained model file that
        fine-tuning began with; "" without one, or where unknown
    :param policy: one of `POLICIES`; "" in records of version 0.1
    """

    suite: str
    task: str
    method: str
    seed: int
    preset: Variant
    frames: int
    score: float
    return_: float
    success: float | None
    hours: float
    commit: str
    command: str
    updates: int | None = None
    cpu_hours: float | None = None
    model_hash: str = ""
    policy: str = ""

    @property
    def run(self) -> Identity:
        """The identity of the line."""
        return self.task, self.method, str(self.preset), self.frames, self.seed

    @property
    def agent(self) -> Identity:
        """The identity of the agent, which is the same for "wpt" and "wpt, last"."""
        clone = self.method.startswith(PRIOR_ACTOR)  # "prior actor, no-pretrain" is another one
        method = self.method if clone else self.method.split(",")[0]
        return self.task, method, str(self.preset), self.frames, self.seed


KNOWN = (  # of methods in tables: the simplest first, then the paper's ablation, then ours
    *("nothing", "random", "prior actor", "scratch", "pretrain-only", "no-guidance"),
    *("no-rehearsal", "random-retrieval", "no-pretrain", "wpt", "kickstart"),
)
ORDER = (*KNOWN, *(name for name in METHODS if name not in KNOWN))
COLUMNS = [field.name.rstrip("_") for field in fields(Line)]
OPTIONAL = ("updates", "cpu_hours", "model_hash", "policy")  # records of version 0.1 lack them


def identity_of(job: Run) -> Identity:
    """Return the identity of the line that the final policy of a run gets."""
    frames = job.preset.learn.frames
    return short_name(job.task), job.method, str(job.variant), frames, job.seed


def lines_of(runs: Iterable[Finished]) -> list[Line]:
    """Return the lines of run folders; untrained policies once per task and seed."""
    last = sorted(runs, key=lambda run: run.result.method == "wpt")  # its prior actor is shown
    lines = {line.run: line for run in last for line in _lines(run.result)}
    return sorted(lines.values(), key=order)


def _lines(result: Result) -> Iterator[Line]:
    for policy, score in result.scores.items():
        success = score.success_rate if result.metric == "success" else None
        trained = policy not in UNTRAINED
        yield Line(
            suite=result.suite,
            task=result.task,
            method=policy_name(result, policy),
            seed=result.seed,
            preset=result.variant if trained else result.variant.playing,
            frames=result.frames if trained else 0,
            score=round(100 * (score.mean / BEST_RETURN if success is None else success), 2),
            return_=round(score.mean, 2),
            success=success,
            hours=round(sum(result.seconds.values()) / 3600, 4),
            commit=result.commit_name,
            command=result.command,
            updates=result.updates if trained else None,
            cpu_hours=_hours(result.cpu_seconds) if trained else None,
            model_hash=(result.pretrained or "") if trained else "",
            policy=policy,
        )


def _hours(seconds: float | None) -> float | None:
    return None if seconds is None else round(seconds / 3600, 4)


def order(line: Line) -> tuple[str, str, int, str, str, int, int]:
    """Return the place of a line in a record."""
    method = place(line.method), line.method
    return line.suite, line.task, *method, str(line.preset), line.frames, line.seed


def place(method: str) -> int:
    """Return the place of a method: "wpt, last" where "wpt" is, unknown ones at the end."""
    name = method.split(",")[0]
    return ORDER.index(name) if name in ORDER else len(ORDER)


def update(path: Path, lines: Iterable[Line]) -> list[Line]:
    """Add `lines` to the record at `path` atomically.

    :return: all lines of the updated record
    """
    lines = list(lines)
    again = {line.agent for line in lines}
    known = read(path) if path.exists() else []
    before = [line for line in known if line.agent not in again]
    warn_of_replaced(path, known, lines)
    every = sorted({line.run: line for line in [*before, *lines]}.values(), key=order)
    file = io.StringIO()
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(COLUMNS)
    names = [field.name for field in fields(Line)]
    writer.writerows([getattr(line, name) for name in names] for line in every)
    with replacing(path) as temporary:
        temporary.write_text(file.getvalue(), encoding="utf-8")
    return every


def warn_of_replaced(path: Path, known: Iterable[Line], lines: Iterable[Line]) -> None:
    """Warn of lines whose score is replaced by that of another commit or pre-trained model."""
    old = {line.run: line for line in known}
    changes = [
        f"{line.task}, {line.method}, seed {line.seed}: {old[line.run].score:g} of "
        f"{made_with(old[line.run])} by {line.score:g} of {made_with(line)}"
        for line in lines
        if line.frames
        and line.run in old
        and made_with(line) != made_with(old[line.run])
        and line.return_ != old[line.run].return_
    ]
    if changes:
        warnings.warn(f"{path} now has other scores: {'; '.join(changes)}", stacklevel=2)


def made_with(line: Line) -> str:
    """Return the commit of a line, with its pre-trained model if it has one."""
    return f"commit {line.commit}" + (f" and model {line.model_hash}" if line.model_hash else "")


def read(path: Path) -> list[Line]:
    """Read the lines of a record.

    :raises ValueError: if the file is no record or is damaged
    """
    try:
        with open(path, newline="", encoding="utf-8") as file:
            return [_parse(row) for row in csv.DictReader(file)]
    except (KeyError, TypeError, ValueError, csv.Error) as error:
        raise ValueError(
            f"{path} is not a record of runs ({error}); its columns are {', '.join(COLUMNS)}"
        ) from None


PARSERS: Mapping[str, Callable[[str], Any]] = {
    "seed": int,
    "preset": Variant.parse,
    "frames": int,
    "score": float,
    "return": float,
    "success": lambda text: float(text) if text else None,
    "hours": float,
    "updates": lambda text: int(text) if text else None,
    "cpu_hours": lambda text: float(text) if text else None,
}


def _parse(row: Mapping[str, str]) -> Line:
    cells = {name: row.get(name, "") if name in OPTIONAL else row[name] for name in COLUMNS}
    return Line(*(PARSERS.get(name, str)(text) for name, text in cells.items()))
