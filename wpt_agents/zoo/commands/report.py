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

    --record keeps the numbers when the run folders are deleted; a Markdown page and a picture are
    written beside the CSV file, and learning curves into its folder `curves`. If FOLDER has no
    finished run, only these are written again.
    Sequences of tasks are in the page, but not in records.

    Example: `python -m wpt_agents.zoo report runs --record results.csv`
    """
    from rich.markup import escape

    from wpt_agents.zoo.report import record as records
    from wpt_agents.zoo.report import record_page, tables
    from wpt_agents.zoo.report.figure4 import (
        figures_4,
        find_sequences,
        sequence_markdown,
        sequence_table,
    )
    from wpt_agents.zoo.report.folders import find_finished, find_unfinished, unfinished_text
    from wpt_agents.zoo.report.page import check_media, write_page
    from wpt_agents.zoo.report.steadiness import markdown as steadiness_markdown
    from wpt_agents.zoo.report.steadiness import steadiness
    from wpt_agents.zoo.terminal import console
    from wpt_agents.zoo.text_files import write_atomically

    if record is not None:
        record_page.check(record)
    check_media(media)
    runs = find_finished(folder)
    results = [run.result for run in runs]
    sequences = figures_4(find_sequences(folder))
    if not results and record is not None and record.exists() and records.read(record):
        record_page.renew(record)
        console.print(
            f"No finished run below {folder}: {record} stays, its pages are renewed.", markup=False
        )
        if not sequences:
            return
    if not results and not sequences:
        raise ValueError(f"No finished run below {folder}: there is no readable result.json.")
    rows = tables.summarise(results)
    policies = tables.policies(results)
    parts = [tables.markdown(rows), tables.policy_markdown(policies)] if rows else []
    missing = unfinished_text(find_unfinished(folder))
    parts += [steadiness_markdown(steadiness(runs)), sequence_markdown(sequences), missing]
    as_markdown = "\n".join(filter(None, parts))
    if record is not None and results:
        record_page.add(record, runs)
    if csv:
        typer.echo(tables.policy_csv(policies), nl=False)
    elif markdown:
        typer.echo(as_markdown, nl=False)
    else:
        page = (out or folder / "report") / "index.html"
        write_page(folder, page, media, runs)
        write_atomically(page.with_name("report.md"), as_markdown)
        write_atomically(page.with_name("policies.csv"), tables.policy_csv(policies))
        if rows:
            console.print(tables.summary_table(rows))
        if sequences:
            console.print(sequence_table(sequences))
        if missing:
            console.print(missing, markup=False)
        where = escape(str(page.resolve()))
        console.print(f"Page: [bold]{where}[/bold]; beside it report.md, policies.csv")
