"""The commands: python -m wpt_agents.zoo {list, collect, pretrain, run, report, bench}.

Imports stand inside the commands so that `--help` answers at once.
"""

import sys
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperCommand

from wpt_agents.zoo.bench.command import bench

app = typer.Typer(
    add_completion=False,
    no_args_is_help=True,
    rich_markup_mode="markdown",
    pretty_exceptions_enable=False,
    help="Collect data, pre-train world models, fine-tune them on tasks, compare the results.\n\n"
    "Start with `python -m wpt_agents.zoo list`, then "
    "`python -m wpt_agents.zoo run --suite metaworld --tasks drawer-close --preset demo`.",
)


class Spaced(TyperCommand):
    """Lets an option take several values at once: `--tasks a b` for `--tasks a --tasks b`."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Repeats the option's name before each further value."""
        several = {o for p in self.params if p.multiple for o in p.opts}  # type: ignore[attr-defined]
        spread: list[str] = []
        option, given = None, False
        for arg in args:
            if arg.startswith("-"):
                option, given = (arg if arg in several else None), False
            elif option and given:
                spread.append(option)
            else:
                given = True
            spread.append(arg)
        return super().parse_args(ctx, spread)


Suite = Annotated[str, typer.Option(help="dmc, or another suite of `list`.")]
Tasks = Annotated[
    list[str],
    typer.Option(help="Names or patterns, e.g. `walker-run 'cheetah-*'`. None: the paper's."),
]
PresetName = Annotated[
    str, typer.Option(help="How large: debug, demo, tiny, small, medium, paper (Table 2).")
]
Settings = Annotated[
    list[str],
    typer.Option(
        "--set",
        metavar="KEY=VALUE",
        help="Changes the preset: a keyword of WPT (`gamma=0.98`), or `section.key=value` "
        "(`pretrain.steps=500`, `env.rendering=near`).",
    ),
]
Out = Annotated[Path, typer.Option(help="Where the run folders and the shared stages go.")]
Workers = Annotated[int, typer.Option(min=1, help="Processes that collect data.")]
Data = Annotated[
    Path | None, typer.Option(help="A dataset of your own. None: the preset's, collected.")
]
Device = Annotated[str, typer.Option(help="auto, cpu, cuda, cuda:1, ...")]


@app.command("list")
def list_tasks(
    suite: Annotated[str, typer.Option(help="Only this suite.")] = "",
) -> None:
    """Shows the tasks of each suite, and the presets and methods that `run` knows."""
    from rich.table import Table
    from wpt_envs.tasks import TASKS

    from wpt_agents.names import unknown_name
    from wpt_agents.zoo.plan import METHODS
    from wpt_agents.zoo.presets import preset_names, suite_names
    from wpt_agents.zoo.stages import console

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


@app.command("collect", cls=Spaced)
def collect_data(
    out: Annotated[Path, typer.Option(help="The dataset's folder; half of one is continued.")],
    suite: Suite = "dmc",
    tasks: Tasks = [],  # noqa: B006  # typer wants a list
    episodes: Annotated[int, typer.Option(min=1, help="Of each task.")] = 30,
    seed: int = 0,
    workers: Workers = 2,
    behaviour: Annotated[str, typer.Option(help="noise, or scripted (Meta-World).")] = "noise",
    rendering: Annotated[str, typer.Option(help="exact, near or fast.")] = "near",
) -> None:
    """Plays tasks with noise and stores the episodes without rewards.

    Example: `python -m wpt_agents.zoo collect --tasks walker-run cartpole-swingup --out data`
    """
    from wpt_agents.zoo.collect import collect
    from wpt_agents.zoo.tasks import find_tasks

    ids = [row.id for row in find_tasks(suite, tasks)]
    dataset = collect(out, ids, episodes, seed, workers, behaviour, {"rendering": rendering})
    for name, value in dataset.info().items():
        typer.echo(f"{name:<16} {value}")


@app.command("pretrain", cls=Spaced)
def pretrain_model(
    suite: Suite = "dmc",
    preset: PresetName = "demo",
    data: Data = None,
    settings: Settings = [],  # noqa: B006
    out: Out = Path("runs"),
    workers: Workers = 2,
    device: Device = "auto",
) -> None:
    """Pre-trains a preset's world model, on its data or yours; `run` reuses it.

    Example: `python -m wpt_agents.zoo pretrain --preset tiny --set pretrain.steps=2000`
    """
    from wpt_agents.zoo.presets import load_preset
    from wpt_agents.zoo.stages import Shared

    chosen = load_preset(suite, preset, settings)
    shared = Shared(chosen, suite, out / "cache", workers, device, data)
    typer.echo(f"Model: {shared.model(shared.data()).resolve()}")


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
        typer.Option(help="wpt, scratch, no-guidance, no-rehearsal, no-pretrain; several allowed."),
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
) -> None:
    """Runs the whole method: collect, pre-train, index, fine-tune, evaluate.

    Each task, method and seed gets a run folder with its configuration, logs, model, learning
    curve, video and `result.json`. What is finished is not done again.

    Example: `python -m wpt_agents.zoo run --suite metaworld --tasks drawer-close --seeds 3`
    """
    from wpt_agents.zoo.benchmark import run_all
    from wpt_agents.zoo.plan import make_plan, show_plan

    changes = [*settings, *([f"learn.frames={frames}"] if frames is not None else [])]
    jobs = make_plan(suite, tasks, preset, seeds, method, changes, out, workers, device, data)
    if dry_run:
        show_plan(jobs, force)
    elif not run_all(jobs, force):
        raise typer.Exit(1)


@app.command("report")
def report_results(
    folder: Annotated[Path, typer.Argument(help="Run folders are searched below it.")] = Path(
        "runs"
    ),
    markdown: Annotated[bool, typer.Option(help="Print Markdown instead of a table.")] = False,
) -> None:
    """Shows the mean over seeds of every task and method, with its 95 % interval."""
    from wpt_agents.zoo import report
    from wpt_agents.zoo.stages import console

    rows = report.summarise(report.read_results(folder))
    if not rows:
        raise ValueError(f"No finished run below {folder}: there is no result.json.")
    if markdown:
        typer.echo(report.markdown(rows), nl=False)
    else:
        console.print(report.summary_table(rows))


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
