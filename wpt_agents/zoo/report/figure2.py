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
    :param missing: a line for each task that lacks methods
    """

    curves: Sequence[str]
    names: Sequence[str]
    all_names: Sequence[str]
    missing: Sequence[str]


def figure_2(runs: Sequence[Finished], names: Names) -> Figure2 | None:
    """Return Fig. 2 from the existing runs; None if there is no run of its tasks."""
    drawn = [task_curves(task, runs, names) for task in FIGURE_2]
    curves = [figure for figure in drawn if figure is not None]
    if not curves:
        return None
    missing = []
    for task in FIGURE_2:
        methods = {run.result.method for run in runs if run.result.task == task}
        lacking = [method for method in COMPARED if method not in methods]
        if len(lacking) == len(COMPARED):
            missing.append(f"{task}: no run")
        elif lacking:
            missing.append(
                f"{task}: no run of {counted(len(lacking), 'method')}, {', '.join(lacking)}"
            )
    drawn_names = {names(run.experiment) for run in runs if run.result.task in FIGURE_2}
    return Figure2(curves, [n for n in names.all if n in drawn_names], names.all, missing)
