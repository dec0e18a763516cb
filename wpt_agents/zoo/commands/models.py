"""The command that converts model files from and to other formats: import-model."""

from pathlib import Path
from typing import Annotated, Any

import typer


def import_model(
    form: Annotated[
        str, typer.Argument(metavar="FORMAT", help="official, the format of the paper's authors.")
    ],
    source: Annotated[Path, typer.Argument(metavar="SRC", help="The file to read, e.g. `m.pt`.")],
    out: Annotated[Path, typer.Argument(metavar="DST", help="The file to write, e.g. `m.zip`.")],
    export: Annotated[
        bool,
        typer.Option("--export", help="Convert the other way: SRC is a model file of WPT."),
    ] = False,
    stoch: Annotated[
        int | None,
        typer.Option(help="The number of groups of the stochastic state, if it is not 32."),
    ] = None,
) -> None:
    """Convert a model file of the paper's authors into a model file of WPT.

    Example: `python -m wpt_agents.zoo import-model official dmcontrol.pt dmcontrol.zip`

    And back, for the authors' scripts:
    `python -m wpt_agents.zoo import-model official --export dmcontrol.zip dmcontrol.pt`
    """
    from wpt_agents.agents.wpt import WPT
    from wpt_agents.files.names import unknown_name

    if form != "official":
        raise unknown_name("format", form, ["official"])
    if export:
        model = WPT.load(source, device="cpu")
        model.save_official(out)
        typer.echo(f"Arguments of the authors' scripts: {_arguments(model)}")
    else:
        model = WPT.from_official(source, device="cpu", stoch=stoch)
        model.save(out)
    parameters = sum(weight.numel() for weight in model.policy.world_model.parameters())
    typer.echo(f"World model: {parameters / 1e6:,.1f} M parameters, {_widths(model)}")
    typer.echo(f"Model: {out.resolve()}")


def _widths(model: Any) -> str:
    size = model.policy.size
    names = ("deter", "hidden", "stoch", "classes", "depth", "units", "blocks")
    widths = [f"{name} {getattr(size, name)}" for name in names]
    return ", ".join([*widths, f"max_action_dim {model.max_action_dim}"])


def _arguments(model: Any) -> str:
    """Return the settings of the authors' configuration for networks of these widths."""
    size = model.policy.size
    rssm = {name: getattr(size, name) for name in ("deter", "hidden", "stoch", "classes", "blocks")}
    words = [f"agent.rssm.{name}={value}" for name, value in rssm.items()]
    words += [f"agent.encoder.cnn_depth={size.depth}", f"agent.reward.units={size.units}"]
    return " ".join(words)
