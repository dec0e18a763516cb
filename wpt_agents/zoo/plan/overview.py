"""The table that `run --dry-run` prints."""

from collections.abc import Sequence

from rich.table import Table

from wpt_agents.files.names import counted
from wpt_agents.zoo.plan.methods import METHODS
from wpt_agents.zoo.plan.runs import Run
from wpt_agents.zoo.tasks import short_name
from wpt_agents.zoo.terminal import console


def show_plan(jobs: Sequence[Run], force: bool) -> None:
    """Prints what would be done, and what is there already."""
    table = Table("task", "method", "seed", "env steps", "updates", "state", "folder")
    for job in jobs:
        state = "finished" if job.result() and not force else "to do"
        numbers = f"{job.preset.steps:,}", f"{job.updates:,}"
        names = short_name(job.task), job.method, str(job.seed)
        table.add_row(*names, *numbers, state, str(job.folder))
    console.print(table)
    shared = {job.shared.model_path: job.shared for job in jobs if METHODS[job.method].needs_data}
    for path, each in shared.items():
        episodes = each.preset.collect.episodes * len(each.tasks)
        state = "there" if each.data_path.exists() else f"{counted(episodes, 'episode')} to collect"
        console.print(f"dataset      {state}  [dim]{each.data_path}")
        done = (path / "done.json").exists()
        state = "there" if done else f"{counted(each.preset.pretrain.steps, 'update')} to make"
        console.print(f"world model  {state}  [dim]{path}")
