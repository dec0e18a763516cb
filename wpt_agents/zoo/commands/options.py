"""What several commands share: options, and how they take several values."""

from collections.abc import Mapping, Sequence
from enum import StrEnum
from typing import Annotated, Any

import typer
from typer.core import TyperCommand


class Spaced(TyperCommand):
    """Lets an option take several values at once: `--tasks a b` for `--tasks a --tasks b`."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Repeats the option's name before each further value."""
        several = {o for p in self.params if p.multiple for o in p.opts}
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


Rendering = StrEnum("Rendering", ["exact", "near", "fast"])
Suite = Annotated[str, typer.Option(help="dmc, or another suite of `list`.")]
Tasks = Annotated[
    list[str],
    typer.Option(help="Names or patterns, e.g. `walker-run 'cheetah-*'`. None: the paper's."),
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
Workers = Annotated[
    int,
    typer.Option(min=1, help="Processes that collect data; runs at a time of `--engine local`."),
]


def print_table(title: str, found: Sequence[Mapping[str, Any]]) -> None:
    """Prints rows of several columns each; what a row lacks stays empty."""
    from rich.table import Table

    from wpt_agents.zoo.terminal import console

    columns = list(dict.fromkeys(key for row in found for key in row))
    table = Table(title=title)
    for name in columns:
        widest = max(map(len, name.split()))  # of its words, not to be broken where there is room
        table.add_column(name, overflow="fold", min_width=min(widest, 12))
    for row in found:
        table.add_row(*(_cell(row.get(key, "")) for key in columns))
    console.print(table)


def _cell(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


Device = Annotated[str, typer.Option(help="auto, cpu, cuda, cuda:1, ...")]
