"""Helpers for sheets of images: single images, titles, and short names."""

import os
from pathlib import Path

import numpy as np

from wpt_agents.zoo.pictures.style import INK, MUTED, plt

COLUMNS = 8  # images per row of the contact sheet, and of a run's retrieval sheet


def draw(axis: plt.Axes, image: np.ndarray, colour: str = MUTED, width: float = 0.5) -> None:
    """Draw one image with a frame and without ticks."""
    axis.imshow(image)
    axis.set(xticks=[], yticks=[])
    axis.spines[:].set(color=colour, linewidth=width)


def finish(figure: plt.Figure, path: str | os.PathLike[str], title: str) -> None:
    """Write the figure to `path` under a title, in a new folder if need be, and close it."""
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    figure.suptitle(title, fontsize=9, color=INK)
    figure.tight_layout(rect=(0, 0, 1, 1 - 0.2 / figure.get_figheight()), pad=0.4)
    figure.savefig(path, dpi=130, bbox_inches="tight")
    plt.close(figure)


def short(task: str | None) -> str | None:
    """Return the id of a task without its prefix and version."""
    return task.removeprefix("wpt/").removesuffix("-v0") if task else None


def kind(task: str | None, embodiment: str | None) -> str:
    """Return a short name: the task without its suite, or the robot."""
    suite, _, name = (short(task) or "").partition("-")
    return cut(name or suite or embodiment or "", 18)


def cut(text: str, width: int = 30) -> str:
    """Return the text, shortened to `width` characters."""
    return text if len(text) <= width else f"{text[: width - 1]}…"
