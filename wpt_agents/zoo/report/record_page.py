"""The pages beside a record: `results.md` and `results.png` of `results.csv`, and its curves."""

from collections.abc import Iterable, Sequence
from pathlib import Path

from wpt_agents.zoo.locks import locked_folder
from wpt_agents.zoo.record_lines import Line
from wpt_agents.zoo.report import evidence, pairs, record_curves, record_picture, record_tables
from wpt_agents.zoo.report import record as records
from wpt_agents.zoo.report.folders import Finished
from wpt_agents.zoo.text_files import write_atomically

INTRODUCTION = """\
# Recorded scores

This page shows the scores in the CSV file of the same name, a record of runs that
`python -m wpt_agents.zoo run` and `report` keep with the option `--record`. A policy has the name
of its method. `nothing` does nothing, `random` acts uniformly at random, and `prior actor` is the
behaviour clone with which WPT begins; `prior actor, METHOD` is the clone of another method. If runs
kept the policy that did best in evaluations, this is `METHOD`, and `METHOD, last` is the last one.
`METHOD, after head start` is the policy after the first `actor_delay` updates, and `METHOD,
imitating actor` its actor alone, if the prior actor takes part in acting (`residual`, `ibrl`).
"""


def check(record: Path) -> None:
    """Raise an error if a path cannot be a record, or if its files are damaged."""
    if record.suffix != ".csv":
        raise ValueError(
            f"--record {record}: a record is a .csv; its .md and .png are written beside it"
        )
    if record.exists():
        records.read(record)
    record_curves.read(record)


def add(record: Path, runs: Sequence[Finished]) -> None:
    """Add runs to a record, and write its pages; several processes take turns."""
    update(record, records.lines_of(runs), record_curves.points_of(runs))


def update(record: Path, lines: Iterable[Line], points: Iterable[record_curves.Point] = ()) -> None:
    """Add lines and curves to a record and write its pages; several processes take turns."""
    with locked_folder(record.parent):
        record_curves.update(record, points)
        write(record, records.update(record, lines))


def renew(record: Path) -> None:
    """Write the pages of a record again; several processes take turns."""
    with locked_folder(record.parent):
        write(record, records.read(record))


def write(record: Path, lines: Sequence[Line]) -> None:
    """Write the tables and the pictures of a record beside it."""
    lines = records.shown(lines)
    write_atomically(record.with_suffix(".md"), markdown(lines))
    record_picture.draw(record.with_suffix(".png"), lines)
    record_curves.draw(record, record_curves.read(record), lines)


def markdown(lines: Sequence[Line]) -> str:
    """Return an introduction, the tables of each suite, the pairs, every run, and the means."""
    parts = (
        *(INTRODUCTION, evidence.markdown(lines), pairs.markdown(lines)),
        record_tables.markdown(lines),
    )
    return "\n".join(part for part in parts if part)
