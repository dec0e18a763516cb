"""The table and the contact sheet of a dataset."""

import os
from collections import Counter, defaultdict
from types import SimpleNamespace

import numpy as np
from rich.markup import escape
from rich.table import Table

from wpt_agents.data.dataset import TrajectoryDataset
from wpt_agents.zoo.pictures.sheets import COLUMNS, cut, draw, finish, short
from wpt_agents.zoo.pictures.style import INK, MUTED, plt


def data_table(dataset: TrajectoryDataset) -> Table:
    """Return a table of the dataset's content: a row for each embodiment, and one for all."""
    table = Table("embodiment", "tasks", "trajectories", "transitions", "action\nwidth", "length")
    for name in ("with\nreward", "MiB on\ndisk", "bytes a\nframe", "of the\nraw size"):
        table.add_column(name, justify="right")
    groups: dict[str | None, list[int]] = defaultdict(list)
    for i, robot in enumerate(dataset.embodiments):
        groups[robot].append(i)
    rows = {name or "unnamed": dataset.subset(ids) for name, ids in groups.items()}
    for name, part in rows.items():
        table.add_row(escape(name), *_row(part))
    table.add_section()
    table.add_row("all", *_row(dataset))
    return table


def _row(part: TrajectoryDataset) -> list[str]:
    info = SimpleNamespace(**part.info())
    lengths = part.lengths
    span = f"{lengths.min()} to {lengths.max()}" if len(part) else "none"
    return [
        str(len({task for task in part.tasks if task is not None})),
        f"{len(part):,}",
        f"{info.transitions:,}",
        ", ".join(str(width) for width in sorted(info.action_dims)),
        str(lengths[0]) if len(part) and lengths.min() == lengths.max() else span,
        f"{info.with_reward:,}",
        f"{info.bytes / 2**20:,.1f}",
        f"{info.bytes_per_image:,.0f}",
        f"{100 / max(info.compression, 1e-9):.1f} %",
    ]


def spread(dataset: TrajectoryDataset, number: int) -> list[int]:
    """Return indices of some trajectories, of as many embodiments and tasks as possible."""
    groups: dict[tuple[str, str], list[int]] = defaultdict(list)
    for i, (robot, task) in enumerate(zip(dataset.embodiments, dataset.tasks, strict=True)):
        groups[robot or "", task or ""].append(i)
    number = min(number, len(dataset))
    if number <= len(groups):
        places = np.linspace(0, len(groups) - 1, number).round().astype(int)
        return [list(groups.values())[i][0] for i in places]
    turns = sorted((turn, at) for at, ids in enumerate(groups.values()) for turn in range(len(ids)))
    quota = Counter(at for _, at in turns[:number])
    chosen = []
    for at, ids in enumerate(groups.values()):
        chosen += [ids[int(i)] for i in np.linspace(0, len(ids) - 1, quota[at]).round()]
    return chosen


def contact_sheet(path: str | os.PathLike[str], dataset: TrajectoryDataset, rows: int = 12) -> None:
    """Draw some trajectories, one per row, from the first image to the last."""
    chosen = spread(dataset, rows)
    figure, axes = plt.subplots(
        len(chosen), COLUMNS, figsize=(COLUMNS * 1.1 + 2.4, len(chosen) * 1.12 + 0.5), squeeze=False
    )
    for row, i in zip(axes, chosen, strict=True):
        trajectory = dataset[i]
        steps = np.linspace(0, len(trajectory), COLUMNS).round().astype(int)
        for axis, step in zip(row, steps, strict=True):
            draw(axis, trajectory.image[step])
            axis.set_title(f"image {step}", fontsize=6, color=MUTED, pad=2)
        labels = [short(trajectory.task), trajectory.embodiment, trajectory.source]
        text = "\n".join([f"#{i}", *(cut(part) for part in labels if part)])
        row[0].text(-0.12, 0.5, text, fontsize=7, color=INK, ha="right", va="center",
                    transform=row[0].transAxes)  # fmt: skip
    finish(figure, path, f"{len(chosen)} of {len(dataset):,} trajectories in {dataset.path}")
