"""Estimates of the time and the disk space that a plan needs, before it begins."""

import shutil
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from wpt_agents.files.names import counted
from wpt_agents.model.sizes import SIZES, Size, find_size
from wpt_agents.zoo.plan.runs import Run
from wpt_agents.zoo.result import read_result
from wpt_agents.zoo.results import find_every
from wpt_agents.zoo.sequence_result import read_row

STORED_STEP = 2_500  # bytes of an image in the dataset, which uses lossless compression
RAW_STEP = 12_288  # bytes of an image in the replay
PARAMETERS = {"debug": 0.2e6, "tiny": 0.8e6, "small": 3e6, "mid": 6e6, "medium": 18e6}
PARAMETERS |= {"none": 6e6}  # for agents without sizes: DrQ-v2 as published
LARGEST = 300e6  # parameters of the size "paper"
WIDTHS = ("deter", "hidden", "stoch", "classes", "depth", "units")  # fields of `Size`
WEIGHT = 12  # bytes per parameter in a model file: its value and the optimiser's two averages


def is_finished(job: Run) -> bool:
    """Return whether a run, or a task of a sequence, has its scores."""
    return read_result(job.folder) is not None or read_row(job.folder) is not None


def disk_needed(jobs: Sequence[Run]) -> int:
    """Return the bytes that the unfinished runs will write, the dataset included."""
    left = [job for job in jobs if not is_finished(job)]
    data = {job.shared.data_path: job.shared for job in left if job.algorithm.needs_data}
    total = 0
    for shared in data.values():
        steps = 1000 // shared.preset.env.action_repeat  # assumes the longest episodes
        total += shared.missing * steps * STORED_STEP
    models = [model_bytes(job) for job in left]
    replay = max((job.preset.steps * RAW_STEP for job in left), default=0)
    checkpoints = 2 * max(models, default=0)  # only the current run has them
    return total + 2 * sum(models) + checkpoints + replay  # each run keeps its last and best model


def model_bytes(job: Run) -> int:
    """Return the approximate size of a run's model file."""
    return int(parameters(job.full_keywords.get("size", "none")) * WEIGHT)


def parameters(size: str | Size | Mapping[str, Any]) -> float:
    """Return about how many parameters networks of this size have.

    For widths of one's own, it is the number of the next larger size that has a name.
    """
    if isinstance(size, str):
        return PARAMETERS.get(size, LARGEST)
    widths = [getattr(find_size(size), name) for name in WIDTHS]
    larger = [
        PARAMETERS[name]
        for name, known in SIZES.items()
        if name in PARAMETERS
        and all(getattr(known, w) >= width for w, width in zip(WIDTHS, widths, strict=True))
    ]
    return min(larger, default=LARGEST)


def check_space(jobs: Sequence[Run]) -> None:
    """Raise an error if the disk has too little space for the plan."""
    folder = jobs[0].out.resolve()
    while not folder.exists():
        folder = folder.parent
    free = shutil.disk_usage(folder).free
    needed = disk_needed(jobs)
    if free < needed:
        raise ValueError(
            f"{folder} has {gigabytes(free)} free and these runs need about {gigabytes(needed)}: "
            "make room, use another --out, or use a smaller preset"
        )


def hours_needed(left: Sequence[Run], like: Run) -> float | None:
    """Estimate the hours that the runs will take from finished runs of the same preset.

    :return: the hours, None if no run of the preset is finished
    """
    folder = like.out / like.preset_name
    known = find_every(folder).values()  # a copy of a run took as long
    paces = [sum(result.seconds.values()) / result.frames for result in known]
    frames = sum(job.preset.learn.frames for job in left)
    return float(np.mean(paces)) * frames / 3600 if paces else None


def gigabytes(size: int) -> str:
    """Format a number of bytes as '2.5 GB'."""
    return f"{size / 1e9:.1f} GB" if size >= 1e8 else f"{size / 1e6:.0f} MB"


def summary(jobs: Sequence[Run], force: bool = False) -> str:
    """Summarise a plan in one line; with `force`, finished runs are repeated."""
    left = [job for job in jobs if force or not is_finished(job)]
    hours = hours_needed(left, jobs[0])
    time = (
        "time unknown until one of this preset is finished"
        if hours is None
        else f"{hours:.1f} hours"
    )
    updates = sum(job.updates or 0 for job in left)
    return (
        f"{len(left)} of {counted(len(jobs), 'run')} to do, {counted(updates, 'update')}; "
        f"one after the other: {time}; disk: about {gigabytes(disk_needed(jobs))}"
    )
