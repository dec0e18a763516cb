"""Errors of open-loop predictions by horizon, on held-out trajectories.

A few images are filtered, then the model predicts from actions alone. The error is that of Eq. (1):
squared, summed over an image whose values lie in [-0.5, 0.5].
"""

import csv
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from torch import Generator

from wpt_agents.agents.wpt import WPT
from wpt_agents.data.dataset import TrajectoryDataset
from wpt_agents.data.trajectory import Batch, Trajectory, led_to, stack_windows
from wpt_agents.training.checks import check_images
from wpt_agents.zoo.pictures.predictions import Curve, Strip, draw_curves, draw_strips
from wpt_agents.zoo.statistics import bootstrap

CONTEXT, HORIZON = 5, 40  # number of filtered images, then of predicted images
HORIZONS_SHOWN = (1, 5, 10, 20, 40)  # steps ahead, columns of the table
SHOWN = (0, 5, 10, 20, 40)  # horizons of the strips; 0 is the last filtered image

Predict = Callable[[Batch], np.ndarray]  # (B, T) windows -> (B, T, 64, 64, 3)
Ways = Mapping[str, Mapping[str, Predict]]  # by robot and name
RESERVED = ("true", "copy last frame", "mean frame")  # rows beside those of the models
Tests = Mapping[str, Sequence[Batch]]  # by robot, the windows of each trajectory


def judge(
    models: Mapping[str, WPT],
    dataset: TrajectoryDataset,
    episodes: int,
    folder: Path | None = None,
    samples: int = 1,
) -> Iterator[dict[str, Any]]:
    """Compare world models with copying the last frame and with the mean frame, for each robot.

    :param models: world models of one `max_action_dim`, by names that are not `RESERVED`
    :param dataset: held-out data, whose mean frame is one of the baselines
    :param episodes: maximum number for each robot, evenly spaced over those that are long enough
    :param folder: the folder of the pictures
    :param samples: if more than 1, a further row of each model shows the error of the mean of that
        many sampled predictions
    :raises ValueError: if no trajectory is long enough, if one has too many actions, or if the
        models differ in `max_action_dim`
    """
    check_images(dataset)
    width = next(iter(models.values())).max_action_dim
    for name, model in models.items():
        if model.max_action_dim != width:
            raise ValueError(
                f"The models must take equally many actions, and {name} takes "
                f"{model.max_action_dim} instead of {width}: compare models of one max_action_dim"
            )
    if (widest := max(dataset.action_dims)) > width:
        raise ValueError(
            f"The dataset {dataset.path} has {widest} actions, the model takes at most "
            f"{width}: take other data, or a model pre-trained for as many"
        )
    ways: dict[str, dict[str, Predict]] = {}
    tests: dict[str, list[Batch]] = {}
    names = np.array([name or "unnamed" for name in dataset.embodiments])
    long = _long_enough(dataset, names)
    for robot in dict.fromkeys(names[long].tolist()):
        candidates = np.flatnonzero(long & (names == robot))
        number = min(episodes, len(candidates))
        spread = np.linspace(0, len(candidates) - 1, number).round().astype(int)
        chosen = dataset.subset(candidates[spread])
        tests[robot] = [windows(trajectory, 3, width) for trajectory in chosen]
        ways[robot] = {
            **{
                name if number == 1 else f"{name}, mean of {number}": dream(model, number)
                for name, model in models.items()
                for number in dict.fromkeys((1, samples))
            },
            "copy last frame": copy_last_frame,
            "mean frame": MeanFrame(chosen),
        }
    shown = [(robot, robot, list(models)) for robot in ways]
    return compare(ways, tests, folder, shown)


def _long_enough(dataset: TrajectoryDataset, names: np.ndarray) -> np.ndarray:
    """Return which trajectories have enough images; warn about robots that have none such.

    :raises ValueError: there is none of any robot
    """
    need = f"{CONTEXT} observed and {HORIZON} predicted ones are needed"
    fewer = "for shorter episodes, use `model.open_loop(trajectory, context, horizon)` in Python"
    long = np.asarray(dataset.lengths) + 1 >= CONTEXT + HORIZON
    if not long.any():
        raise ValueError(
            f"The longest trajectory of {dataset.path} has {max(dataset.lengths) + 1} images, but "
            f"{need}; {fewer}"
        )
    short = [name for name in dict.fromkeys(names.tolist()) if not long[names == name].any()]
    if short:
        warnings.warn(
            f"No trajectory of {', '.join(short)} is long enough ({need}), so the table does not "
            f"show it; {fewer}",
            stacklevel=3,
        )
    return long


def compare(
    ways: Ways,
    tests: Tests,
    folder: Path | None,
    shown: Sequence[tuple[str, str, Sequence[str]]],
    left_out: str | None = None,
) -> Iterator[dict[str, Any]]:
    """Yield a row for each robot and predictor.

    :param folder: the folder for `prediction.csv`, `prediction.png` and `strips.png`
    :param shown: the strips: title, robot, and names of predictors
    :param left_out: a robot whose additional predictors have a separate panel
    """
    errors = {
        robot: {name: errors_by_horizon(predict, tests[robot]) for name, predict in by_name.items()}
        for robot, by_name in ways.items()
    }
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)
        curves = [
            Curve(robot, name, *with_interval(error))
            for robot, by_name in errors.items()
            for name, error in by_name.items()
        ]
        write_curves(folder / "prediction.csv", curves)
        draw_curves(folder / "prediction.png", curves, left_out)
        strips = [
            strip(title, tests[robot], {name: ways[robot][name] for name in names})
            for title, robot, names in shown
        ]
        draw_strips(folder / "strips.png", strips)
    for robot, by_name in errors.items():
        for name, error in by_name.items():
            yield row(robot, name, error, by_name["copy last frame"])


