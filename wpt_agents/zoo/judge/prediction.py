"""How far off open-loop predictions are, by horizon, on trajectories that were not trained on.

A few images are filtered, then the actions alone drive the model. The error is that of Eq. (1):
squared, summed over an image whose values lie in [-0.5, 0.5].
"""

import csv
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

CONTEXT, HORIZON = 5, 40  # images filtered, then images predicted
HORIZONS_SHOWN = (1, 5, 10, 20, 40)  # steps ahead, columns of the table
SHOWN = (0, 5, 10, 20, 40)  # horizons of the strips; 0 is the last image filtered

Predict = Callable[[Batch], np.ndarray]  # (B, T) windows -> (B, T, 64, 64, 3)
Ways = Mapping[str, Mapping[str, Predict]]  # by robot and name
Tests = Mapping[str, Sequence[Batch]]  # by robot, the windows of each trajectory


def judge(
    model: WPT, dataset: TrajectoryDataset, episodes: int, folder: Path | None = None
) -> Iterator[dict[str, Any]]:
    """Compares a world model with copying the last frame and with the mean frame, robot by robot.

    :param dataset: what the model was not trained on; its own mean frame is the one to beat
    :param episodes: of each robot, at most; spread evenly over those that are long enough
    :param folder: where to draw
    :raises ValueError: no trajectory is long enough, or one has more actions than the model takes
    """
    check_images(dataset)
    if (widest := max(dataset.action_dims)) > model.max_action_dim:
        raise ValueError(
            f"The dataset {dataset.path} has {widest} actions, the model takes at most "
            f"{model.max_action_dim}: take other data, or a model pre-trained for as many"
        )
    ways: dict[str, dict[str, Predict]] = {}
    tests: dict[str, list[Batch]] = {}
    names = np.array([name or "unnamed" for name in dataset.embodiments])
    long = np.asarray(dataset.lengths) + 1 >= CONTEXT + HORIZON
    if not long.any():
        raise ValueError(
            f"The longest trajectory of {dataset.path} has {max(dataset.lengths) + 1} images, but "
            f"{CONTEXT} observed and {HORIZON} predicted ones are needed: use longer episodes"
        )
    for robot in dict.fromkeys(names[long].tolist()):
        candidates = np.flatnonzero(long & (names == robot))
        number = min(episodes, len(candidates))
        spread = np.linspace(0, len(candidates) - 1, number).round().astype(int)
        chosen = dataset.subset(candidates[spread])
        tests[robot] = [windows(trajectory, 3, model.max_action_dim) for trajectory in chosen]
        ways[robot] = {
            "world model": dream(model),
            "copy last frame": copy_last_frame,
            "mean frame": MeanFrame(chosen),
        }
    shown = [(robot, robot, ["world model"]) for robot in ways]
    return compare(ways, tests, folder, shown)


def compare(
    ways: Ways,
    tests: Tests,
    folder: Path | None,
    shown: Sequence[tuple[str, str, Sequence[str]]],
    left_out: str | None = None,
) -> Iterator[dict[str, Any]]:
    """A row for each robot and way of predicting.

    :param folder: where `prediction.csv`, `prediction.png` and `strips.png` are written
    :param shown: the strips: title, robot, and names of what predicts
    :param left_out: a robot whose other ways have a panel of their own
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
    """Windows of CONTEXT + HORIZON images, spread evenly from a trajectory's start to its end."""
    length = CONTEXT + HORIZON
    starts = np.linspace(0, len(trajectory) + 1 - length, number).astype(int)
    return stack_windows([led_to(trajectory, s, s + length, width) for s in starts])


def dream(model: WPT) -> Predict:
    """The world model's open-loop prediction, by one sample of the latents."""

    def predict(batch: Batch) -> np.ndarray:
        generator = Generator(model.device).manual_seed(0)
        batch = batch.to(model.device)
        return model.policy.world_model.open_loop(batch, CONTEXT, generator).cpu().numpy()

    return predict


