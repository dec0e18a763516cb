"""The page's figures: SVG by matplotlib that uses the page's light or dark colours."""

import io
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from wpt_agents.zoo.pictures.style import plt

# Placeholder colours, which `svg` replaces with the page's CSS variables.
INK, MUTED, GRID = "#010101", "#020202", "#030303"
SERIES = tuple(f"#a1000{number}" for number in range(1, 9))
VARIABLES = {INK: "var(--ink)", MUTED: "var(--muted)", GRID: "var(--line)"} | {
    colour: f"var(--series-{number})" for number, colour in enumerate(SERIES, 1)
}
STYLE: dict[Any, Any] = {  # matplotlib's type for the keys is a list of names
    **{"svg.fonttype": "none", "font.family": "sans-serif", "font.size": 9},
    **{"text.color": INK, "axes.edgecolor": GRID, "axes.labelcolor": MUTED},
    **{"xtick.color": MUTED, "ytick.color": MUTED, "xtick.labelcolor": MUTED},
    **{"axes.grid": True, "grid.color": GRID, "grid.linewidth": 0.6, "axes.titlesize": 9.5},
    **{
        "axes.axisbelow": True,
        "axes.spines.top": False,
        "axes.spines.right": False,
        "legend.frameon": False,
    },
}
Band = tuple[np.ndarray, np.ndarray, np.ndarray]  # middle, low, high, each (N,)


@dataclass(frozen=True)
class Line:
    """One method's line with its band.

    :param x: (N,)
    :param band: the middle and the ends of the shaded band, (N,) each; the middle itself for none
    """

    label: str
    x: np.ndarray
    band: Band


def svg(figure: Figure, title: str) -> str:
    """Return the figure as an `<svg>` element; `title` is for screen readers."""
    file = io.StringIO()
    with matplotlib.rc_context({"svg.hashsalt": title}):  # ids that are unique to each figure
        figure.savefig(file, format="svg", transparent=True, metadata={"Date": None})
    plt.close(figure)
    text = file.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(
        r'<svg[^>]*viewBox="([^"]*)"[^>]*>', rf'<svg viewBox="\1" {_LABEL}>', text, count=1
    )
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.S)
    for colour, variable in VARIABLES.items():
        text = text.replace(colour, variable)
    return text.replace("ARIA", title.replace("&", "&amp;").replace('"', "&quot;"), 1)


_LABEL = 'role="img" aria-label="ARIA" xmlns:xlink="http://www.w3.org/1999/xlink"'


def _axes() -> tuple[Figure, Axes]:
    figure = plt.figure(figsize=(3.6, 2.5), layout="constrained")
    return figure, figure.add_subplot()


def colour_of(label: str, labels: Sequence[str]) -> str:
    """Return a series' colour, the same in all figures with the same series."""
    return SERIES[list(labels).index(label) % len(SERIES)]


def dashes_of(label: str, labels: Sequence[str]) -> str:
    """Return a series' line style, which distinguishes series that share a colour."""
    return ("-", "--", ":")[list(labels).index(label) // len(SERIES) % 3]


def lines(
    title: str,
    x_label: str,
    y_label: str,
    series: Sequence[Line],
    labels: Sequence[str],
    step: bool = False,
) -> str:
    """Draw lines with their bands.

    :param labels: all series of the page, for the colours
    :param step: draw steps, as for a distribution
    """
    with matplotlib.rc_context(STYLE):
        figure, axes = _axes()
        how = "steps-post" if step else "default"
        for line in series:
            colour = colour_of(line.label, labels)
            middle, low, high = line.band
            marker = "" if step else "o"
            style = dashes_of(line.label, labels)
            axes.plot(
                line.x, middle, style, color=colour, lw=1.8, marker=marker, ms=3, drawstyle=how
            )
            axes.fill_between(
                line.x, low, high, color=colour, alpha=0.18, lw=0, step="post" if step else None
            )
        axes.set(title=title, xlabel=x_label, ylabel=y_label)
        axes.xaxis.set_major_locator(plt.MaxNLocator(5))
        if step:
            axes.set_ylim(-0.02, 1.02)
        else:
            axes.xaxis.set_major_formatter(lambda value, _: f"{value:,.0f}")
        return svg(figure, title)


def bars(
    title: str,
    y_label: str,
    series: Mapping[str, tuple[float, float | None, float | None]],
    colours: Sequence[str],
) -> str:
    """Draw a bar for each name, with its 95 % interval if there is one."""
    with matplotlib.rc_context(STYLE):
        figure, axes = _axes()
        for place, (value, low, high) in enumerate(series.values()):
            axes.bar(place, value, 0.62, color=colours[place], alpha=0.85)
            if low is not None and high is not None:
                error = [[max(value - low, 0)], [max(high - value, 0)]]
                axes.errorbar(place, value, error, color=INK, capsize=3, lw=1)
        texts = [f"{name}\n{value:.2f}" for name, (value, *_) in series.items()]
        axes.set_xticks(range(len(series)), texts)
        axes.set_title(title, wrap=True)
        axes.set(ylabel=y_label)
        if not any(value or high for value, _, high in series.values()):
            axes.set_ylim(0, 1)  # avoid an axis around 0, which would look like an error
        axes.grid(False, axis="x")
        return svg(figure, title)
