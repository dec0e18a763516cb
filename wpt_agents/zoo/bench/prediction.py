"""Open-loop prediction errors of a generalist and of specialists on five robots.

Data, models, errors and pictures are kept in `runs/bench/prediction`.
"""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from shutil import copyfile
from typing import Any, NamedTuple

import numpy as np
import torch
import wpt_envs

from wpt_agents.agents.wpt import WPT
from wpt_agents.data.dataset import TrajectoryDataset
from wpt_agents.files.archive import replacing
from wpt_agents.zoo.collect.collection import collect
from wpt_agents.zoo.judge.prediction import (
    MeanFrame,
    Predict,
    compare,
    copy_last_frame,
    dream,
    windows,
)
from wpt_agents.zoo.judge.probes import probe as probes
from wpt_agents.zoo.plan.presets import keywords
from wpt_agents.zoo.plan.shared import key

FOLDER = Path("runs") / "bench" / "prediction"
DMC = ("walker-run", "cheetah-run", "cartpole-swingup", "quadruped-run")
METAWORLD = ("drawer-close", "door-open", "button-press-topdown", "window-open")
LOOK = {"rendering": "fast"}
LEFT_OUT = "walker"  # from the pre-training of one generalist


class Plan(NamedTuple):
    """The sizes of data and training."""

    folder: Path
    tasks: Sequence[str]
    behaviour: str
    episodes: int  # of each task, each with its own seed
    held_out: int  # the last ones, which are not used for training
    windows: int  # of each held-out trajectory
    updates: int
    further: int  # updates on the robot that was excluded
    model: Mapping[str, Any]


