"""The paper's Tables 3 to 5 with our numbers beside the paper's."""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from wpt_agents.zoo.numbers import POSSIBLE, evidence_text, seeds_text
from wpt_agents.zoo.report import aggregates
from wpt_agents.zoo.report.aggregates import PAPER_BUDGET, STATISTICS, Reference
from wpt_agents.zoo.report.folders import Finished
from wpt_agents.zoo.report.sections import PRINTED, Names
from wpt_agents.zoo.statistics import mean_interval

OFFICIAL = {  # published by the authors of these methods, on eight tasks of Table 5
    "dreamer-v3-official": "DreamerV3, by its authors",
    "drq-v2-official": "DrQ-v2, by its authors",
    "mrq-official": "MR.Q, by its authors",
}
COLUMNS = PRINTED | OFFICIAL
OURS_PER_TABLE = 6  # of our columns; with the paper's they fit into a window of 1,440 pixels
TITLES = {3: "Meta-World", 4: "Meta-World, continued", 5: "DMControl"}


@dataclass(frozen=True)
class Cell:
    """Our mean on a task or over tasks.

    :param run: the name of the first run, None for an aggregate over tasks
    :param tasks: the number of tasks of an aggregate
    :param interval: the 95 % interval over seeds by Student's t, or what takes its place
    :param note: budget, seeds and commits; "" if they are in the column's heading
    """

    mean: float
    run: str | None = None
    tasks: int = 0
    interval: str = ""
    note: str = ""


@dataclass(frozen=True)
class TableRow:
    """One task, or the mean or median over tasks.

    :param paper: the printed scores, each with the correct value if it is a misprint
    :param ours: a cell for each of our columns, None without a run
    """

    task: str
    aggregate: bool
    paper: Sequence[tuple[float | None, float | None]]
    ours: Sequence[Cell | None]


@dataclass(frozen=True)
class PaperTable:
    """One of the tables; tasks without runs are separate, and so are columns that few look for.

    :param ours: our columns' names, each with the note that all of its cells share
    :param groups: the places of our columns in each of the tables that they are divided among
    :param near: the places of the paper's columns at its own budget, which are beside ours
    :param far: the places of the other columns
    :param evidence: from how many seeds and episodes our scores are
    """

    number: int
    title: str
    metric: str
    columns: Sequence[str]
    ours: Mapping[str, str]
    groups: Sequence[Sequence[int]]
    near: Sequence[int]
    far: Sequence[int]
    rows: Sequence[TableRow]
    not_run: Sequence[TableRow]
    source: str
    misprints: bool
    evidence: str


Cells = Mapping[tuple[str, str], Sequence[Finished]]  # runs by task and column


def paper_tables(runs: Sequence[Finished], names: Names) -> list[PaperTable]:
    """Return the tables of the suites that were run."""
    tables = []
    for number in TITLES:
        printed = [row for row in aggregates.references() if row.table == number]
        of_suite = [run for run in runs if run.result.suite == printed[0].suite]
        if of_suite:
            tables.append(paper_table(number, printed, of_suite, names))
    return tables


