"""The command `bench`: what is measured, and how it is shown.

Each case is a module beside this one with `rows(quick) -> Iterator[dict]`, imported when asked for.
"""

import importlib
import inspect
import json
from collections.abc import Iterator
from enum import StrEnum
from typing import Annotated, Any

import typer

Case = StrEnum(
    "Case",
    "model profile policy replay data envs retrieval prediction exploration all".split(),
)
Precision = StrEnum("Precision", ["fp32", "bf16"])


def bench(
    case: Annotated[Case, typer.Argument(help="What to measure.")] = Case.all,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object a line.")] = False,
    quick: Annotated[bool, typer.Option(help="Seconds: does it run? The numbers mean little.")] = (
        False
    ),
    threads: Annotated[int, typer.Option(min=1, help="Of torch.")] = 1,
    precision: Annotated[Precision, typer.Option(help="Of the forward passes.")] = Precision.fp32,
    updates: Annotated[
        int | None, typer.Option(min=1, help="Of each model, in the case prediction.")
    ] = None,
) -> None:
    """Measures speed on this machine: medians of processor time after a warm-up.

    `share_of_ceiling` compares with a large matmul in the same run; work is counted, not guessed.

    Example: `python -m wpt_agents.zoo bench model --json > model.jsonl`
    """
    options = dict(quick=quick, threads=threads, precision=str(precision), updates=updates)
    for name in [c for c in Case if c != Case.all] if case == Case.all else [case]:
        try:
            found = _rows(name, options)
            if as_json:
                for row in found:
                    typer.echo(json.dumps({"case": str(name), **row}))
            else:
                _print_table(str(name), list(found))
        except ImportError as error:
            if case != Case.all:
                raise ValueError(f"bench {name} needs {error.name}, which is not here.") from error
            typer.echo(f"bench {name} left out: it needs {error.name}.", err=True)


def _rows(name: str, options: dict[str, Any]) -> Iterator[dict]:
    """What the module of a case yields, given the options that it takes."""
    rows = importlib.import_module(f"wpt_agents.zoo.bench.{name}").rows
    taken = inspect.signature(rows).parameters
    return rows(**{key: value for key, value in options.items() if key in taken})


def _print_table(title: str, found: list[dict]) -> None:
    from rich.table import Table

    from wpt_agents.zoo.stages import console

    columns = list(dict.fromkeys(key for row in found for key in row))
    table = Table(title=title)
    for name in columns:
        table.add_column(name, overflow="fold")
    for row in found:
        table.add_row(*(_cell(row.get(key, "")) for key in columns))
    console.print(table)


def _cell(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)