BATCH = {"max_action_dim": 12, "batch_size": 8, "batch_length": 16, "device": "cpu"}
FULL = Plan(
    folder=FOLDER,
    tasks=[f"wpt/dmc-{n}-v0" for n in DMC] + [f"wpt/metaworld-{n}-v0" for n in METAWORLD],
    behaviour="scripted",  # noise for tasks without a script
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


def rows(
    quick: bool = False,
    updates: int | None = None,
    probe: bool = False,
    settings: Sequence[str] = (),
    robots: Sequence[str] = (),
) -> Iterator[dict[str, Any]]:
    """Yield a row for each robot and way of predicting; draw `prediction.png` and `strips.png`.

    :param updates: of each world model, instead of the plan's; existing models are trained further
    :param probe: yield instead how well linear probes read the true state from the latents of the
        generalist and of each robot's specialist
    :param settings: keywords of WPT for the world models, as "key=value"
    :param robots: probe only these; the generalist is trained on all robots nevertheless
    :raises ValueError: for `robots` without `probe`, and for a robot that the data do not have
    """
    if robots and not probe:
        raise ValueError("--robot has no effect without --probe: leave it out, or pass both")
    plan = QUICK if quick else FULL
    if updates is not None:
        plan = plan._replace(updates=updates, further=min(plan.further, updates))
    known = [wpt_envs.TASKS[task].embodiment for task in plan.tasks]
    if unknown := sorted(set(robots) - set(known)):
        raise ValueError(
            f"The data have no robot {', '.join(unknown)}: choose from "
            f"{', '.join(dict.fromkeys(known))}"
        )
    torch.set_num_threads(1)
    stored = plan.folder / "data"  # of all settings
    plan = changed(plan, settings)
    data = collect(stored, plan.tasks, plan.episodes, workers=1, behaviour=plan.behaviour, env=LOOK)
    dataset, held_out = split(data, plan)
    if probe:
        yield from probes_of(plan, dataset, robots)
        return
    ways = predictors(plan, dataset)
    tests = {
        robot: [windows(t, plan.windows, plan.model["max_action_dim"]) for t in of(held_out, robot)]
        for robot in ways
    }
    shown = [(robot, robot, ["generalist", "specialist"]) for robot in ways]
    unseen = [name for name in ways[LEFT_OUT] if name.startswith("left out")]
    at = list(ways).index(LEFT_OUT) + 1
    shown.insert(at, (f"{LEFT_OUT}, left out", LEFT_OUT, unseen))
    yield from compare(ways, tests, plan.folder, shown, LEFT_OUT)


def changed(plan: Plan, settings: Sequence[str]) -> Plan:
    """Return the plan with other keywords of WPT, whose models have a folder of their own."""
    if not settings:
        return plan
    changes = keywords(settings)
    folder = plan.folder / f"set-{key(changes)}"
    return plan._replace(folder=folder, model={**plan.model, **changes})


def probes_of(
    plan: Plan, dataset: TrajectoryDataset, robots: Sequence[str] = ()
) -> Iterator[dict[str, Any]]:
    """Yield the probes of an untrained model, the generalist and the robot's specialist."""
    untrained = WPT("WPTPolicy", seed=0, **plan.model)
    generalist = train(plan, "generalist", dataset, plan.updates)
    for task in plan.tasks:
        robot = wpt_envs.TASKS[task].embodiment
        if robots and robot not in robots:
            continue
        specialist = train(plan, f"specialist-{robot}", of(dataset, robot), plan.updates)
        models = {"untrained": untrained, "generalist": generalist, "specialist": specialist}
        for name, model in models.items():
            for row in probes(model, [task], episodes=2 * plan.held_out):
                yield {"model": name, "updates": model.pretrain_steps, **row}


def split(data: TrajectoryDataset, plan: Plan) -> tuple[TrajectoryDataset, TrajectoryDataset]:
    """Return the training trajectories, and the held-out last episodes of each task."""
    late = np.arange(len(data)) % plan.episodes >= plan.episodes - plan.held_out
    return data.subset(np.flatnonzero(~late)), data.subset(np.flatnonzero(late))


def of(dataset: TrajectoryDataset, *robots: str) -> TrajectoryDataset:
    """Return the trajectories of these robots."""
    return dataset.subset(np.flatnonzero([name in robots for name in dataset.embodiments]))


def predictors(plan: Plan, dataset: TrajectoryDataset) -> dict[str, dict[str, Predict]]:
    """Return the models to compare by robot and name; train those that do not exist."""
    robots = list(dict.fromkeys(str(robot) for robot in dataset.embodiments))
    budget = f"{plan.further} updates"
    scratch = f"scratch-{plan.further}"
    from_scratch = train(plan, scratch, of(dataset, LEFT_OUT), plan.further)
    generalist = train(plan, "generalist", dataset, plan.updates)
    untrained = WPT("WPTPolicy", seed=0, **plan.model)
    by_robot: dict[str, dict[str, Predict]] = {}
    for robot in robots:
        trajectories = of(dataset, robot)
        start = scratch if robot == LEFT_OUT else None  # its first updates are the same
        specialist = train(plan, f"specialist-{robot}", trajectories, plan.updates, start)
        by_robot[robot] = {
            "generalist": dream(generalist),
            "specialist": dream(specialist),
            "untrained": dream(untrained),
            "copy last frame": copy_last_frame,
            "mean frame": MeanFrame(trajectories),
        }
    others = of(dataset, *(robot for robot in robots if robot != LEFT_OUT))
    zero_shot = train(plan, "left-out", others, plan.updates)
    adapted = train(
        plan, f"left-out-{plan.updates}-then", of(dataset, LEFT_OUT),
        plan.updates + plan.further, "left-out",
    )  # fmt: skip
    by_robot[LEFT_OUT] |= {
        "left out": dream(zero_shot),
        f"left out, then {budget}": dream(adapted),
        f"from scratch, {budget}": dream(from_scratch),
    }
    return by_robot


def train(
    plan: Plan, name: str, dataset: TrajectoryDataset, updates: int, start: str | None = None
) -> WPT:
    """Train a world model up to `updates` updates, or continue from the model `start`.

    :raises ValueError: if it has more updates already
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
            f"{file} has had {model.pretrain_steps} updates, not {updates}: pass as many, or "
            f"delete {plan.folder}"
        )
    return model
