"""The numbers of all runs below a folder, as the command `report` prints and writes them."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Self

from wpt_agents.zoo.report import steadiness, tables
from wpt_agents.zoo.report.figure4 import (
    Figure4,
    figures_4,
    find_sequences,
    sequence_markdown,
    sequence_table,
)
from wpt_agents.zoo.report.folders import (
    Finished,
    Unfinished,
    find_finished,
    find_unfinished,
    unfinished_text,
)
from wpt_agents.zoo.report.page import render
from wpt_agents.zoo.terminal import console
from wpt_agents.zoo.text_files import write_atomically


@dataclass(frozen=True)
class Summary:
    """The finished runs and sequences below a folder, and their tables.

    :param rows: a row for each task and method
    :param policies: a row for each task and policy
    :param steady: how much the policies change from evaluation to evaluation
    """

    runs: Sequence[Finished]
    unfinished: Sequence[Unfinished]
    sequences: Sequence[Figure4]
    rows: Sequence[tables.Row]
    policies: Sequence[tables.PolicyRow]
    steady: Sequence[steadiness.Steadiness]

    @classmethod
    def of(cls, folder: Path) -> Self:
        """Read all runs below a folder.

        :raises ValueError: if a run exists twice
        """
        runs = find_finished(folder)
        results = [run.result for run in runs]
        return cls(
            runs,
            find_unfinished(folder),
            figures_4(find_sequences(folder)),
            tables.summarise(results),
            tables.policies(results),
            steadiness.steadiness(runs),
        )

    @property
    def missing(self) -> str:
        """A paragraph that names unfinished and failed runs, "" without any."""
        return unfinished_text(self.unfinished)

    def markdown(self) -> str:
        """Return all tables as Markdown."""
        tasks = tables.markdown(self.rows) if self.rows else ""
        policies = tables.policy_markdown(self.policies) if self.rows else ""
        steady = steadiness.markdown(self.steady)
        parts = (tasks, policies, steady, sequence_markdown(self.sequences), self.missing)
        return "\n".join(filter(None, parts))

    def csv(self) -> str:
        """Return a line of CSV for every policy."""
        return tables.policy_csv(self.policies)

    def write(self, page: Path, media: str) -> None:
        """Write the page, and Markdown and CSV files beside it.

        :param media: as `render` takes it
        """
        write_atomically(page, render(self.runs, self.unfinished, self.sequences, media))
        write_atomically(page.with_name("report.md"), self.markdown())
        write_atomically(page.with_name("policies.csv"), self.csv())

    def show(self) -> None:
        """Print the means of every task and method, the sequences, and what is missing."""
        if self.rows:
            console.print(tables.summary_table(self.rows))
        if self.sequences:
            console.print(sequence_table(self.sequences))
        if self.missing:
            console.print(self.missing, markup=False)
