"""Options that several commands share, and support for options with several values."""

from collections.abc import Mapping, Sequence
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperCommand


class Spaced(TyperCommand):
    """A command whose options take several values: `--tasks a b` for `--tasks a --tasks b`."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Repeat the option's name before each further value."""
        several = {o for p in self.params if p.multiple for o in p.opts}
        words: list[str] = []
        option = None  # the current option, if it takes several values
        has_value = False
        for arg in args:
            if arg.startswith("-"):
                name, equals, _ = arg.partition("=")  # `--tasks a` or `--tasks=a`
                option = name if name in several else None
                has_value = bool(equals)
            elif option and has_value:
                words.append(option)
            else:
                has_value = True
            words.append(arg)
        return super().parse_args(ctx, words)


Rendering = StrEnum("Rendering", ["exact", "near", "fast"])
Suite = Annotated[
    str, typer.Option(help="The suite of tasks: dmc (DeepMind Control), metaworld or robotics.")
]
Tasks = Annotated[
    list[str],
    typer.Option(
        help="Names of tasks, or patterns: `walker-run 'cheetah-*'`; by default the paper's tasks."
    ),
]
Settings = Annotated[
    list[str],
    typer.Option(
        "--set",
        metavar="KEY=VALUE",
        help="Changes to the preset: keywords of WPT (`gamma=0.98`), or `section.key=value` "
        "(`pretrain.steps=500`, `env.rendering=near`).",
    ),
]
Workers = Annotated[
    int,
    typer.Option(
        min=1,
        help="The number of processes that collect data, and of simultaneous runs with "
        "`--engine local`.",
    ),
]


def model_file(model: str) -> str:
    """Return what `WPT.load` takes: the file of a folder, or the argument itself."""
    return str(Path(model, "model.zip")) if Path(model).is_dir() else model


def print_table(title: str, rows: Sequence[Mapping[str, Any]]) -> None:
    """Print rows of named cells; cells that a row lacks stay empty."""
    from rich.markup import escape
    from rich.table import Table

    from wpt_agents.zoo.terminal import console

    columns = list(dict.fromkeys(key for row in rows for key in row))
    table = Table(title=title)
    for name in columns:
        widest = max(map(len, name.split()))  # words are broken only if there is no room
        table.add_column(name, overflow="fold", min_width=min(widest, 12))
    for row in rows:
        table.add_row(*(escape(_cell(row.get(key, ""))) for key in columns))
    console.print(table)


def _cell(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


Device = Annotated[
    str, typer.Option(help="The device of the networks: auto, cpu, cuda, cuda:1, ...")
]
