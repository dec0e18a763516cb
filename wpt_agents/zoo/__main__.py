"""The commands: python -m wpt_agents.zoo {list, pretrain, run, report, bench}, and `data_commands`.

Imports stand inside the commands so that `--help` answers at once.
"""

import sys
from pathlib import Path
from typing import Annotated

import typer

from wpt_agents.zoo import data_commands
from wpt_agents.zoo.bench.command import bench
from wpt_agents.zoo.options import Settings, Spaced, Suite, Tasks, Workers

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
    csv: Annotated[bool, typer.Option(help="Print every policy as CSV instead.")] = False,
    out: Annotated[
        Path | None, typer.Option(help="The page's folder. None: `report` in FOLDER.")
    ] = None,
    media: Annotated[
        str, typer.Option(help="Videos and pictures: first (of each task), all or none.")
    ] = "first",
) -> None:
    """Shows the mean over seeds of every task and method, and writes a page about all runs.

    The page is one file that needs no network: the paper's tables beside yours, aggregates with
    intervals, learning curves, videos, the command behind each number, and what failed. Beside it
    stand the same numbers as Markdown and CSV, which also have every policy: doing nothing, random,
    prior actor, WPT.
    """
    from wpt_agents.zoo import report
    from wpt_agents.zoo.page import write_page
    from wpt_agents.zoo.stages import console

    results = report.read_results(folder)
    if not results:
        raise ValueError(f"No finished run below {folder}: there is no result.json.")
    rows, policies = report.summarise(results), report.policies(results)
    as_markdown = f"{report.markdown(rows)}\n{report.policy_markdown(policies)}"
    if csv:
        typer.echo(report.policy_csv(policies), nl=False)
    elif markdown:
        typer.echo(as_markdown, nl=False)
    else:
        page = (out or folder / "report") / "index.html"
        write_page(folder, page, media)
        page.with_name("report.md").write_text(as_markdown)
        page.with_name("policies.csv").write_text(report.policy_csv(policies))
        console.print(report.summary_table(rows))
        console.print(f"Page: [bold]{page.resolve()}[/bold]; beside it report.md, policies.csv")


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
