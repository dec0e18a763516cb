"""How far off open-loop predictions are, by horizon, on held-out trajectories of five robots.

The error is that of Eq. (1): squared, summed over an image whose values lie in [-0.5, 0.5]. Data,
models, errors and pictures are kept in `runs/bench/prediction`.
"""

import csv
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from shutil import copyfile
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Generator

from wpt_agents.archive import replacing
from wpt_agents.dataset import TrajectoryDataset
from wpt_agents.trajectory import Batch, Trajectory, led_to, stack_windows
from wpt_agents.wpt import WPT
from wpt_agents.zoo.bench.prediction_pictures import Curve, Strip, draw_curves, draw_strips
from wpt_agents.zoo.collect import collect
from wpt_agents.zoo.statistics import bootstrap

FOLDER = Path("runs") / "bench" / "prediction"
DMC = ("walker-run", "cheetah-run", "cartpole-swingup", "quadruped-run")
METAWORLD = ("drawer-close", "door-open", "button-press-topdown", "window-open")
LOOK = {"rendering": "fast"}
CONTEXT, HORIZON = 5, 40  # images filtered, then images predicted
TOLD = (1, 5, 10, 20, 40)  # horizons of the table
SHOWN = (0, 5, 10, 20, 40)  # horizons of the strips; 0 is the last image filtered
LEFT_OUT = "walker"  # from one generalist's pre-training

Predict = Callable[[Batch], np.ndarray]  # (B, T) windows -> (B, T, 64, 64, 3)


class Plan(NamedTuple):
    """How much of everything."""

    folder: Path
    tasks: Sequence[str]
    behaviour: str
    episodes: int  # of each task, each with a seed of its own
    held_out: int  # so many of them, the last ones, are not trained on
    windows: int  # of each held-out trajectory
    updates: int
    further: int  # updates on the robot that was left out
    model: Mapping[str, Any]


BATCH = {"max_action_dim": 12, "batch_size": 8, "batch_length": 16, "device": "cpu"}
FULL = Plan(
    folder=FOLDER,
    tasks=[f"wpt/dmc-{n}-v0" for n in DMC] + [f"wpt/metaworld-{n}-v0" for n in METAWORLD],
    behaviour="scripted",  # noise where there is no script
    episodes=20,
    held_out=8,
    windows=3,
    updates=1000,
    further=500,
    model={"size": "tiny", **BATCH},
)
QUICK = Plan(
    folder=FOLDER.with_name("prediction-quick"),
    tasks=["wpt/dmc-walker-run-v0", "wpt/dmc-cartpole-swingup-v0"],
    behaviour="noise",
    episodes=3,
    held_out=2,
    windows=2,
    updates=2,
    further=1,
    model={"size": "debug", **BATCH},
)


def rows(quick: bool = False, updates: int | None = None) -> Iterator[dict[str, Any]]:
    """A row for each robot and way of predicting; draws `prediction.png` and `strips.png`.

    :param updates: of each world model, if not the plan's; more of them go on from fewer
    """
    plan = QUICK if quick else FULL
    if updates is not None:
        plan = plan._replace(updates=updates, further=min(plan.further, updates))
    torch.set_num_threads(1)
    data = collect(
        plan.folder / "data", plan.tasks, plan.episodes, workers=1, behaviour=plan.behaviour,
        env=LOOK,
    )  # fmt: skip
    dataset, held_out = split(data, plan)
    predictions = predictors(plan, dataset)
    tests = {
        robot: [windows(t, plan.windows, plan.model["max_action_dim"]) for t in of(held_out, robot)]
        for robot in predictions
    }
    errors = {
        robot: {name: errors_by_horizon(predict, tests[robot]) for name, predict in ways.items()}
        for robot, ways in predictions.items()
    }
    curves = [
        Curve(robot, name, *with_interval(found))
        for robot, ways in errors.items()
        for name, found in ways.items()
    ]
    save(plan, curves, strips(predictions, tests))
    for robot, ways in errors.items():
        for name, found in ways.items():
            yield row(robot, name, found, ways["copy last frame"])


def split(data: TrajectoryDataset, plan: Plan) -> tuple[TrajectoryDataset, TrajectoryDataset]:
    """What is trained on, and each task's last episodes, which are not; they come task by task."""
    late = np.arange(len(data)) % plan.episodes >= plan.episodes - plan.held_out
    return data.subset(np.flatnonzero(~late)), data.subset(np.flatnonzero(late))


def of(dataset: TrajectoryDataset, *robots: str) -> TrajectoryDataset:
    """The trajectories of these robots."""
    return dataset.subset(np.flatnonzero([name in robots for name in dataset.embodiments]))


