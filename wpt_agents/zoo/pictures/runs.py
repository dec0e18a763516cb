"""The pictures of a run: its learning curve, a video of its policy, a strip of predictions."""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import imageio.v2 as imageio
import numpy as np
from matplotlib.axes import Axes

from wpt_agents.zoo.pictures.predictions import ahead
from wpt_agents.zoo.pictures.style import AGENT, CLONE, INK, MUTED, plt
from wpt_agents.zoo.result import LAST, NOTHING, PRIOR_ACTOR, RANDOM, Score, final_policy

COLOURS = {NOTHING: "#b0b7bf", RANDOM: "#7f8a96", PRIOR_ACTOR: CLONE}


def learning_curve(
    path: str | os.PathLike[str],
    title: str,
    frames: np.ndarray,
    returns: np.ndarray,
    scores: Mapping[str, Score],
    evaluations: tuple[np.ndarray, np.ndarray] | None = None,
    window: int = 10,
) -> None:
    """Draw training returns over simulator frames, and the final scores as lines and a bar.

    :param frames: (N,), frames at the end of each training episode
    :param returns: (N,), return of each training episode
    :param scores: scores by policy; the final one is the point at the end
    :param evaluations: frames (M,) and returns (M, episodes) of evaluations during fine-tuning
    """
    figure, axes = plt.subplots(figsize=(7, 4), layout="constrained")
    axes.plot(frames, returns, ".", color=AGENT, alpha=0.3, label="training episodes")
    if len(returns) >= window:
        smooth = np.convolve(returns, np.ones(window) / window, "valid")
        label = f"their mean over {window}"
        axes.plot(frames[window - 1 :], smooth, color=AGENT, lw=2, label=label)
    if evaluations is not None:
        at, episodes = evaluations
        axes.plot(at, episodes.mean(axis=1), "o-", color=INK, ms=4, label="evaluations")
    lines: dict[str, float] = {}
    for name, score in scores.items():
        if name == final_policy(scores):
            whose = "the agent at the end" if name == LAST else "the best of the evaluated agents"
            _final_point(axes, max(frames, default=0), score, whose)
        else:
            lines[name] = score.mean
            axes.axhline(score.mean, color=COLOURS.get(name, MUTED), ls="--", lw=1.2)
    name_lines(axes, lines)
    axes.set(title=title, xlabel="simulator frames", ylabel="episode return")
    axes.xaxis.set_major_formatter(lambda value, _: f"{value:,.0f}")
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(edgecolor="none", framealpha=0.9, loc="best")
    figure.savefig(path, dpi=130)
    plt.close(figure)


def name_lines(axes: Axes, lines: Mapping[str, float]) -> None:
    """Write the name and height of each horizontal line above it, and above the text below."""
    low, high = axes.get_ylim()
    free = low
    for name, height in sorted(lines.items(), key=lambda line: line[1]):
        at = max(height, free)
        text = f"{name} {height:.0f}"
        axes.annotate(text, (0.01, at), xycoords=("axes fraction", "data"), va="bottom")
        free = at + 0.05 * (high - low)  # the height of a line of text


def _final_point(axes: Axes, at: float, score: Score, whose: str) -> None:
    """Draw the score of the final policy with its 95 % interval, at the end of the run."""
    mean, low, high = score.interval
    bar = [[mean - low], [high - mean]] if low is not None and high is not None else None
    style: dict[str, Any] = {"fmt": "D", "color": AGENT, "mec": "white", "ms": 9}
    label = f"{whose}, {mean:.0f}"
    axes.errorbar([at], [mean], bar, label=label, capsize=4, zorder=3, **style)


def prediction_strip(
    path: str | os.PathLike[str],
    title: str,
    true: np.ndarray,
    predicted: np.ndarray,
    context: int,
    columns: int = 12,
) -> None:
    """Draw true images above open-loop predictions; another colour marks the observed part.

    :param true: (T, 64, 64, 3) uint8
    :param predicted: (T, 64, 64, 3) uint8; the first `context` are reconstructions
    """
    assert true.shape == predicted.shape, (true.shape, predicted.shape)
    seen = [0, context - 1]
    dreamt = np.linspace(context, len(true) - 1, columns - len(seen)).round().astype(int)
    steps = [*seen, *dict.fromkeys(dreamt.tolist())]
    figure, axes = plt.subplots(
        2, len(steps), figsize=(len(steps), 2.95), layout="constrained", squeeze=False
    )
    for column, step in enumerate(steps):
        for row, images in enumerate((true, predicted)):
            axes[row, column].imshow(images[step])
            axes[row, column].set(xticks=[], yticks=[])
            axes[row, column].spines[:].set_color(AGENT if step < context else INK)
        label = ahead(step - context + 1) if step else "first\nseen"
        axes[0, column].set_title(label, fontsize=9, color=INK)
    axes[0, 0].set_ylabel("true")
    axes[1, 0].set_ylabel("predicted")
    explained = "above: what happened; below: what the world model predicts from the actions alone"
    figure.suptitle(f"{title}\n{explained}; a step is one action", fontsize=10)
    figure.savefig(path, dpi=130)
    plt.close(figure)


def video(path: str | os.PathLike[str], frames: Sequence[np.ndarray], fps: float) -> None:
    """Write an mp4 that plays in any browser.

    :param frames: each (H, W, 3) uint8, H and W multiples of 16
    """
    imageio.mimwrite(Path(path), list(frames), fps=fps, codec="libx264", quality=7)
