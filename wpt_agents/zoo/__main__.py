"""The commands of `python -m wpt_agents.zoo`.

Imports stand inside the commands so that `--help` answers at once.
"""

import sys
from pathlib import Path
from typing import Annotated

import typer

from wpt_agents.zoo.bench.command import bench
from wpt_agents.zoo.commands import data as data_commands
from wpt_agents.zoo.commands.options import Settings, Spaced, Suite, Tasks, Workers, print_table
from wpt_agents.zoo.report.command import report

app = typer.Typer(
    add_completion=False,
    no_args_is_help=True,
    rich_markup_mode="markdown",
    pretty_exceptions_enable=False,
    help="Collect data, pre-train world models, fine-tune them on tasks, compare the results.\n\n"
    "Start with `python -m wpt_agents.zoo list`, then "
    "`python -m wpt_agents.zoo run --suite metaworld --tasks drawer-close --preset demo`.",
)


PresetName = Annotated[
    str, typer.Option(help="How large: debug, demo, tiny, small, medium, paper (Table 2).")
]
Out = Annotated[Path, typer.Option(help="Where the run folders and the shared stages go.")]
Data = Annotated[
    Path | None, typer.Option(help="A dataset of your own. None: the preset's, collected.")
]
Device = Annotated[str, typer.Option(help="auto, cpu, cuda, cuda:1, ...")]


data_commands.register(app)


@app.command("list")
def list_tasks(
    suite: Annotated[str, typer.Option(help="Only this suite.")] = "",
) -> None:
    """Shows the tasks of each suite, and the presets and methods that `run` knows."""
    from rich.table import Table
    from wpt_envs.tasks import TASKS

    from wpt_agents.files.names import unknown_name
    from wpt_agents.zoo.plan.plan import METHODS
    from wpt_agents.zoo.plan.presets import preset_names, suite_names
    from wpt_agents.zoo.run.stages import console

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


@app.command("pretrain", cls=Spaced)
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
    from wpt_agents.zoo.run.stages import Shared, console

    check_device(device)
    chosen = load_preset(suite, preset, settings)
    shared = Shared(chosen, suite, out / "cache", workers, device, data, accumulate)
    with joined(local_device(device)) as world:
        console.quiet = world.rank > 0
        with world.rank_0_first():
            dataset = shared.data()
        model = shared.model(dataset).resolve()
        if world.rank == 0:
            typer.echo(f"Model: {model}")


@app.command("run", cls=Spaced)
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
    from wpt_agents.zoo.plan.plan import make_plan, show_plan
    from wpt_agents.zoo.run.benchmark import check_folder, run_all
    from wpt_agents.zoo.run.engines import Resources, run_on
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


RunFolder = Annotated[
    Path, typer.Argument(help="A run folder, moved or pulled too, or a model file (.zip).")
]
ForTask = Annotated[
    str, typer.Option(help="`dmc-walker-run`; only for a model file without its run folder.")
]
Policy = Annotated[str, typer.Option(help="wpt, or prior: the actor that guided it.")]


@app.command("eval")
def evaluate_model(
    run: RunFolder,
    task: ForTask = "",
    policy: Policy = "wpt",
    episodes: Annotated[int, typer.Option(min=1, help="How many.")] = 10,
    seed: Annotated[int, typer.Option(min=0, help="Of the first initial state.")] = 10_000,
    device: Device = "auto",
) -> None:
    """Plays a trained model on its task and shows its returns. Needs no dataset.

    Example: `python -m wpt_agents.zoo eval runs/demo/wpt/metaworld-drawer-close_0 --episodes 50`
    """
    from wpt_agents.zoo.collect.trained import find_trained
    from wpt_agents.zoo.report.tables import interval_text, number

    trained = find_trained(run, task)
    score = trained.evaluate(trained.load(policy, device), episodes, seed)
    mean, low, high = score.interval
    typer.echo(f"task             {trained.task}")
    typer.echo(f"mean return      {number(mean)}")
    typer.echo(f"95 % interval    {interval_text(low, high)}")
    typer.echo(f"returns          {', '.join(map(number, score.returns))}")
    if score.successes:
        typer.echo(f"success          {score.as_dict()['success_rate']:.2f}, at the last step")


