"""The pages beside a record: `results.md` and `results.png` of `results.csv`."""

from collections.abc import Iterable, Sequence
from pathlib import Path

from wpt_agents.files.archive import replacing
from wpt_agents.zoo.report import evidence, pairs, record_picture, record_tables
from wpt_agents.zoo.report import record as records
from wpt_agents.zoo.report.record import Line
from wpt_agents.zoo.run.locks import locked_folder


def update(record: Path, lines: Iterable[Line]) -> None:
    """Add lines to a record and write its pages; several processes take turns."""
    with locked_folder(record.parent):
        write(record, records.update(record, lines))


def write(record: Path, lines: Sequence[Line]) -> None:
    """Write the tables and the picture of a record beside it."""
    with replacing(record.with_suffix(".md")) as temporary:
        temporary.write_text(markdown(lines), encoding="utf-8")
    record_picture.draw(record.with_suffix(".png"), lines)


def markdown(lines: Sequence[Line]) -> str:
    """Return the evidence of each suite, the pairs, every run, and the means over tasks."""
    parts = (evidence.markdown(lines), pairs.markdown(lines), record_tables.markdown(lines))
    return "\n".join(part for part in parts if part)
