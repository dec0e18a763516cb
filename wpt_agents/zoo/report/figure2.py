"""Fig. 2 of the paper, right: learning curves of six tasks with all methods."""

from collections.abc import Sequence
from dataclasses import dataclass

from wpt_agents.files.names import counted
from wpt_agents.zoo.report.folders import Finished
from wpt_agents.zoo.report.sections import Names, task_curves

# The paper's text names the tasks of this figure; "Stick Pull" is named with one of them only.
FIGURE_2 = (
    "dmc-cheetah-run-hard",
    "dmc-walker-run",
    "dmc-quadruped-walk",
    "metaworld-assembly",
    "metaworld-shelf-place",
    "metaworld-stick-pull",
)
COMPARED = ("wpt", "drq-v2", "dreamer-v3", "r3m", "jsrl-bc", "uds", "explore")


@dataclass(frozen=True)
class Figure2:
    """The figure, as complete as the runs allow.

    :param curves: SVG, one for each task
    :param names: of the curves' experiments
    :param all_names: of all experiments of the page, for the colours
    :param missing: lines about tasks that lack methods, or evaluations of them
    """

    curves: Sequence[str]
    names: Sequence[str]
    all_names: Sequence[str]
    missing: Sequence[str]


def figure_2(runs: Sequence[Finished], names: Names) -> Figure2 | None:
    """Return Fig. 2 from the existing runs; None if there is no run of its tasks."""
    of_figure = [run for run in runs if run.result.task in FIGURE_2]
    if not of_figure:
        return None
    drawn = [task_curves(task, of_figure, names) for task in FIGURE_2]
    drawn_names = {names(run.experiment) for run in of_figure if run.evaluations()}
    return Figure2(
        curves=[figure for figure in drawn if figure is not None],
        names=[name for name in names.all if name in drawn_names],
        all_names=names.all,
        missing=[line for task in FIGURE_2 for line in _missing(task, of_figure)],
    )


def _missing(task: str, runs: Sequence[Finished]) -> list[str]:
    """Return lines about methods without a run of a task, and about runs without a curve."""
    of_task = [run for run in runs if run.result.task == task]
    methods = dict.fromkeys(run.result.method for run in of_task)
    drawn = {run.result.method for run in of_task if run.evaluations()}
    lacking = [method for method in COMPARED if method not in methods]
    lines = []
    if len(lacking) == len(COMPARED):
        lines.append(f"{task}: no run")
    elif lacking:
        lines.append(f"{task}: no run of {counted(len(lacking), 'method')}, {', '.join(lacking)}")
    if undrawn := [method for method in methods if method not in drawn]:
        lines.append(f"{task}: no evaluations of {', '.join(undrawn)}")
    return lines
