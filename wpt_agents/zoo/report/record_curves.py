"""The learning curves of a record: `curves/results.csv` and `curves/results.png` of `results.csv`.

The evaluations during fine-tuning are in the run folders, which may be deleted; like the record,
the table keeps them.
"""

import csv
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from wpt_agents.zoo.pictures.style import plt
from wpt_agents.zoo.record_lines import Identity, Line, csv_of
from wpt_agents.zoo.report.aggregates import normalised
from wpt_agents.zoo.report.evidence import Evidence, evidence
from wpt_agents.zoo.report.folders import Finished
from wpt_agents.zoo.report.record import place
from wpt_agents.zoo.report.record_picture import (
    PAPER_NAME,
    STYLES,
    Style,
    least,
    legend_of,
    save,
    styles_of,
)
from wpt_agents.zoo.result import PRIOR_ACTOR, Variant
from wpt_agents.zoo.text_files import write_atomically

COLUMNS = 5  # panels in a row


@dataclass(frozen=True)
class Point:
    """The mean score of an evaluation during fine-tuning.

    :param frames: the budget of the run
    :param at: frames before the evaluation
    :param score: 0 to 100 as in a record
    """

    suite: str
    task: str
    method: str
    seed: int
    preset: Variant
    frames: int
    at: int
    episodes: int
    score: float

    @property
    def run(self) -> Identity:
        """The identity of the run."""
        return self.task, self.method, str(self.preset), self.frames, self.seed


def place_of(record: Path) -> Path:
    """Return the file with the curves of a record."""
    return record.parent / "curves" / record.name


def points_of(runs: Iterable[Finished]) -> Iterator[Point]:
    """Yield the evaluations of runs during fine-tuning."""
    for run in runs:
        one = run.result
        if (evaluations := run.evaluations()) is None:
            continue
        for at, scores in zip(*evaluations, strict=True):
            score = round(100 * normalised(float(scores.mean()), one.metric), 2)
            labels = one.suite, one.task, one.method, one.seed, one.variant, one.frames
            yield Point(*labels, round(at), len(scores), score)


def update(record: Path, points: Iterable[Point]) -> list[Point]:
    """Add points to the curves of a record, in place of those of the same runs; return all."""
    points = list(points)
    again = {point.run for point in points}
    before = [point for point in read(record) if point.run not in again]
    every = sorted([*before, *points], key=lambda p: (p.suite, *p.run, p.at))
    if every:
        write_atomically(place_of(record), csv_of(Point, every))
    return every


def read(record: Path) -> list[Point]:
    """Read the curves of a record; there are none without a file.

    :raises ValueError: if the file is damaged
    """
    path = place_of(record)
    if not path.exists():
        return []
    try:
        with open(path, newline="", encoding="utf-8-sig") as file:
            return [_parse(row) for row in csv.DictReader(file)]
    except (KeyError, TypeError, ValueError, csv.Error) as error:
        raise ValueError(f"{path} does not hold learning curves ({error}); delete it") from None


def _parse(row: Mapping[str, str]) -> Point:
    return Point(
        *(row["suite"], row["task"], row["method"], int(row["seed"]), Variant.parse(row["preset"])),
        *(int(row["frames"]), int(row["at"]), int(row["episodes"]), float(row["score"])),
    )


def draw(record: Path, points: Sequence[Point], lines: Sequence[Line]) -> None:
    """Draw the curves of the unchanged preset with the usual budget, a panel for each task.

    :param lines: of the record, whose prior actor is a dashed line; the paper's WPT is a dotted one
    """
    panels = [
        (one, task, curves)
        for one in evidence(lines)
        for task, curves in curves_of(one, points).items()
    ]
    if not panels:
        return
    names = {method for _, _, curves in panels for method in curves}
    styles = styles_of(sorted(names, key=place))
    columns = min(COLUMNS, len(panels))
    rows = -(-len(panels) // columns)
    figure, axes = plt.subplots(
        *(rows, columns),
        figsize=(2.2 * columns + 0.4, 1.6 * rows + 0.9),
        squeeze=False,
        layout="constrained",
    )
    for panel, (one, task, curves) in zip(axes.flat, panels, strict=False):
        _draw_panel(panel, one, task, curves, styles)
    for panel in axes.flat[len(panels) :]:
        panel.remove()
    _legend(figure, columns)
    save(figure, place_of(record).with_suffix(".png"))


Curves = dict[str, dict[int, list[float]]]  # method -> frames -> the score of each seed


def curves_of(one: Evidence, points: Sequence[Point]) -> dict[str, Curves]:
    """Return the curves of each task of a suite, of runs with the usual preset and budget."""
    usual = one.suite, one.preset, one.frames
    tasks: dict[str, Curves] = {}
    for point in points:
        if (point.suite, point.preset, point.frames) == usual:
            methods = tasks.setdefault(point.task, {})
            methods.setdefault(point.method, defaultdict(list))[point.at].append(point.score)
    return dict(sorted(tasks.items()))


def _draw_panel(
    panel: Axes, one: Evidence, task: str, curves: Curves, styles: Mapping[str, Style]
) -> None:
    for method in sorted(curves, key=place):
        at = np.array(sorted(curves[method]))
        seeds = [curves[method][frames] for frames in at]
        colour, marker = styles[method]
        panel.plot(
            at / 1000, list(map(np.mean, seeds)), marker, ls="-", c=colour, ms=3, label=method
        )
        panel.fill_between(
            at / 1000, list(map(min, seeds)), list(map(max, seeds)), color=colour, alpha=0.2, lw=0
        )
    if prior := one.scores.get(PRIOR_ACTOR, {}).get(task):
        mean = float(np.mean(list(prior.values())))
        panel.axhline(mean, color=STYLES[PRIOR_ACTOR].colour, ls="--", lw=1, label=PRIOR_ACTOR)
    if (paper := one.paper["wpt"].get(task)) is not None:
        panel.axhline(paper, color="black", ls=":", lw=1, label=PAPER_NAME.replace("\n", " "))
    seeds_of = [scores for seeds in curves.values() for scores in seeds.values()]
    bottom = least(chain((prior or {}).values(), *seeds_of), -4)
    panel.set(ylim=(bottom, 104), title=task.removeprefix(f"{one.suite}-"))
    panel.title.set_fontsize(8)
    panel.tick_params(labelsize=7)
    panel.grid(lw=0.4)
    panel.spines[["top", "right"]].set_visible(False)


def _legend(figure: Figure, columns: int) -> None:
    labels = legend_of(figure)
    figure.legend(
        *(labels.values(), labels.keys()),
        loc="outside upper center",
        ncols=min(4, columns),  # a picture of few panels is narrow
        fontsize=8,
    )
    figure.supxlabel("thousand frames", fontsize=8)
    figure.supylabel("score, 0 to 100", fontsize=8)