def paper_table(
    number: int, printed: Sequence[Reference], runs: Sequence[Finished], names: Names
) -> PaperTable:
    """Return one of the tables."""
    cells: dict[tuple[str, str], list[Finished]] = defaultdict(list)
    for run in runs:
        cells[run.result.task, names(run.experiment)].append(run)
    ours = list(dict.fromkeys(name for _, name in cells))
    columns = list(dict.fromkeys((row.method, row.samples) for row in reversed(printed)))
    tasks = list(dict.fromkeys(row.task for row in printed))
    shown = {*(task for task, _ in cells), *STATISTICS}
    rows = {task: table_row(task, printed, columns, ours, cells) for task in tasks}
    run_rows = [row for task, row in rows.items() if task in shown]
    notes = [shared_note(run_rows, place) for place in range(len(ours))]
    near = [i for i, (method, n) in enumerate(columns) if n == PAPER_BUDGET and method in PRINTED]
    return PaperTable(
        number=number,
        title=TITLES[number],
        metric="success rate" if printed[0].suite == "metaworld" else "return",
        columns=[f"{COLUMNS[method]}, {samples_text(n)} frames" for method, n in columns],
        ours=dict(zip(ours, notes, strict=True)),
        groups=[
            range(start, min(start + OURS_PER_TABLE, len(ours)))
            for start in range(0, len(ours), OURS_PER_TABLE)
        ],
        near=near,
        far=[place for place in range(len(columns)) if place not in near],
        rows=[without_notes(row, notes) for row in run_rows],
        not_run=[row for task, row in rows.items() if task not in shown],
        source="; ".join(dict.fromkeys(row.source for row in printed)),
        misprints=any(aggregates.misprint(row) is not None for row in printed),
        evidence=evidence_text([run.result for run in runs]),
    )


def table_row(
    task: str,
    printed: Sequence[Reference],
    columns: Sequence[tuple[str, int]],
    ours: Sequence[str],
    cells: Cells,
) -> TableRow:
    """Return the paper's numbers on a task, misprints marked, and ours."""
    theirs = {(row.method, row.samples): row for row in printed if row.task == task}
    paper = [
        (theirs[c].score, aggregates.misprint(theirs[c])) if c in theirs else (None, None)
        for c in columns
    ]
    if task in STATISTICS:
        our_cells: list[Cell | None] = [
            our_aggregate(task, of_paper(cells, column, printed[0].suite)) for column in ours
        ]
    else:
        our_cells = [our_cell(cells.get((task, column), [])) for column in ours]
    return TableRow(task, task in STATISTICS, paper, our_cells)


def shared_note(rows: Sequence[TableRow], place: int) -> str:
    """Return the common note of the cells in one of our columns, "" if they differ."""
    notes = {cell.note for row in rows if (cell := row.ours[place]) and cell.run}
    return notes.pop() if len(notes) == 1 else ""


def without_notes(row: TableRow, notes: Sequence[str]) -> TableRow:
    """Return the row without the notes that are in the headings of its columns."""
    cells = [
        replace(cell, note="") if cell and note else cell
        for cell, note in zip(row.ours, notes, strict=True)
    ]
    return replace(row, ours=cells)


def of_paper(cells: Cells, column: str, suite: str) -> list[Sequence[Finished]]:
    """Return the runs of a column on each of the paper's tasks, which the tables have rows for."""
    tasks = aggregates.paper_tasks(suite)
    return [runs for (task, name), runs in cells.items() if name == column and task in tasks]


def our_aggregate(name: str, tasks: Sequence[Sequence[Finished]]) -> Cell | None:
    """Return the mean or median over tasks of each task's mean over seeds, in the table's units."""
    if not tasks:
        return None
    scores = [np.array([run.result.counted() for run in runs]) for runs in tasks]
    return Cell(float(STATISTICS[name](scores)), tasks=len(scores))


def samples_text(samples: int) -> str:
    """Format a number of samples as 150k or 1M."""
    return f"{samples // 1000}k" if samples < 10**6 else f"{samples // 10**6}M"


def our_cell(runs: Sequence[Finished]) -> Cell | None:
    """Return mean, interval, seeds, budget and commits of runs that differ only in the seed."""
    if not runs:
        return None
    first = runs[0].result
    scores = [run.result.counted() for run in runs]
    middle, low, high = mean_interval(scores)
    seeds = ", ".join(str(run.result.seed) for run in runs)
    commits = ", ".join(sorted({run.result.commit_name for run in runs}))
    return Cell(
        mean=middle,
        run=runs[0].name,
        interval=seeds_text(scores, low, high, POSSIBLE[first.metric]),
        note=f"{first.frames:,} frames, seeds {seeds}, commit {commits}",
    )
