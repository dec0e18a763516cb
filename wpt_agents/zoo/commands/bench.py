"""The command `bench`: choose a case, run it, and print its rows.

Each case is a module of `wpt_agents.zoo.bench` with a function `rows(quick)`, imported when needed.
"""

import importlib
import inspect
import json
from collections.abc import Iterator
from enum import StrEnum
from pathlib import Path
from types import ModuleType
from typing import Annotated, Any

import typer

from wpt_agents.zoo.commands.options import print_table

Case = StrEnum(
    "Case",
    "model scaling profile work gpu policy replay data envs retrieval prediction exploration "
    "threads all",
)
Peer = StrEnum("Peer", ["sheeprl", "torchrl"])
Precision = StrEnum("Precision", ["fp32", "bf16"])


CaseOption = Annotated[
    Case,
    typer.Argument(
        help="What to measure. model: updates; scaling: their cost by batch, length and size; "
        "profile: one update by operator; work: counted operations; gpu: a step on a GPU; policy: "
        "acting; replay and data: reading batches; envs: rendering; retrieval; prediction; "
        "exploration; threads: several threads on a busy machine."
    ),
]
AsJson = Annotated[bool, typer.Option("--json", help="Print one JSON object per line.")]
Quick = Annotated[
    bool, typer.Option(help="Only check in seconds that it runs; the numbers are not meaningful.")
]
Threads = Annotated[
    int,
    typer.Option(
        min=1, help="The number of threads; the case model compares them with a single thread."
    ),
]
PrecisionOption = Annotated[Precision, typer.Option(help="The precision of the forward passes.")]
Compiled = Annotated[
    bool,
    typer.Option(
        "--compile",
        help="For model and gpu: use torch.compile for the recurrent steps, which takes minutes.",
    ),
]
PeerOption = Annotated[
    Peer | None,
    typer.Option(help="For model: compare with the DreamerV3 of this other library."),
]
Plot = Annotated[
    Path | None, typer.Option(help="For scaling: draw the measurements into this file.")
]
Updates = Annotated[
    int | None, typer.Option(min=1, help="For prediction: the number of updates of each model.")
]
Behaviour = Annotated[
    list[str] | None,
    typer.Option(help="For exploration: measure this behaviour only; can be repeated."),
]
Steps = Annotated[
    int | None,
    typer.Option(min=1, help="For exploration: the number of training steps of explore-state."),
]
Settings = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="KEY=VALUE",
        help="For prediction and model: a keyword of WPT, such as `imagine_starts=128`; can be "
        "repeated.",
    ),
]
Probe = Annotated[
    bool,
    typer.Option(
        "--probe",
        help="For prediction: print instead how well linear probes predict the true state from the "
        "latents.",
    ),
]
Robots = Annotated[
    list[str] | None,
    typer.Option(
        "--robot",
        help="For prediction with --probe: probe this robot only, such as `cartpole`; can be "
        "repeated.",
    ),
]


def bench(
    case: CaseOption = Case.all,
    as_json: AsJson = False,
    quick: Quick = False,
    threads: Threads = 1,
    precision: PrecisionOption = Precision.fp32,
    compiled: Compiled = False,
    peer: PeerOption = None,
    plot: Plot = None,
    updates: Updates = None,
    behaviour: Behaviour = None,
    steps: Steps = None,
    probe: Probe = False,
    robots: Robots = None,
    settings: Settings = None,
) -> None:
    """Measure speed, data formats, retrieval, prediction or exploration on this machine.

    Times are medians after a warm-up: CPU time with one thread, wall-clock time otherwise.

    `share_of_ceiling` is the speed relative to a large matrix product measured in the same run.

    Example: `python -m wpt_agents.zoo bench model --json > model.jsonl`
    """
    if peer and case != Case.model:
        raise ValueError(f"--peer is an option of bench model, not of bench {case}")
    if plot and case != Case.scaling:
        raise ValueError(f"--plot is an option of bench scaling, not of bench {case}")
    if plot:
        _check_picture(plot)
    if compiled and (peer or case not in (Case.model, Case.gpu)):
        raise ValueError("--compile is an option of bench model and bench gpu, without --peer")
    if probe and case != Case.prediction:
        raise ValueError(f"--probe is an option of bench prediction, not of bench {case}")
    options: dict[str, Any] = {
        "probe": probe,
        "quick": quick,
        "compiled": compiled,
        "threads": threads,
        "precision": str(precision),
        "peer": peer,
        "updates": updates,
        "behaviours": behaviour,
        "steps": steps,
        "robots": robots,
        "settings": settings,
    }
    everywhere = [c for c in Case if c not in (Case.all, Case.gpu)]  # the case gpu needs one
    for name in everywhere if case == Case.all else [case]:
        try:
            module = importlib.import_module(f"wpt_agents.zoo.bench.{'peers' if peer else name}")
            if case != Case.all:
                _refuse_unused(case, module, options)
            measured = _show(str(name), _rows(module, options), as_json)
            if plot:
                module.plot(measured, plot)
        except ModuleNotFoundError as error:
            if (error.name or "").startswith("wpt_"):  # a fault of ours, not a missing package
                raise
            if case != Case.all:
                extra = "peers" if peer else "all"
                raise ValueError(
                    f"bench {name} needs {error.name}, which is not installed: "
                    f'pip install "wpt-agents[{extra}]"'
                ) from error
            typer.echo(f"bench {name} is left out: it needs {error.name}.", err=True)


def _check_picture(path: Path) -> None:
    """Raise an error for a type of picture that could not be written after the measurements."""
    from matplotlib.backend_bases import FigureCanvasBase

    types = FigureCanvasBase.get_supported_filetypes()
    if path.suffix and path.suffix[1:].lower() not in types:
        raise ValueError(f"--plot {path}: a picture can be of the types {', '.join(types)}")


# Options of some cases only: their keywords of `rows`, their names, and their defaults.
PARTIAL = {
    "threads": ("--threads", 1),
    "precision": ("--precision", "fp32"),
    "updates": ("--updates", None),
    "behaviours": ("--behaviour", None),
    "steps": ("--steps", None),
    "robots": ("--robot", None),
    "settings": ("--set", None),
}


def _refuse_unused(case: Case, module: ModuleType, options: dict[str, Any]) -> None:
    """Raise an error for an option that has no effect on the case."""
    taken = inspect.signature(module.rows).parameters
    for key, (option, default) in PARTIAL.items():
        if key not in taken and options[key] not in (default, []):
            raise ValueError(f"{option} has no effect on bench {case}: leave it out")


def _rows(module: ModuleType, options: dict[str, Any]) -> Iterator[dict]:
    """Yield the rows of a case with their memory use; pass only the options that it accepts."""
    from wpt_agents.zoo.bench.timing import forget_peak, peak_rss_mb

    taken = inspect.signature(module.rows).parameters
    chosen = {key: value for key, value in options.items() if key in taken and value is not None}
    rows = module.rows(**chosen)
    forget_peak()
    for row in rows:
        yield row | {"rss_mb": row.get("rss_mb", peak_rss_mb())}
        forget_peak()


def _show(name: str, rows: Iterator[dict], as_json: bool) -> list[dict]:
    """Print the rows, as JSON as soon as each one is measured, and return them."""
    measured = []
    for row in rows:
        measured.append(row)
        if as_json:
            typer.echo(json.dumps({"case": name, **row}))
    if not as_json:
        print_table(name, measured)
    return measured
