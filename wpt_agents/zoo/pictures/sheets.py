"""A look at the data: table and contact sheet of a dataset, and a sheet of what is retrieved."""

import os
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from rich.table import Table
from wpt_envs.tasks import Task

from wpt_agents.agents.wpt import WPT
from wpt_agents.data.dataset import TrajectoryDataset
from wpt_agents.zoo.pictures.pictures import COLOURS, INK, MUTED, plt

COLUMNS = 8  # images in a row of the contact sheet, and of a run's retrieval sheet


class Query(NamedTuple):
    """A first image to search for, and what is known of it."""

    name: str
    image: np.ndarray  # (64, 64, 3) uint8
    embodiment: str | None
    action_dim: int
    own: int | None = None  # its number in the dataset, if it is from there


class Found(NamedTuple):
    """A query and the trajectories that begin most like it, nearest first."""

    query: Query
    indices: np.ndarray  # (k,)
    distances: np.ndarray  # (k,)


def data_table(dataset: TrajectoryDataset) -> Table:
    """What the dataset holds, a row an embodiment and one of all."""
    table = Table("embodiment", "tasks", "trajectories", "transitions", "action\nwidth", "length")
    for name in ("with\nreward", "MiB on\ndisk", "bytes a\nframe", "of the\nraw size"):
        table.add_column(name, justify="right")
    groups: dict[str | None, list[int]] = defaultdict(list)
    for i, robot in enumerate(dataset.embodiments):
        groups[robot].append(i)
    rows = {name or "unnamed": dataset.subset(ids) for name, ids in groups.items()}
    for name, part in rows.items():
        table.add_row(name, *_row(part))
    table.add_section()
    table.add_row("all", *_row(dataset))
    return table


def _row(part: TrajectoryDataset) -> list[str]:
    info, lengths = part.info(), part.lengths
    span = f"{lengths.min()} to {lengths.max()}" if len(part) else "none"
    return [
        str(len({task for task in part.tasks if task is not None})),
        f"{len(part):,}",
        f"{info['transitions']:,}",
        ", ".join(str(width) for width in sorted(info["action_dims"])),
        str(lengths[0]) if len(part) and lengths.min() == lengths.max() else span,
        f"{info['with_reward']:,}",
        f"{info['bytes'] / 2**20:,.1f}",
        f"{info['bytes_per_image']:,.0f}",
        f"{100 / max(info['compression'], 1e-9):.1f} %",
    ]


def spread(dataset: TrajectoryDataset, number: int) -> list[int]:
    """The numbers of some trajectories, of as many embodiments and tasks as may be."""
    groups: dict[tuple[str, str], list[int]] = defaultdict(list)
    for i, (robot, task) in enumerate(zip(dataset.embodiments, dataset.tasks, strict=True)):
        groups[robot or "", task or ""].append(i)
    number = min(number, len(dataset))
    if number <= len(groups):
        places = np.linspace(0, len(groups) - 1, number).round().astype(int)
        return [list(groups.values())[i][0] for i in places]
    turns = sorted((turn, at) for at, ids in enumerate(groups.values()) for turn in range(len(ids)))
    wanted = Counter(at for _, at in turns[:number])
    chosen = []
    for at, ids in enumerate(groups.values()):
        chosen += [ids[int(i)] for i in np.linspace(0, len(ids) - 1, wanted[at]).round()]
    return chosen


def contact_sheet(path: str | os.PathLike[str], dataset: TrajectoryDataset, rows: int = 12) -> None:
    """Draws some trajectories, a row each, from the first image to the last."""
    chosen = spread(dataset, rows)
    figure, axes = plt.subplots(
        len(chosen), COLUMNS, figsize=(COLUMNS * 1.1 + 2.4, len(chosen) * 1.12 + 0.5), squeeze=False
    )
    for row, i in zip(axes, chosen, strict=True):
        trajectory = dataset[i]
        steps = np.linspace(0, len(trajectory), COLUMNS).round().astype(int)
        for axis, step in zip(row, steps, strict=True):
            _draw(axis, trajectory.image[step])
            axis.set_title(f"image {step}", fontsize=6, color=MUTED, pad=2)
        about = [_short(trajectory.task), trajectory.embodiment, trajectory.source]
        text = "\n".join([f"#{i}", *(_cut(part) for part in about if part)])
        row[0].text(-0.12, 0.5, text, fontsize=7, color=INK, ha="right", va="center",
                    transform=row[0].transAxes)  # fmt: skip
    _finish(figure, path, f"{len(chosen)} of {len(dataset):,} trajectories in {dataset.path}")