@app.command("enjoy")
def enjoy_model(
    run: RunFolder,
    task: ForTask = "",
    policy: Policy = "wpt",
    seed: Annotated[int, typer.Option(min=0, help="Of the initial state.")] = 10_000,
    out: Annotated[Path, typer.Option(help="The video.")] = Path("enjoy.mp4"),
    size: Annotated[int, typer.Option(min=64, help="Its width; a multiple of 16.")] = 256,
    device: Device = "auto",
) -> None:
    """Films an episode of a trained model to an mp4, which any browser plays.

    Example: `python -m wpt_agents.zoo enjoy runs/demo/wpt/metaworld-drawer-close_0`
    """
    from wpt_agents.zoo.collect.trained import find_trained
    from wpt_agents.zoo.report.tables import number

    if size % 16:
        raise ValueError(f"--size {size}: a video's width must be a multiple of 16.")
    trained = find_trained(run, task)
    total = trained.record(trained.load(policy, device), out, seed, size)
    typer.echo(f"Return {number(total)}. Video: {out.resolve()}")


@app.command("diagnose")
def diagnose_model(
    run: RunFolder,
    task: ForTask = "",
    episodes: Annotated[int, typer.Option(min=1, help="How many.")] = 5,
    horizon: Annotated[int, typer.Option(min=1, help="Steps to dream.")] = 20,
    seed: Annotated[int, typer.Option(min=0, help="Of the first initial state.")] = 10_000,
    device: Device = "auto",
) -> None:
    """Shows why a policy earns what it earns: what its world model promises, and what comes.

    Example: `python -m wpt_agents.zoo diagnose runs/demo/wpt/metaworld-drawer-close_0`
    """
    from wpt_agents.zoo.collect.trained import find_trained
    from wpt_agents.zoo.judge.diagnosis import diagnose, show

    show(diagnose(find_trained(run, task), episodes, seed, horizon, device), horizon)


@app.command("open-loop")
def judge_predictions(
    model: Annotated[
        Path, typer.Argument(help="A model file, or a run's or pre-training's folder.")
    ],
    data: Annotated[Path, typer.Argument(help="A dataset that it was not trained on.")],
    episodes: Annotated[
        int, typer.Option(min=1, help="Of each robot, at most, spread evenly.")
    ] = 8,
    out: Annotated[
        Path | None, typer.Option(help="Folder to write `prediction.csv` and pictures into.")
    ] = None,
    device: Device = "auto",
) -> None:
    """Shows how well a world model predicts: its error by horizon, beside the simplest guesses.

    Example: `python -m wpt_agents.zoo open-loop walker.zip data/held-out --out predictions`
    """
    from wpt_agents.agents.wpt import WPT
    from wpt_agents.data.dataset import TrajectoryDataset
    from wpt_agents.zoo.judge.prediction import judge

    file = model / "model.zip" if model.is_dir() else model
    rows = judge(WPT.load(file, device=device), TrajectoryDataset.open(data), episodes, out)
    print_table("Squared error of an image, as in Eq. (1)", list(rows))
    if out is not None:
        typer.echo(f"Pictures: {out.resolve()}")


@app.command("push")
def push_run(
    run: Annotated[Path, typer.Argument(help="A finished run's folder.")],
    name: Annotated[str, typer.Argument(help="`user/repository` on the Hugging Face hub.")],
    private: Annotated[bool, typer.Option(help="Only you can see it.")] = False,
) -> None:
    """Uploads a run to the Hugging Face hub: model, configuration, scores, video and a card.

    Log in first: `hf auth login`.
    """
    from wpt_agents.zoo.run.hub import push

    typer.echo(f"Pushed: {push(run, name, private)}")


@app.command("pull")
def pull_run(
    name: Annotated[str, typer.Argument(help="`user/repository` on the Hugging Face hub.")],
    out: Annotated[Path | None, typer.Option(help="A new folder. None: the repository's name.")] = (
        None
    ),
) -> None:
    """Downloads a run from the Hugging Face hub, for `eval`, `enjoy` and `WPT.load`."""
    from wpt_agents.zoo.run.hub import pull

    folder = pull(name, out or Path(name.rpartition("/")[2]))
    typer.echo(f"Pulled: {folder.resolve()}. Watch it: python -m wpt_agents.zoo enjoy {folder}")


app.command("report")(report)
app.command("bench")(bench)


def main() -> None:
    """Runs a command; a user's mistake ends in one line and exit code 2."""
    try:
        app()
    except (ValueError, FileNotFoundError) as error:
        typer.secho(f"Error: {error}", fg="red", err=True)
        sys.exit(2)
    except KeyboardInterrupt:
        typer.echo("Interrupted. The same command goes on from the finished stages.", err=True)
        sys.exit(130)


if __name__ == "__main__":
    main()