def copy_last_frame(batch: Batch) -> np.ndarray:
    """The images filtered, then the last of them again and again."""
    image = batch.image.numpy().copy()
    image[:, CONTEXT:] = image[:, CONTEXT - 1 : CONTEXT]
    return image


class MeanFrame:
    """Predicts the mean of all images of a dataset, (64, 64, 3), whatever happens."""

    def __init__(self, dataset: TrajectoryDataset) -> None:
        total = sum(trajectory.image.sum(0, np.float64) for trajectory in dataset)
        self.image = np.asarray(total / (dataset.lengths + 1).sum())

    def __call__(self, batch: Batch) -> np.ndarray:
        """(B, T) windows -> (B, T, 64, 64, 3) float64."""
        return np.broadcast_to(self.image, batch.image.shape)


def squared_error(true: np.ndarray, predicted: np.ndarray) -> np.ndarray:
    """As in Eq. (1): (..., 64, 64, 3) of 0 to 255 each -> (...), summed over an image."""
    assert true.shape == predicted.shape, (true.shape, predicted.shape)
    difference = (predicted.astype(np.float32) - true) / 255
    return np.square(difference).sum((-3, -2, -1), np.float64)


def errors_by_horizon(predict: Predict, tests: Sequence[Batch]) -> np.ndarray:
    """(trajectories, 1 + HORIZON), the mean over each trajectory's windows.

    :param tests: a trajectory's windows in each
    """
    by_window = [squared_error(batch.image.numpy(), predict(batch)) for batch in tests]
    return np.stack([errors[:, CONTEXT - 1 :].mean(0) for errors in by_window])


def with_interval(errors: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(trajectories, ...) -> the mean (...) and its 95 % interval, bootstrapped over the first."""
    low, high = bootstrap(lambda strata: strata[0].mean(1), [errors], draws=2000)
    return errors.mean(0), low, high


def row(robot: str, name: str, errors: np.ndarray, copied: np.ndarray) -> dict[str, Any]:
    """Errors at a few horizons, then their mean over all and its difference from copying."""
    means = errors[:, 1:].mean(1)
    mean, low, high = with_interval(means)
    less, least, most = with_interval(means - copied[:, 1:].mean(1))
    return {
        "robot": robot,
        "prediction": name,
        "episodes": len(errors),
        **{f"+{h}": round(float(errors[:, h].mean()), 1) for h in HORIZONS_SHOWN},
        f"mean of 1 to {HORIZON}": round(float(mean), 1),
        "95 %": f"{low:.1f} to {high:.1f}",
        "minus copying": round(float(less), 1),
        "95 % ": f"{least:.1f} to {most:.1f}",
    }


def one_by_one(batch: Batch) -> Iterator[Batch]:
    """(B, T) windows as B batches of (1, T)."""
    for i in range(len(batch.image)):
        yield Batch(**{name: stream[i : i + 1] for name, stream in vars(batch).items()})


def typical(parts: Sequence[Batch]) -> Batch:
    """The window of median motion, by the error of copying the last frame up to the end."""
    moved = [squared_error(p.image.numpy(), copy_last_frame(p))[0, -1] for p in parts]
    return parts[int(np.argsort(moved)[len(moved) // 2])]


def strip(title: str, tests: Sequence[Batch], ways: Mapping[str, Predict]) -> Strip:
    """True and predicted images of a typical window."""
    window = typical([part for batch in tests for part in one_by_one(batch)])
    at = [CONTEXT - 1 + h for h in SHOWN]
    images = {"true": window.image.numpy()} | {n: predict(window) for n, predict in ways.items()}
    return Strip(title, {name: picture[0, at] for name, picture in images.items()}, SHOWN)


def write_curves(path: Path, curves: Sequence[Curve]) -> None:
    """Writes every horizon's error and interval."""
    with open(path, "w", newline="", encoding="utf-8") as file:
        table = csv.writer(file)
        table.writerow(("robot", "prediction", "horizon", "error", "low", "high"))
        for c in curves:
            for horizon, values in enumerate(zip(c.error, c.low, c.high, strict=True)):
                table.writerow((c.robot, c.prediction, horizon, *(f"{v:.2f}" for v in values)))
