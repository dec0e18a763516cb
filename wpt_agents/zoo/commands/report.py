"""The command `report`. Imports are inside it so that `--help` answers at once."""

from pathlib import Path
from typing import Annotated

import typer


def report(
    folder: Annotated[
        Path, typer.Argument(help="The folder below which run folders are searched.")
    ] = Path("runs"),
    markdown: Annotated[bool, typer.Option(help="Print Markdown instead of a table.")] = False,
    csv: Annotated[
        bool, typer.Option(help="Print CSV with a line for every policy instead of a table.")
    ] = False,
    out: Annotated[
        Path | None, typer.Option(help="The folder of the page; by default `report` in FOLDER.")
    ] = None,
    record: Annotated[
        Path | None,
        typer.Option(
            help="A CSV file to update with a line for every policy and run; other lines are kept."
        ),
    ] = None,
    media: Annotated[
        str,
        typer.Option(
            help="The runs whose videos and pictures are in the page: first (of each task), all or "
            "none."
        ),
    ] = "first",
) -> None:
    """Show the mean over seeds of every task and method, and write a page about all runs.

    The page is one file that needs no network: the paper's tables beside yours, aggregates with
    intervals, learning curves, videos, the command behind each number, and what failed. Markdown
    and CSV files beside it have the numbers of every policy: doing nothing, random, prior actor and
    the agent.

    --record keeps the numbers even if run folders are deleted; a Markdown page and a picture are
    written beside the CSV file, and learning curves into its folder `curves`. If FOLDER has no
    finished run, only these are written again.
    Sequences of tasks are in the page, but not in records.

    Example: `python -m wpt_agents.zoo report runs --record results.csv`
    """
    from rich.markup import escape

    from wpt_agents.zoo.report import record as records
    from wpt_agents.zoo.report import record_page
    from wpt_agents.zoo.report.page import check_media
    from wpt_agents.zoo.report.summary import Summary
    from wpt_agents.zoo.terminal import console

    if record is not None:
        record_page.check(record)
    check_media(media)
    summary = Summary.of(folder)
    if not summary.runs and record is not None and record.exists() and records.read(record):
        record_page.renew(record)
        console.print(
            f"No finished run below {folder}: {record} stays, its pages are renewed.", markup=False
        )
        if not summary.sequences:
            return
    if not summary.runs and not summary.sequences:
        raise ValueError(f"No finished run below {folder}: there is no readable result.json.")
    if record is not None and summary.runs:
        record_page.add(record, summary.runs)
    if csv:
        typer.echo(summary.csv(), nl=False)
    elif markdown:
        typer.echo(summary.markdown(), nl=False)
    else:
        page = (out or folder / "report") / "index.html"
        summary.write(page, media)
        summary.show()
        where = escape(str(page.resolve()))
        console.print(f"Page: [bold]{where}[/bold]; beside it report.md, policies.csv")
        if record is not None and summary.runs:
            where = escape(str(record.resolve()))
            names = ", ".join(record.with_suffix(end).name for end in (".md", ".png"))
            console.print(f"Record: [bold]{where}[/bold]; beside it {names}")
