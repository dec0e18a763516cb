"""Show a plan, or check and execute it, here or on an engine."""

from collections.abc import Sequence
from dataclasses import asdict

import typer

from wpt_agents.files.names import unknown_name
from wpt_agents.zoo.machine import ENGINES, check_machine, choose_threads
from wpt_agents.zoo.plan.effects import check_rewards
from wpt_agents.zoo.plan.estimate import check_space, summary
from wpt_agents.zoo.plan.overview import show_plan
from wpt_agents.zoo.plan.runs import Run
from wpt_agents.zoo.plan.sequences import SequenceRun
from wpt_agents.zoo.run.engines import Resources, run_on
from wpt_agents.zoo.run.folder import check_folder
from wpt_agents.zoo.run.runner import run_all
from wpt_agents.zoo.run.sequences import check_sequence, run_sequences

ENGINES_OF = {  # the engines that use each resource
    "cpus": ("local", "ray", "slurm"),
    "gpus": ("ray", "slurm"),
    "memory_gb": ("ray", "slurm"),
    "hours": ("slurm",),
    "retries": ("local", "ray"),
    "address": ("ray",),
    "partition": ("slurm",),
}


def check_resources(engine: str, resources: Resources) -> None:
    """Raise an error for resources that the engine does not reserve."""
    if engine not in ENGINES:
        raise unknown_name("engine", engine, ENGINES)
    usual = asdict(Resources())
    for name, value in asdict(resources).items():
        engines = ENGINES_OF.get(name, (engine,))
        if value != usual[name] and engine not in engines:
            option = f"--{name.replace('_', '-')}"
            raise ValueError(
                f"{option} has no effect with --engine {engine}: leave it out, or take "
                f"{' or '.join(engines)}"
            )
    if engine == "slurm" and resources.gpus % 1:
        raise ValueError(f"--gpus {resources.gpus}: Slurm reserves whole GPUs, only Ray shares one")


def check_plan(runs: Sequence[Run], engine: str, force: bool) -> None:
    """Raise an error in advance if machine, disk or folders do not allow the plan."""
    check_machine(engine, runs[0].device)
    check_rewards({run.method for run in runs}, runs[0].data)
    check_space(runs)
    for run in runs:
        check_folder(run, force)


def preview(runs: Sequence[Run], engine: str, force: bool) -> None:
    """Print the plan, then raise the errors that running it would raise."""
    show_plan(runs, force)
    typer.echo(summary(runs, force))
    check_plan(runs, engine, force)


def do_plan(runs: Sequence[Run], engine: str, force: bool, resources: Resources) -> bool:
    """Check the runs, then execute them.

    :return: True if all are finished
    """
    check_plan(runs, engine, force)
    if engine == "none":
        choose_threads(runs[0].preset.size)
        return run_all(runs, force)
    return run_on(engine, runs, force, resources)


def do_sequences(jobs: Sequence[SequenceRun], force: bool, dry_run: bool) -> bool:
    """Check the sequences, then execute them; with `dry_run`, only show them.

    :return: True if all are finished, or shown
    """
    runs = [run for job in jobs for run in job.runs]
    if dry_run:
        show_plan(runs, force)
    check_machine("none", runs[0].device)
    check_space(runs)
    for job in jobs:
        check_sequence(job, force)
    choose_threads(runs[0].preset.size)
    return dry_run or run_sequences(jobs, force)
