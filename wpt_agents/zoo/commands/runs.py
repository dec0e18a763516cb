"""The commands that plan and execute runs: list, pretrain, run."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from wpt_agents.zoo.commands.options import Device, Settings, Suite, Tasks, Workers

PresetName = Annotated[
    str | None,
    typer.Option(
        help="A named set of settings: debug, demo, tiny, mid, small, medium or paper "
        "(zoo/*.yaml); by default demo, or tiny if the suite has no demo."
    ),
]
Out = Annotated[
    Path, typer.Option(help="The folder for run folders, and for data and models that they share.")
]
Data = Annotated[
    Path | None, typer.Option(help="A dataset to use instead of collecting the preset's data.")
]
Seeds = Annotated[
    str,
    typer.Option(
        help="The number of seeds (`3` is 0, 1, 2), or which ones: `0,5`, `0-2`, or `1-1` for seed "
        "1 alone."
    ),
]
MethodNames = Annotated[
    list[str],
    typer.Option(
        help="One or more of the methods that `list` shows. The ablation of the paper's Fig. 5 is "
        "`scratch pretrain-only no-guidance wpt`."
    ),
]
Frames = Annotated[
    int | None,
    typer.Option(
        help="The number of simulator frames of fine-tuning, in place of the preset's: calls of "
        "env.step times the action repeat."
    ),
]
SequenceName = Annotated[
    str,
    typer.Option(
        help="A sequence of tasks that each method learns one after the other, in place of "
        "--suite and --tasks: `ant` is Fig. 4 of the paper."
    ),
]
Record = Annotated[
    Path | None,
    typer.Option(
        help="A CSV file to which each run is added as soon as it is finished, as by `report "
        "--record`; with --dry-run, the runs that are already in it are marked."
    ),
]
Force = Annotated[bool, typer.Option(help="Replace finished runs.")]
FromNothing = Annotated[
    bool,
    typer.Option(
        "--from-nothing",
        help="Pre-train a world model even if the preset starts from one that comes with the "
        "library (as `--set pretrain.model=`).",
    ),
]
DryRun = Annotated[bool, typer.Option(help="Only show what would run.")]
Watch = Annotated[
    bool,
    typer.Option(
        help="Only show the progress of these runs, which were started in another terminal."
    ),
]
Engine = Annotated[
    str,
    typer.Option(
        help="Where runs execute. none: in this process, one after the other; local: each in its "
        "own process, `--workers` at a time; ray: on a Ray cluster; slurm: as Slurm jobs."
    ),
]
Cpus = Annotated[int, typer.Option(min=1, help="CPU cores to reserve for each run of an engine.")]
Gpus = Annotated[
    float,
    typer.Option(
        min=0,
        help="GPUs to reserve for each run on Ray and Slurm; Ray also accepts shares such as 0.5.",
    ),
]
Memory = Annotated[
    float, typer.Option(min=0, help="GB of memory to reserve for each run on Ray and Slurm.")
]
Hours = Annotated[
    float,
    typer.Option(
        help="The time limit of a Slurm job in hours; unfinished runs continue in another job."
    ),
]
Retries = Annotated[
    int,
    typer.Option(
        min=0,
        help="The number of times a run is resumed after its worker was killed (engines local and "
        "ray).",
    ),
]
Address = Annotated[
    str, typer.Option(help="The address of a Ray cluster; by default one is started here.")
]
Partition = Annotated[str, typer.Option(help="The Slurm partition; `local` works without Slurm.")]


def list_tasks(
    suite: Annotated[str, typer.Option(help="Show only this suite.")] = "",
) -> None:
    """Show the tasks of each suite, and the presets and methods that `run` knows.

    Example: `python -m wpt_agents.zoo list --suite metaworld`
    """
    from rich.table import Table
    from wpt_envs.tasks import TASKS

    from wpt_agents.files.names import unknown_name
    from wpt_agents.zoo.plan.methods import METHODS
    from wpt_agents.zoo.plan.presets import preset_names, suite_names
    from wpt_agents.zoo.plan.sequences import sequence_names
    from wpt_agents.zoo.tasks import short_name
    from wpt_agents.zoo.terminal import console

    suites = list(dict.fromkeys(row.suite for row in TASKS.values()))
    if suite and suite not in suites:
        raise unknown_name("suite", suite, suites)
    table = Table("task", "embodiment", "actions", "frames per episode", "metric", "in the paper")
    for row in TASKS.values():
        if suite in ("", row.suite):
            numbers = str(row.action_dim), str(row.frames)
            paper = "yes" if row.in_paper else "no"
            table.add_row(short_name(row), row.embodiment, *numbers, row.metric, paper)
    console.print(table)
    for name in [suite] if suite else suite_names():
        console.print(f"presets of {name}: {', '.join(preset_names(name))}")
    console.print(f"methods: {', '.join(METHODS)}")
    console.print(f"sequences: {', '.join(sequence_names())}")


def pretrain_model(
    suite: Suite = "dmc",
    preset: PresetName = None,
    data: Data = None,
    settings: Settings = [],  # noqa: B006
    out: Out = Path("runs"),
    workers: Workers = 2,
    device: Device = "auto",
    accumulate: Annotated[
        int,
        typer.Option(
            min=1, help="The number of parts in which a batch is processed, to save memory."
        ),
    ] = 1,
    share: Annotated[
        Path | None,
        typer.Option(
            help="A file for encoder, dynamics and decoder in bfloat16, written at the end, which "
            "`WPT.load` reads like the models that come with the library."
        ),
    ] = None,
) -> None:
    """Pre-train a world model with the settings of a preset, on its data or yours.

    `run` with the same preset and data reuses the model. Ctrl-C saves the model, and the same
    command continues from it.

    Example: `python -m wpt_agents.zoo pretrain --preset tiny --set pretrain.steps=2000`

    On two GPUs: `torchrun --nproc-per-node 2 -m wpt_agents.zoo pretrain --preset paper`
    """
    from wpt_agents.agents.wpt import WPT
    from wpt_agents.training.distributed import joined, local_device
    from wpt_agents.zoo.machine import check_device, choose_threads
    from wpt_agents.zoo.plan.checks import check_pretraining
    from wpt_agents.zoo.plan.effects import check_effects, from_given
    from wpt_agents.zoo.plan.methods import METHODS
    from wpt_agents.zoo.plan.presets import default_preset, load_preset
    from wpt_agents.zoo.plan.shared import Shared
    from wpt_agents.zoo.result import Change
    from wpt_agents.zoo.run.shared import collect_data, pretrain
    from wpt_agents.zoo.terminal import console

    check_device(device)
    chosen = load_preset(suite, preset or default_preset(suite), settings)
    if chosen.pretrain.model:
        raise ValueError(f"Nothing to pre-train: {from_given(chosen)}")
    check_effects([Change.parse(text).short for text in settings], METHODS, chosen, data)
    check_pretraining(suite, chosen, data)
    choose_threads(chosen.size)
    shared = Shared(chosen, suite, out / "cache", workers, device, data, accumulate)
    with joined(local_device(device)) as world:
        console.quiet = world.rank > 0
        with world.rank_0_first():
            dataset = collect_data(shared)
        model = pretrain(shared, dataset).resolve()
        if world.rank == 0:
            typer.echo(f"Model: {model}")
            if share is not None:
                WPT.load(model, device="cpu").save_world_model(share)
                typer.echo(f"To share: {share.resolve()}")


def run_benchmark(
    suite: Suite = "dmc",
    tasks: Tasks = [],  # noqa: B006
    sequence: SequenceName = "",
    preset: PresetName = None,
    seeds: Seeds = "1",
    method: MethodNames = ["wpt"],  # noqa: B006
    frames: Frames = None,
    settings: Settings = [],  # noqa: B006
    data: Data = None,
    out: Out = Path("runs"),
    workers: Workers = 2,
    device: Device = "auto",
    from_nothing: FromNothing = False,
    record: Record = None,
    force: Force = False,
    dry_run: DryRun = False,
    watch: Watch = False,
    engine: Engine = "none",
    cpus: Cpus = 1,
    gpus: Gpus = 0,
    memory_gb: Memory = 4,
    hours: Hours = 24,
    retries: Retries = 2,
    address: Address = "",
    partition: Partition = "",
) -> None:
    """Run the whole method: collect data, pre-train, fine-tune and evaluate.

    Each task, method and seed gets a run folder with its configuration, logs, model, learning
    curve, video and `result.json`. A command that was interrupted continues where it stopped.

    Example: `python -m wpt_agents.zoo run --suite metaworld --tasks drawer-close --seeds 3`

    Fig. 4: `python -m wpt_agents.zoo run --sequence ant --method wpt packnet --preset tiny`
    """
    from dataclasses import replace

    from wpt_agents.training.distributed import started_by_torchrun
    from wpt_agents.zoo.plan.presets import default_preset, load_preset
    from wpt_agents.zoo.plan.request import Request
    from wpt_agents.zoo.plan.runs import make_plan
    from wpt_agents.zoo.plan.sequences import find_sequence, make_sequences
    from wpt_agents.zoo.run.dispatch import check_resources, do_plan, do_sequences, preview
    from wpt_agents.zoo.run.engines import Resources
    from wpt_agents.zoo.run.watch import watch as show_standings

    if started_by_torchrun():
        raise ValueError("torchrun is for `pretrain`: pre-train with it, then `run` without it")
    changes = [*settings, *([f"learn.frames={frames}"] if frames is not None else [])]
    preset_suite = find_sequence(sequence).suite if sequence else suite
    preset = preset or default_preset(preset_suite)
    if from_nothing and load_preset(preset_suite, preset).pretrain.model:
        changes.append("pretrain.model=")
    request = Request(preset, seeds, method, changes, out, workers, device, data)
    resources = Resources(
        workers=workers,
        cpus=cpus,
        gpus=gpus,
        memory_gb=memory_gb,
        hours=hours,
        retries=retries,
        address=address,
        partition=partition,
    )
    check_resources(engine, resources)
    _check_combination(sequence, tasks, watch, engine, record)
    if sequence:
        if not do_sequences(make_sequences(sequence, request), force, dry_run):
            raise typer.Exit(1)
        return
    runs = [replace(run, record=record) for run in make_plan(suite, tasks, request)]
    if watch:
        show_standings(runs)
    elif dry_run:
        preview(runs, engine, force)
    elif not do_plan(runs, engine, force, resources):
        raise typer.Exit(1)


def _check_combination(
    sequence: str, tasks: Sequence[str], watch: bool, engine: str, record: Path | None
) -> None:
    """Raise an error for options that exclude each other, or for a path that is no record."""
    from wpt_agents.zoo.report import record_page

    if record is not None:
        if sequence or watch:
            raise ValueError("--record cannot be combined with --sequence or --watch")
        record_page.check(record)
    if sequence and (tasks or watch or engine != "none"):
        raise ValueError("--sequence cannot be combined with --tasks, --watch or --engine")
