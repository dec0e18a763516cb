"""The commands that plan and do runs: list, pretrain, run."""

from pathlib import Path
from typing import Annotated

import typer

from wpt_agents.zoo.commands.options import Device, Settings, Suite, Tasks, Workers

PresetName = Annotated[
    str, typer.Option(help="How large: debug, demo, tiny, small, medium, paper (Table 2).")
]


Out = Annotated[Path, typer.Option(help="Where the run folders and the shared stages go.")]


Data = Annotated[
    Path | None, typer.Option(help="A dataset of your own. None: the preset's, collected.")
]


def list_tasks(
    suite: Annotated[str, typer.Option(help="Only this suite.")] = "",
) -> None:
    """Shows the tasks of each suite, and the presets and methods that `run` knows."""
    from rich.table import Table
    from wpt_envs.tasks import TASKS

    from wpt_agents.files.names import unknown_name
    from wpt_agents.zoo.plan.methods import METHODS
    from wpt_agents.zoo.plan.presets import preset_names, suite_names
    from wpt_agents.zoo.terminal import console

    suites = list(dict.fromkeys(row.suite for row in TASKS.values()))
    if suite and suite not in suites:
        raise unknown_name("suite", suite, suites)
    table = Table("task", "embodiment", "actions", "frames an episode", "metric", "in the paper")
    for row in TASKS.values():
        if suite in ("", row.suite):
            numbers = str(row.action_dim), str(row.frames)
            paper = "yes" if row.in_paper else "no"
            table.add_row(f"{row.suite}-{row.name}", row.embodiment, *numbers, row.metric, paper)
    console.print(table)
    for name in suite_names():
        console.print(f"presets of {name}: {', '.join(preset_names(name))}")
    console.print(f"methods: {', '.join(METHODS)}")


def pretrain_model(
    suite: Suite = "dmc",
    preset: PresetName = "demo",
    data: Data = None,
    settings: Settings = [],  # noqa: B006
    out: Out = Path("runs"),
    workers: Workers = 2,
    device: Device = "auto",
    accumulate: Annotated[
        int, typer.Option(min=1, help="Passes over each batch, to save memory.")
    ] = 1,
) -> None:
    """Pre-trains a preset's world model, on its data or yours; `run` reuses it.

    Example: `python -m wpt_agents.zoo pretrain --preset tiny --set pretrain.steps=2000`

    On two GPUs: `torchrun --nproc-per-node 2 -m wpt_agents.zoo pretrain --preset paper`
    """
    from wpt_agents.training.distributed import joined, local_device
    from wpt_agents.zoo.machine import check_device
    from wpt_agents.zoo.plan.presets import load_preset
    from wpt_agents.zoo.plan.shared import Shared
    from wpt_agents.zoo.run.shared import collect_data, pretrain
    from wpt_agents.zoo.terminal import console

    check_device(device)
    chosen = load_preset(suite, preset, settings)
    shared = Shared(chosen, suite, out / "cache", workers, device, data, accumulate)
    with joined(local_device(device)) as world:
        console.quiet = world.rank > 0
        with world.rank_0_first():
            dataset = collect_data(shared)
        model = pretrain(shared, dataset).resolve()
        if world.rank == 0:
            typer.echo(f"Model: {model}")


def run_benchmark(
    suite: Suite = "dmc",
    tasks: Tasks = [],  # noqa: B006
    preset: PresetName = "demo",
    seeds: Annotated[
        str, typer.Option(help="How many (`3` is 0, 1 and 2), which (`0,5`) or from-to (`0-2`).")
    ] = "1",
    method: Annotated[
        list[str],
        typer.Option(
            help="wpt, kickstart, scratch, pretrain-only, no-guidance, no-rehearsal, no-pretrain, "
            "random-retrieval; several allowed. Fig. 5 is `scratch pretrain-only no-guidance wpt`."
        ),
    ] = ["wpt"],  # noqa: B006
    frames: Annotated[
        int | None, typer.Option(help="Simulator frames of fine-tuning (learn.frames).")
    ] = None,
    settings: Settings = [],  # noqa: B006
    data: Data = None,
    out: Out = Path("runs"),
    workers: Workers = 2,
    device: Device = "auto",
    force: Annotated[bool, typer.Option(help="Start finished runs anew.")] = False,
    dry_run: Annotated[bool, typer.Option(help="Show the plan and do nothing.")] = False,
    watch: Annotated[
        bool, typer.Option(help="Only show where these runs stand, made by another terminal.")
    ] = False,
    engine: Annotated[
        str,
        typer.Option(
            help="none: one run after the other, here; local: each in a process of its own, "
            "`--workers` at a time; ray: on a cluster; slurm: as jobs of submitit."
        ),
    ] = "none",
    cpus: Annotated[int, typer.Option(min=1, help="Of each run, on an engine.")] = 1,
    gpus: Annotated[float, typer.Option(min=0, help="Of each run; may be 0.5 with Ray.")] = 0,
    memory_gb: Annotated[float, typer.Option(min=0, help="Of each run, on Ray and Slurm.")] = 4,
    hours: Annotated[float, typer.Option(help="Slurm's limit; the run is sent again.")] = 24,
    retries: Annotated[int, typer.Option(min=0, help="After a worker's death.")] = 2,
    address: Annotated[str, typer.Option(help="Of the Ray cluster. None: one here.")] = "",
    partition: Annotated[str, typer.Option(help="Slurm's; `local` does without Slurm.")] = "",
) -> None:
    """Runs the whole method: collect, pre-train, index, fine-tune, evaluate.

    Each task, method and seed gets a run folder with its configuration, logs, model, learning
    curve, video and `result.json`. What is finished is not done again.

    Example: `python -m wpt_agents.zoo run --suite metaworld --tasks drawer-close --seeds 3`
    """
    from wpt_agents.training.distributed import started_by_torchrun
    from wpt_agents.zoo.machine import check_machine
    from wpt_agents.zoo.plan.estimate import check_space, summary
    from wpt_agents.zoo.plan.overview import show_plan
    from wpt_agents.zoo.plan.runs import make_plan
    from wpt_agents.zoo.run.engines import Resources, run_on
    from wpt_agents.zoo.run.folder import check_folder
    from wpt_agents.zoo.run.runner import run_all
    from wpt_agents.zoo.run.watch import watch as show_standings

    if started_by_torchrun():
        raise ValueError("torchrun is for `pretrain`: start that by it, and then `run` without it")
    changes = [*settings, *([f"learn.frames={frames}"] if frames is not None else [])]
    jobs = make_plan(suite, tasks, preset, seeds, method, changes, out, workers, device, data)
    if watch:
        show_standings(jobs)
        return
    if dry_run:
        show_plan(jobs, force)
        typer.echo(summary(jobs, force))
    check_machine(engine, device)
    check_space(jobs)
    for job in jobs:
        check_folder(job, force)
    if dry_run:
        return
    if engine == "none":
        done = run_all(jobs, force)
    else:
        limits = cpus, gpus, memory_gb, hours, retries
        done = run_on(engine, jobs, force, Resources(workers, *limits, address, partition))
    if not done:
        raise typer.Exit(1)