def predictors(plan: Plan, dataset: TrajectoryDataset) -> dict[str, dict[str, Predict]]:
    """By robot and name, what is compared; trains what is not trained yet."""
    robots = list(dict.fromkeys(str(robot) for robot in dataset.embodiments))
    told, scratch = f"{plan.further} updates", f"scratch-{plan.further}"
    from_scratch = train(plan, scratch, of(dataset, LEFT_OUT), plan.further)
    generalist = train(plan, "generalist", dataset, plan.updates)
    untrained = WPT("WPTPolicy", seed=0, **plan.model)
    found: dict[str, dict[str, Predict]] = {}
    for robot in robots:
        own = of(dataset, robot)
        start = scratch if robot == LEFT_OUT else None  # its first updates are the same
        specialist = train(plan, f"specialist-{robot}", own, plan.updates, start)
        found[robot] = {
            "generalist": dream(generalist),
            "specialist": dream(specialist),
            "untrained": dream(untrained),
            "copy last frame": copy_last_frame,
            "mean frame": MeanFrame(own),
        }
    others = of(dataset, *(robot for robot in robots if robot != LEFT_OUT))
    zero_shot = train(plan, "left-out", others, plan.updates)
    adapted = train(
        plan, f"left-out-{plan.updates}-then", of(dataset, LEFT_OUT),
        plan.updates + plan.further, "left-out",
    )  # fmt: skip
    found[LEFT_OUT] |= {
        "left out": dream(zero_shot),
        f"left out, then {told}": dream(adapted),
        f"from scratch, {told}": dream(from_scratch),
    }
    return found


def train(
    plan: Plan, name: str, dataset: TrajectoryDataset, updates: int, start: str | None = None
) -> WPT:
    """A world model after so many updates, of which those of the model `start` were the first.

    :raises ValueError: it has had more already
    """
    file = plan.folder / name / "model.zip"
    if start is not None and not file.exists():
        with replacing(file) as temporary:
            copyfile(plan.folder / start / "model.zip", temporary)
    model = WPT.pretrain(
        dataset, steps=updates, seed=0, run_dir=file.parent, progress_bar=True, **plan.model
    )
    if model.pretrain_steps > updates:
        raise ValueError(
            f"{file} has had {model.pretrain_steps} updates, not {updates}: give as many, or "
            f"delete {plan.folder}"
        )
    return model


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
    """Predicts the mean of all training images, (64, 64, 3), whatever happens."""

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
    each = [squared_error(batch.image.numpy(), predict(batch)) for batch in tests]
    return np.stack([errors[:, CONTEXT - 1 :].mean(0) for errors in each])


def with_interval(found: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(trajectories, ...) -> the mean (...) and its 95 % interval, bootstrapped over the first."""
    low, high = bootstrap(lambda strata: strata[0].mean(1), [found], draws=2000)
    return found.mean(0), low, high


def row(robot: str, name: str, found: np.ndarray, copied: np.ndarray) -> dict[str, Any]:
    """Errors at a few horizons, then their mean over all and its difference from copying."""
    means = found[:, 1:].mean(1)
    mean, low, high = with_interval(means)
    less, least, most = with_interval(means - copied[:, 1:].mean(1))
    return {
        "robot": robot,
        "prediction": name,
        "trajectories": len(found),
        **{f"+{h}": round(float(found[:, h].mean()), 1) for h in TOLD},
        f"mean of 1 to {HORIZON}": round(float(mean), 1),
        "95 %": f"{low:.1f} to {high:.1f}",
        "minus copying": round(float(less), 1),
        "95 % ": f"{least:.1f} to {most:.1f}",
    }


def strips(
    predictions: Mapping[str, Mapping[str, Predict]], tests: Mapping[str, Sequence[Batch]]
) -> list[Strip]:
    """True and predicted images of a typical window of each robot."""
    found = []
    for robot, ways in predictions.items():
        window = typical([part for batch in tests[robot] for part in one_by_one(batch)])
        names = ["generalist", "specialist"]
        found.append(_strip(robot, window, {name: ways[name] for name in names}))
        if robot == LEFT_OUT:
            names = [name for name in ways if name.startswith("left out")]
            found.append(_strip(f"{robot}, left out", window, {name: ways[name] for name in names}))
    return found


def _strip(title: str, window: Batch, ways: Mapping[str, Predict]) -> Strip:
    at = [CONTEXT - 1 + h for h in SHOWN]
    images = {"true": window.image.numpy()} | {n: predict(window) for n, predict in ways.items()}
    return Strip(title, {name: shown[0, at] for name, shown in images.items()}, SHOWN)


def one_by_one(batch: Batch) -> Iterator[Batch]:
    """(B, T) windows as B batches of (1, T)."""
    for i in range(len(batch.image)):
        yield Batch(**{name: stream[i : i + 1] for name, stream in vars(batch).items()})


def typical(parts: Sequence[Batch]) -> Batch:
    """The window of median motion, by the error of copying the last frame up to the end."""
    moved = [squared_error(p.image.numpy(), copy_last_frame(p))[0, -1] for p in parts]
    return parts[int(np.argsort(moved)[len(moved) // 2])]


def save(plan: Plan, curves: Sequence[Curve], shown: Sequence[Strip]) -> None:
    """Writes `prediction.csv`, with every horizon, and the two pictures."""
    with open(plan.folder / "prediction.csv", "w", newline="") as file:
        table = csv.writer(file)
        table.writerow(("robot", "prediction", "horizon", "error", "low", "high"))
        for c in curves:
            for horizon, values in enumerate(zip(c.error, c.low, c.high, strict=True)):
                table.writerow((c.robot, c.prediction, horizon, *(f"{v:.2f}" for v in values)))
    draw_curves(plan.folder / "prediction.png", curves, LEFT_OUT)
    draw_strips(plan.folder / "strips.png", shown)
