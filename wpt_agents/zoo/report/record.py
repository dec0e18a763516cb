"""The record: one CSV line per task, method, seed and policy, small enough for a repository.

Run folders are large and may be deleted; the record keeps their results. Lines of runs that no
longer exist are kept, and lines of the same run are replaced, also those of policies that it no
longer has.
"""

import warnings
from collections.abc import Iterable, Iterator
from pathlib import Path

from wpt_agents.zoo.plan.methods import METHODS
from wpt_agents.zoo.record_lines import Identity, Line, csv_of, read
from wpt_agents.zoo.report.aggregates import normalised
from wpt_agents.zoo.report.folders import Finished
from wpt_agents.zoo.report.names import policy_name
from wpt_agents.zoo.result import UNTRAINED, Result
from wpt_agents.zoo.text_files import write_atomically

KNOWN = (  # of methods in tables: the simplest first, then the paper's ablation, then ours
    *("nothing", "random", "prior actor", "scratch", "pretrain-only", "no-guidance"),
    *("no-rehearsal", "random-retrieval", "no-pretrain", "wpt", "kickstart"),
)
ORDER = (*KNOWN, *(name for name in METHODS if name not in KNOWN))


def lines_of(runs: Iterable[Finished]) -> list[Line]:
    """Return the lines of run folders; untrained policies once per task and seed."""
    last = sorted(runs, key=lambda run: run.result.method == "wpt")  # untrained policies are its
    lines = {line.identity: line for run in last for line in _lines(run.result)}
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
            score=round(100 * normalised(score.counted(result.metric), result.metric), 2),
            return_=round(score.mean, 2),
            success=success,
            hours=round(sum(result.seconds.values()) / 3600, 4),
            commit=result.commit_name,
            command=result.command,
            updates=result.updates if trained else None,
            cpu_hours=_hours(result.cpu_seconds) if trained else None,
            model_hash=(result.pretrained or "") if trained else "",
            policy=policy,
            success_any=score.success_rate_any if result.metric == "success" else None,
        )


def _hours(seconds: float | None) -> float | None:
    return None if seconds is None else round(seconds / 3600, 4)


def shown(lines: Iterable[Line]) -> list[Line]:
    """Return the lines that tables and pictures show: of prior actors of one name only one.

    Methods that train the prior actor as `wpt` does use the same name for it. If `wpt` was run,
    its own is shown.
    """
    kept: dict[Identity, Line] = {}
    for line in sorted(lines, key=order):
        named = line.task, line.method, str(line.preset), line.frames, line.seed
        kept.setdefault(named, line)
    return list(kept.values())


def order(line: Line) -> tuple[str, str, int, str, str, int, int, bool, str]:
    """Return the place of a line in a record."""
    method = place(line.method), line.method
    of = line.run_method != "wpt", line.run_method
    return line.suite, line.task, *method, str(line.preset), line.frames, line.seed, *of


def place(method: str) -> int:
    """Return the place of a method: "wpt, last" where "wpt" is, unknown ones at the end."""
    name = method.split(",")[0]
    return ORDER.index(name) if name in ORDER else len(ORDER)


def update(path: Path, lines: Iterable[Line]) -> list[Line]:
    """Add `lines` to the record at `path` atomically.

    :return: all lines of the updated record
    """
    lines = list(lines)
    again = {line.run for line in lines}
    known = read(path) if path.exists() else []
    before = [line for line in known if line.run not in again]
    warn_of_replaced(path, known, lines)
    every = sorted({line.identity: line for line in [*before, *lines]}.values(), key=order)
    write_atomically(path, csv_of(Line, every))
    return every


def warn_of_replaced(path: Path, known: Iterable[Line], lines: Iterable[Line]) -> None:
    """Warn of lines whose score is replaced by that of another commit or pre-trained model."""
    old = {line.identity: line for line in known}
    changes = [
        f"{line.task}, {line.method}, seed {line.seed}: {old[line.identity].score:g} of "
        f"{made_with(old[line.identity])} by {line.score:g} of {made_with(line)}"
        for line in lines
        if line.frames
        and line.identity in old
        and made_with(line) != made_with(old[line.identity])
        and line.return_ != old[line.identity].return_
    ]
    if changes:
        warnings.warn(f"{path} now has other scores: {'; '.join(changes)}", stacklevel=2)


def made_with(line: Line) -> str:
    """Return the commit of a line, with its pre-trained model if it has one."""
    return f"commit {line.commit}" + (f" and model {line.model_hash}" if line.model_hash else "")