def windows(trajectory: Trajectory, number: int, width: int) -> Batch:
    """Return windows of CONTEXT + HORIZON images, evenly spaced over a trajectory."""
    length = CONTEXT + HORIZON
    starts = np.linspace(0, len(trajectory) + 1 - length, number).astype(int)
    return stack_windows([led_to(trajectory, s, s + length, width) for s in starts])


def dream(model: WPT, samples: int = 1) -> Predict:
    """Predict open-loop with the world model: the mean image of some samples of the latents.

    If a model knows how uncertain the future is, the expected squared error of one sample is up to
    twice that of the mean of many, which is the best prediction by this error.
    """

    def predict(batch: Batch) -> np.ndarray:
        generator = Generator(model.device).manual_seed(0)
        batch = batch.to(model.device)
        futures = [
            model.policy.world_model.open_loop(batch, CONTEXT, generator).cpu().numpy()
            for _ in range(samples)
        ]
        return futures[0] if samples == 1 else np.stack(futures).mean(0, np.float32)

    return predict


def copy_last_frame(batch: Batch) -> np.ndarray:
    """Return the filtered images, then repeat the last one."""
    image = batch.image.numpy().copy()
    image[:, CONTEXT:] = image[:, CONTEXT - 1 : CONTEXT]
    return image


class MeanFrame:
    """Always predict the mean of all images of a dataset, (64, 64, 3)."""

    def __init__(self, dataset: TrajectoryDataset) -> None:
        total = sum(trajectory.image.sum(0, np.float64) for trajectory in dataset)
        self.image = np.asarray(total / (dataset.lengths + 1).sum())

    def __call__(self, batch: Batch) -> np.ndarray:
        """(B, T) windows -> (B, T, 64, 64, 3) float64."""
        return np.broadcast_to(self.image, batch.image.shape)


def squared_error(true: np.ndarray, predicted: np.ndarray) -> np.ndarray:
    """Return the error of Eq. (1), summed over an image: (..., 64, 64, 3) of 0 to 255 -> (...)."""
    assert true.shape == predicted.shape, (true.shape, predicted.shape)
    difference = (predicted.astype(np.float32) - true) / 255
    return np.square(difference).sum((-3, -2, -1), np.float64)


def errors_by_horizon(predict: Predict, tests: Sequence[Batch]) -> np.ndarray:
    """Return the mean over each trajectory's windows, (trajectories, 1 + HORIZON).

    :param tests: the windows of each trajectory
    """
    by_window = [squared_error(batch.image.numpy(), predict(batch)) for batch in tests]
    return np.stack([errors[:, CONTEXT - 1 :].mean(0) for errors in by_window])


def with_interval(errors: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(trajectories, ...) -> the mean (...) and its 95 % bootstrap interval over trajectories.

    The interval of a single trajectory is NaN.
    """
    if len(errors) < 2:
        unknown = np.full(errors.shape[1:], np.nan)
        return errors.mean(0), unknown, unknown
    low, high = bootstrap(lambda strata: strata[0].mean(1), [errors], draws=2000)
    return errors.mean(0), low, high


def row(robot: str, name: str, errors: np.ndarray, copied: np.ndarray) -> dict[str, Any]:
    """Return errors at some horizons, their mean over all, and its difference from copying."""
    means = errors[:, 1:].mean(1)
    mean, low, high = with_interval(means)
    less, least, most = with_interval(means - copied[:, 1:].mean(1))
    return {
        "robot": robot,
        "prediction": name,
        "episodes": len(errors),
        **{f"+{h}": round(float(errors[:, h].mean()), 1) for h in HORIZONS_SHOWN},
        f"mean of 1 to {HORIZON}": round(float(mean), 1),
        "95 %": _span(low, high),
        "minus copying": round(float(less), 1),
        "95 % ": _span(least, most),
    }


def _span(low: np.ndarray, high: np.ndarray) -> str:
    return "-" if np.isnan(low) else f"{low:.1f} to {high:.1f}"


def one_by_one(batch: Batch) -> Iterator[Batch]:
    """Split (B, T) windows into B batches of (1, T)."""
    for i in range(len(batch.image)):
        yield Batch(**{name: stream[i : i + 1] for name, stream in vars(batch).items()})


def typical(parts: Sequence[Batch]) -> Batch:
    """Return the window of median motion, measured by the final error of copying the last frame."""
    moved = [squared_error(p.image.numpy(), copy_last_frame(p))[0, -1] for p in parts]
    return parts[int(np.argsort(moved)[len(moved) // 2])]


def strip(title: str, tests: Sequence[Batch], ways: Mapping[str, Predict]) -> Strip:
    """Return true and predicted images of a typical window."""
    window = typical([part for batch in tests for part in one_by_one(batch)])
    at = [CONTEXT - 1 + h for h in SHOWN]
    images = {"true": window.image.numpy()} | {n: predict(window) for n, predict in ways.items()}
    return Strip(title, {name: picture[0, at] for name, picture in images.items()}, SHOWN)


def write_curves(path: Path, curves: Sequence[Curve]) -> None:
    """Write the error and interval of every horizon."""
    with open(path, "w", newline="", encoding="utf-8") as file:
        table = csv.writer(file)
        table.writerow(("robot", "prediction", "horizon", "error", "low", "high"))
        for c in curves:
            for horizon, values in enumerate(zip(c.error, c.low, c.high, strict=True)):
                table.writerow((c.robot, c.prediction, horizon, *(f"{v:.2f}" for v in values)))
