"""The cost of a unit of work by size, batch, length and number of environments."""

from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import torch

from wpt_agents.zoo.bench import policy
from wpt_agents.zoo.bench.model import updates

GRID = {  # axis: cases of (size, batch, length)
    "batch": [("tiny", batch, 16) for batch in (4, 8, 16, 32)],
    "length": [("tiny", 16, length) for length in (8, 16, 32, 64)],
    "size": [(size, 16, 16) for size in ("debug", "tiny", "small", "medium")],
}
QUICK = {"batch": [("debug", batch, 4) for batch in (1, 2)]}
UNITS = {"batch": "image", "length": "image", "size": "GFLOP", "environments": "action"}


def rows(quick: bool = False, threads: int = 1, precision: str = "fp32") -> Iterator[dict]:
    """Yield a row for each case: `grows` is the axis, `ms_per_unit` the cost of a unit of work."""
    torch.set_num_threads(threads)
    for row in policy.rows(quick, threads):
        measured = SimpleNamespace(**row)
        if measured.what == "policy step":
            yield _per_unit(row, "environments", measured.batch)
    seen: dict[tuple, list[dict]] = {}
    for grows, cases in (QUICK if quick else GRID).items():
        for case in cases:
            if case not in seen:
                seen[case] = list(updates(*case, precision, 1 if quick else 3))
            for row in seen[case]:
                measured = SimpleNamespace(**row)
                images = measured.batch * measured.length
                yield _per_unit(row, grows, measured.gflop if grows == "size" else images)


def _per_unit(row: dict[str, Any], grows: str, units: float) -> dict[str, Any]:
    cost = 1e3 * row["median_s"] / units
    return {"grows": grows, **row, "unit": UNITS[grows], "ms_per_unit": cost}


def plot(measured: list[dict[str, Any]], path: Path) -> None:
    """Plot `rows`: a panel per axis, a line per kind of step; a flat line is proportional cost."""
    from matplotlib.figure import Figure

    axes = [name for name in UNITS if _lines(measured, name)]
    figure = Figure(figsize=(3.4 * len(axes), 3.2), layout="constrained")
    for name, panel in zip(axes, figure.subplots(1, len(axes), squeeze=False)[0], strict=True):
        for label, points in _lines(measured, name).items():
            panel.plot(*zip(*points, strict=True), marker="o", label=label)
        panel.set_xlabel({"size": "GFLOP an update"}.get(name, name))
        panel.set_ylabel(f"ms per {UNITS[name]}")
        panel.set_xscale("log", base=2)
        panel.xaxis.set_major_formatter("{x:g}")
        panel.set_ylim(bottom=0)
        panel.legend(fontsize="small")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=120)


def _lines(measured: list[dict[str, Any]], name: str) -> dict[str, list[tuple[float, float]]]:
    """Return the points of each line of a panel, from left to right."""
    key = {"size": "gflop", "length": "length"}.get(name, "batch")
    lines: dict[str, list[tuple[float, float]]] = {}
    for row in measured:
        case = SimpleNamespace(**row)
        if case.grows == name:
            label = case.what if name != "environments" else case.size
            lines.setdefault(label, []).append((row[key], case.ms_per_unit))
    return {label: sorted(points) for label, points in lines.items()}
