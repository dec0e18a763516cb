"""Figures of predictions: errors over the horizon, and strips of frames."""

import io
import os
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import LogLocator, NullFormatter
from PIL import Image

from wpt_agents.zoo.pictures.style import INK, MUTED, plt

# Okabe and Ito's colour-blind safe colours; dashes help in print
STYLES: dict[str, dict[str, Any]] = {
    "world model": {"color": "#0072b2", "lw": 2.4},
    "generalist": {"color": "#0072b2", "lw": 2.4},
    "specialist": {"color": "#e69f00", "lw": 2.4},
    "untrained": {"color": MUTED, "ls": ":", "lw": 1.6},
    "copy last frame": {"color": "#000000", "ls": "--", "lw": 1.6},
    "mean frame": {"color": "#cc79a7", "ls": "-.", "lw": 1.6},
    "left out": {"color": "#d55e00", "lw": 2.4},
    "left out, then": {"color": "#009e73", "lw": 2.4},
    "from scratch": {"color": "#56b4e9", "lw": 2.4},
}
COMMON = tuple(STYLES)[:6]  # compared on every robot
OTHERS = ("#d55e00", "#009e73", "#56b4e9", "#e69f00")  # colours of models that the user has named
DASHES = ("-", ":", "-.", "--")  # of predictors that share a style, as a model and its mean
CAPTION = (  # of the strips, in lines that fit above a single panel
    "Upper row: what happened. Rows below: what is predicted from\n"
    "the actions alone, after the last image seen. One step is one action."
)


class Curve(NamedTuple):
    """The error of one predictor on one robot, at the horizons 0, 1, ..."""

    robot: str
    prediction: str
    error: np.ndarray
    low: np.ndarray
    high: np.ndarray


class Strip(NamedTuple):
    """Rows of (N, 64, 64, 3) uint8 images by name, with one column per horizon."""

    title: str
    images: Mapping[str, np.ndarray]
    horizons: Sequence[int]


def style(prediction: str, rank: int = 0) -> dict[str, Any]:
    """Return the line style of a predictor, by its longest known prefix.

    :param rank: its place in the panel; a predictor of another name takes its colour by this
    """
    if known := [name for name in STYLES if prediction.startswith(name)]:
        return STYLES[max(known, key=len)]
    return {"color": OTHERS[rank % len(OTHERS)], "lw": 1.6}


def draw_curves(
    path: str | os.PathLike[str], curves: Sequence[Curve], left_out: str | None = None
) -> None:
    """Draw a panel for each robot, and one for a robot that was excluded from pre-training."""
    robots = list(dict.fromkeys(curve.robot for curve in curves))
    legend = 0.2 * len(curves) if len(robots) == 1 else 0.0  # above a single panel, in one column
    figure, panels = _grid(len(robots) + (left_out is not None), (3.6, 2.9 + legend))
    for axes, robot in zip(panels, robots, strict=False):
        shown = [c for c in curves if c.robot == robot]
        if left_out is not None:
            shown = [c for c in shown if c.prediction in COMMON]
        _panel(axes, robot, shown)
    if left_out is not None:
        shown = [c for c in curves if c.robot == left_out]
        shown = [
            c for c in shown if c.prediction not in COMMON or c.prediction == "copy last frame"
        ]
        axes = panels[len(robots)]
        _panel(axes, f"{left_out}, left out of pre-training", shown)
        axes.legend(frameon=False, fontsize=8)
    handles, names = panels[0].get_legend_handles_labels()
    figure.legend(
        handles, names, loc="outside upper center", ncols=2 * min(3, len(panels)) - 1, frameon=False
    )
    figure.savefig(path, dpi=110)
    plt.close(figure)


def _panel(axes: Axes, title: str, curves: Sequence[Curve]) -> None:
    looks: list[dict[str, Any]] = []
    for rank, curve in enumerate(curves):
        look = style(curve.prediction, rank)
        looks.append(look)
        if alike := looks.count(look) - 1:
            look = look | {"ls": DASHES[alike % len(DASHES)]}
        at = np.arange(len(curve.error))[1:]
        axes.plot(at, curve.error[1:], label=curve.prediction, **look)
        axes.fill_between(at, curve.low[1:], curve.high[1:], color=look["color"], alpha=0.13, lw=0)
    axes.set(title=title, xlabel="steps ahead", ylabel="squared error per image", yscale="log")
    axes.set_xticks([1, 10, 20, 30, 40])
    axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axes.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axes.yaxis.set_minor_formatter(NullFormatter())
    axes.grid(color="#e4e7eb", lw=0.6)
    axes.spines[["top", "right"]].set_visible(False)


def draw_strips(path: str | os.PathLike[str], strips: Sequence[Strip]) -> None:
    """Draw a block per strip, with predictors as rows and horizons as columns.

    Horizon 0 is the last image that the predictors see.
    """
    rows = max(len(strip.images) for strip in strips)
    figure, panels = _grid(len(strips), (4.4, 1.0 + 0.67 * rows))
    for axes, strip in zip(panels, strips, strict=False):
        axes.imshow(montage(list(strip.images.values())), interpolation="nearest")
        centres = [32 + 66 * i for i in range(max(len(strip.horizons), len(strip.images)))]
        axes.set_xticks(centres[: len(strip.horizons)], [ahead(h) for h in strip.horizons])
        names = [name.replace(", then ", ",\nthen ") for name in strip.images]
        axes.set_yticks(centres[: len(names)], names)
        axes.tick_params(length=0, labelcolor=INK, labeltop=True, labelbottom=False)
        axes.tick_params("x", labelsize=8)
        axes.set_title(strip.title)
        axes.spines[:].set_visible(False)
    figure.suptitle(CAPTION, fontsize=8, color=INK)
    file = io.BytesIO()
    figure.savefig(file, dpi=110)
    Image.open(file).convert("RGB").quantize(256).save(path)  # reduces the file to a third
    plt.close(figure)


def ahead(steps: int) -> str:
    """Return the label of an image, in two lines: its number of steps after the last seen one."""
    return f"{steps} step{'s' * (steps != 1)}\nahead" if steps else "last\nseen"


def montage(rows: Sequence[np.ndarray], gap: int = 2) -> np.ndarray:
    """Join rows of (N, H, W, 3) uint8 images into one picture, separated by white."""
    height, width = rows[0].shape[1:3]
    columns = len(rows[0])
    shape = len(rows) * (height + gap) - gap, columns * (width + gap) - gap, 3
    picture = np.full(shape, 255, np.uint8)
    for i, images in enumerate(rows):
        for j, image in enumerate(images):
            y, x = i * (height + gap), j * (width + gap)
            picture[y : y + height, x : x + width] = image
    return picture


def _grid(panels: int, panel_size: tuple[float, float]) -> tuple[Any, list[Axes]]:
    """Make a figure with up to three panels per row; unused panels are empty."""
    columns = min(3, panels)
    height = -(-panels // columns)
    size = columns * panel_size[0], height * panel_size[1]
    figure, axes = plt.subplots(height, columns, figsize=size, layout="constrained", squeeze=False)
    for empty in axes.flat[panels:]:
        empty.set_visible(False)
    return figure, list(axes.flat)