def query_of(dataset: TrajectoryDataset, i: int) -> Query:
    """The first image of trajectory `i`."""
    if not 0 <= i < len(dataset):
        raise ValueError(f"No trajectory {i}: {dataset.path} holds {len(dataset)}, from 0 on")
    trajectory = dataset[i]
    name = f"#{i}\n{_kind(trajectory.task, trajectory.embodiment)}"
    return Query(name, trajectory.image[0], trajectory.embodiment, trajectory.action_dim, i)


def query_at(task: Task, env: Mapping[str, Any], seed: int = 0) -> Query:
    """The first image of a task, as fine-tuning by this seed searches for it.

    :param env: keyword arguments of `gymnasium.make`
    """
    with closing(gym.make(task.id, **env)) as made:
        image, _ = made.reset(seed=seed)
    return Query(f"first image of\n{_cut(task.name, 18)}", image, task.embodiment, task.action_dim)


def search(model: WPT, query: Query, number: int, own_robot: bool) -> Found:
    """The nearest by Eq. (5), the query's own trajectory left out.

    :param own_robot: only what `WPT.learn` would retrieve, by robot and action width
    """
    assert model.dataset is not None
    robot = query.embodiment if query.embodiment in model.dataset.embodiments else None
    known = (robot, query.action_dim) if own_robot else (None, None)
    feature = model.policy.embed(query.image[None])[0]
    indices, distances = model.build_index().search(feature, number + 1, *known)
    others = indices != (-1 if query.own is None else query.own)
    return Found(query, indices[others][:number], distances[others][:number])


def retrieval_sheet(
    path: str | os.PathLike[str], dataset: TrajectoryDataset, found: Sequence[Found]
) -> None:
    """Draws each query beside the first images of what was found, its own robot's framed blue."""
    columns = max(len(each.indices) for each in found) + 1
    figure, axes = plt.subplots(
        len(found), columns, figsize=(columns * 1.25, len(found) * 1.62 + 0.5), squeeze=False
    )
    for row, (query, indices, distances) in zip(axes, found, strict=True):
        _draw(row[0], query.image, INK, 2.5)
        row[0].set_title(query.name, fontsize=7, color=INK, fontweight="bold", pad=3)
        for axis in row[1 + len(indices) :]:
            axis.axis("off")
        for axis, i, distance in zip(row[1:], indices, distances, strict=False):
            robot, task = dataset.embodiments[i], dataset.tasks[i]
            same = query.embodiment is not None and robot == query.embodiment
            first = next(dataset.subset([i]).first_observations())[0]
            _draw(axis, first, COLOURS["WPT"] if same else COLOURS["prior actor"], 2)
            axis.set_title(
                f"#{i}  d {distance:.3g}\n{_kind(task, robot)}", fontsize=6.5, color=INK, pad=3
            )
    robots = "blue: the query's own robot, orange: another"
    _finish(figure, path, f"First images and the nearest in {dataset.path.name} ({robots})")


def sheet_of_run(path: Path, model: WPT, task: Task, env: Mapping[str, Any], seed: int) -> None:
    """Draws what a run begins by retrieving, and below it the nearest of all robots."""
    assert model.dataset is not None
    query = query_at(task, env, seed)
    rows = {"retrieved for\n": True, "nearest of all\n": False}
    found = [
        search(model, query._replace(name=f"{name}{_cut(task.name, 18)}"), COLUMNS, own_robot)
        for name, own_robot in rows.items()
    ]
    retrieval_sheet(path, model.dataset, found)


def _draw(axis: plt.Axes, image: np.ndarray, colour: str = MUTED, width: float = 0.5) -> None:
    axis.imshow(image)
    axis.set(xticks=[], yticks=[])
    axis.spines[:].set(color=colour, linewidth=width)


def _finish(figure: plt.Figure, path: str | os.PathLike[str], title: str) -> None:
    figure.suptitle(title, fontsize=9, color=INK)
    figure.tight_layout(rect=(0, 0, 1, 1 - 0.2 / figure.get_figheight()), pad=0.4)
    figure.savefig(path, dpi=130, bbox_inches="tight")
    plt.close(figure)


def _short(task: str | None) -> str | None:
    return task.removeprefix("wpt/").removesuffix("-v0") if task else None


def _kind(task: str | None, embodiment: str | None) -> str:
    """The task without its suite, or the robot, in a few letters."""
    suite, _, name = (_short(task) or "").partition("-")
    return _cut(name or suite or embodiment or "", 18)


def _cut(text: str, width: int = 30) -> str:
    return text if len(text) <= width else f"{text[: width - 1]}…"
