"""How steady the policies of each run were: their last evaluations during fine-tuning.

The score at the end judges a single policy, and policies can get better and worse from update to
update.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from wpt_agents.zoo.numbers import number
from wpt_agents.zoo.report.folders import Finished
from wpt_agents.zoo.report.tables import markdown_table
from wpt_agents.zoo.result import Result

CONSIDERED = 10  # evaluations at most
HEADINGS = (
    *("task", "method", "preset", "seed", "evaluations", "episodes in each", "from frame"),
    *("mean", "worst", "last"),
)
NOTE = (
    "A run can make updates after its last evaluation, for example those that follow its last "
    'episode. So the column "last" may show an earlier policy than the one that is scored at the '
    "end."
)


@dataclass(frozen=True)
class Steadiness:
    """The last evaluations in the second half of a run.

    :param start: frames before the first of them
    :param scores: (N, episodes), successes of tasks that count them, else returns
    """

    result: Result
    start: int
    scores: np.ndarray

    @property
    def means(self) -> np.ndarray:
        """The score of each evaluation, (N,)."""
        return self.scores.mean(1)


def steadiness(runs: Iterable[Finished]) -> list[Steadiness]:
    """Return the last evaluations of every run that was evaluated in its second half."""
    rows = []
    for run in runs:
        if evaluations := run.evaluations():
            frames, scores = evaluations
            late = np.flatnonzero(frames >= run.result.frames / 2)[-CONSIDERED:]
            if len(late):
                rows.append(Steadiness(run.result, round(frames[late[0]]), scores[late]))
    return rows


def cells(row: Steadiness) -> list[str]:
    """Write a row as text, in the order of HEADINGS."""
    result = row.result
    evaluations, episodes = row.scores.shape
    means = row.means
    return [
        *(result.task, result.method, str(result.variant), str(result.seed)),
        *(str(evaluations), str(episodes), f"{row.start:,}"),
        *map(number, (means.mean(), means.min(), means[-1])),
    ]


def markdown(rows: Sequence[Steadiness]) -> str:
    """Return the rows as a Markdown table with a heading and a note; empty if there are none."""
    if not rows:
        return ""
    title = f"### The last evaluations in the second half of each run, {CONSIDERED} at most"
    return f"{title}\n\n{markdown_table(HEADINGS, map(cells, rows))}\n{NOTE}\n"
