"""The table that `run --dry-run` prints."""

from collections.abc import Sequence

from rich.markup import escape
from rich.table import Table

from wpt_agents.files.names import counted
from wpt_agents.training.model_files import shipped
from wpt_agents.zoo.plan.estimate import is_finished
from wpt_agents.zoo.plan.runs import Run
from wpt_agents.zoo.record_lines import Identity, read
from wpt_agents.zoo.tasks import short_name
from wpt_agents.zoo.terminal import console, dim


def identity_of(job: Run) -> Identity:
    """Return the identity of the line that the final policy of a run gets."""
    frames = job.preset.learn.frames
    return short_name(job.task), job.method, str(job.variant), frames, job.seed


def show_plan(jobs: Sequence[Run], force: bool) -> None:
    """Print the plan and what exists already."""
    table = Table("task", "method", "seed", "env steps", "updates", "state", "folder")
    record = jobs[0].record
    lines = read(record) if record is not None and record.exists() else []
    recorded = {line.identity for line in lines} & set(map(identity_of, jobs))
    for job in jobs:
        state = "finished" if is_finished(job) and not force else "to do"
        if identity_of(job) in recorded:
            state += ", recorded"
        updates = "-" if job.updates is None else f"{job.updates:,}"
        names = short_name(job.task), job.method, str(job.seed)
        table.add_row(*names, f"{job.preset.steps:,}", updates, state, escape(str(job.folder)))
    console.print(table)
    if record is not None:
        console.print(f"record       has {len(recorded)} of {len(jobs)} runs  {dim(record)}")
    datasets = {job.shared.data_path: job.shared for job in jobs if job.algorithm.needs_data}
    for path, shared in datasets.items():
        missing = shared.missing
        state = f"{counted(missing, 'episode')} to collect" if missing else "exists"
        console.print(f"dataset      {state}  {dim(path)}")
    models = {job.shared.model_path: job.shared for job in jobs if job.algorithm.pretrained}
    for path, shared in models.items():
        if model := shared.given_model:
            ships = ", which ships" if model in shipped() else ""
            console.print(f"world model  {model}{ships}")
            continue
        updates = counted(shared.preset.pretrain.steps, "update")
        state = "exists" if (path / "done.json").exists() else f"{updates} to make"
        console.print(f"world model  {state}  {dim(path)}")
