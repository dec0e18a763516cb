"""The sequences of a batch, drawn by one rule for datasets and replay buffers.

A window is `length` consecutive images of a trajectory, and all windows of all trajectories are
equally likely. A trajectory with fewer images counts as one window: it is taken whole, and the
sequence continues with further trajectories from their first image, drawn uniformly, with
`is_first` True at each joint. So no trajectory is lost because it is short.
"""

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np
import torch

from wpt_agents.data.trajectory import Batch, MarkedBatch, Trajectory, led_to, moving_pixels

Piece = tuple[int, int, int]  # trajectory, its first image, one past its last image
Row = list[Piece]  # the pieces that make one sequence


def draw_places(
    ends: np.ndarray, n: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Draw n places in trajectories; all places of all trajectories are equally likely.

    :param ends: (N,) int, the cumulative number of places in the trajectories
    :return: the number of each trajectory and the place in it, (n,) each
    """
    draws = rng.integers(ends[-1], size=n)
    chosen = np.searchsorted(ends, draws, side="right")
    return chosen, draws - np.concatenate([[0], ends])[chosen]


class Windows:
    """Draws sequences from trajectories of known lengths.

    :param lengths: (N,) int, the number of actions of each trajectory (it has one image more)
    """

    def __init__(self, lengths: np.ndarray) -> None:
        assert len(lengths) > 0
        self._images = np.asarray(lengths, np.int64) + 1
        # Window length and (N,) cumulative counts of such windows. One object, so that threads
        # that draw windows of different lengths do not mix them.
        self._ends = (0, self._images)

    def draw(self, batch_size: int, length: int, rng: np.random.Generator) -> list[Row]:
        """Draw the pieces of `batch_size` sequences; a sequence has several if they are short."""
        known, ends = self._ends
        if known != length:
            # a short trajectory counts as one window
            ends = np.cumsum(np.maximum(self._images - length + 1, 1))
            self._ends = length, ends
        # One draw over all windows, so that long trajectories are seen more often than short ones.
        chosen, starts = draw_places(ends, batch_size, rng)
        return [
            self._chain(int(i), int(start), length, rng)
            for i, start in zip(chosen, starts, strict=True)
        ]

    def _chain(self, i: int, start: int, length: int, rng: np.random.Generator) -> Row:
        """Return the piece from `start` on, and further trajectories up to `length` images."""
        pieces = []
        while True:
            stop = int(min(start + length, self._images[i]))
            pieces.append((i, start, stop))
            length -= stop - start
            if length == 0:
                return pieces
            i = int(rng.integers(len(self._images)))
            start = 0


def make_batch(
    rows: Sequence[Row],
    read: Callable[[Piece], tuple[Trajectory, int, int]],
    image_shape: tuple[int, ...],
    width: int,
    apply: Callable[[Callable[[int], None], Iterable[int]], Iterable[Any]] = map,
    background: Callable[[int], np.ndarray] | None = None,
) -> Batch:
    """Copy the pieces of each row, one after the other, into a new Batch.

    :param read: reads a piece: returns a trajectory, or a part of one, and the first and the last +
        1 of its images to take
    :param image_shape: (H, W, 3)
    :param width: the agent's action width, `max_action_dim`
    :param apply: `map`, or that of a thread pool if `read` takes time
    :param background: returns the background of a trajectory by its number, (H, W, 3) uint8; with
        it, a `MarkedBatch` is made
    :raises ValueError: a trajectory with more actions than `width`
    """
    length = sum(stop - start for _, start, stop in rows[0])
    out = _empty(len(rows), length, image_shape, width)
    if background is not None:
        out["moving"] = np.empty((len(rows), length, *image_shape[:2]), bool)

    def fill(b: int) -> None:
        at = 0
        for piece in rows[b]:
            trajectory, start, stop = read(piece)
            _check_width(trajectory, width)
            streams = led_to(trajectory, start, stop, width)
            if background is not None:
                streams["moving"] = moving_pixels(streams["image"], background(piece[0]))
            for name, stream in streams.items():
                out[name][b, at : at + stop - start] = stream
            at += stop - start

    for _ in apply(fill, range(len(rows))):
        pass
    kind = Batch if background is None else MarkedBatch
    return kind(**{name: torch.from_numpy(array) for name, array in out.items()})


def _empty(
    size: int, length: int, image_shape: tuple[int, ...], width: int
) -> dict[str, np.ndarray]:
    return {
        "image": np.empty((size, length, *image_shape), np.uint8),
        "action": np.empty((size, length, width), np.float32),
        "reward": np.empty((size, length), np.float32),
        "is_first": np.empty((size, length), bool),
        "is_terminal": np.empty((size, length), bool),
        "reward_known": np.empty((size, length), bool),
    }


def _check_width(trajectory: Trajectory, width: int) -> None:
    if trajectory.action_dim > width:
        raise ValueError(
            f"A trajectory of {trajectory.embodiment or 'an unnamed embodiment'} has "
            f"{trajectory.action_dim} actions, the agent takes {width}; "
            f"pass max_action_dim={trajectory.action_dim} or leave the trajectory out"
        )
