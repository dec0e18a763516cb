"""How long a plan takes and how much room it needs, roughly, before it begins."""

import shutil
from collections.abc import Sequence

import numpy as np

from wpt_agents.files.names import counted
from wpt_agents.zoo.plan.methods import METHODS
from wpt_agents.zoo.plan.runs import Run
from wpt_agents.zoo.report.folders import read_results

STORED_STEP, RAW_STEP = 2_500, 12_288  # bytes of an image: in the dataset (lossless), in the replay
PARAMETERS = {"debug": 0.2e6, "tiny": 0.8e6, "small": 3e6, "medium": 18e6, "paper": 300e6}
WEIGHT = 12  # bytes a parameter in a model file: its value and the optimiser's two averages


def disk_needed(jobs: Sequence[Run]) -> int:
    """Bytes that the runs to be done will write, the dataset included."""
    left = [job for job in jobs if job.result() is None]
    data = {j.shared.data_path: j.shared for j in left if METHODS[j.method].needs_data}
    total = 0
    for path, shared in data.items():
        if not path.exists():
            episodes, rows = shared.preset.collect.episodes, len(shared.tasks)
            steps = 1000 // shared.preset.env.action_repeat  # the longest episodes
            total += episodes * rows * steps * STORED_STEP
    for job in left:
        model = int(PARAMETERS[job.wpt.get("size", "paper")] * WEIGHT)
        total += 2 * model  # the last and the best
    largest = max((PARAMETERS[j.wpt.get("size", "paper")] * WEIGHT for j in left), default=0)
    replay = max((job.preset.steps * RAW_STEP for job in left), default=0)
    return total + int(2 * largest) + replay  # of the run that is going on: two checkpoints


def check_space(jobs: Sequence[Run]) -> None:
    """Refuses a plan that the disk has no room for."""
    folder = jobs[0].out.resolve()
    while not folder.exists():
        folder = folder.parent
    free, needed = shutil.disk_usage(folder).free, disk_needed(jobs)
    if free < needed:
        raise ValueError(
            f"{folder} has {gigabytes(free)} free and these runs need about {gigabytes(needed)}: "
            "make room, use another --out, or take a smaller preset"
        )


def hours_needed(left: Sequence[Run], like: Run) -> float | None:
    """Hours for the runs `left`, from finished ones of a run's preset; None if there are none."""
    folder = like.out / like.preset_name
    paces = [
        sum(result["seconds"].values()) / result["frames"]
        for result in (read_results(folder) if folder.exists() else [])
    ]
    frames = sum(job.preset.learn.frames for job in left)
    return float(np.mean(paces)) * frames / 3600 if paces else None


def gigabytes(size: int) -> str:
    """'2.5 GB'."""
    return f"{size / 1e9:.1f} GB" if size >= 1e8 else f"{size / 1e6:.0f} MB"


def summary(jobs: Sequence[Run], force: bool = False) -> str:
    """One line for the end of a plan; with `force` finished runs are to do, too."""
    left = [job for job in jobs if force or job.result() is None]
    hours = hours_needed(left, jobs[0])
    time = (
        "time unknown until one of this preset is finished"
        if hours is None
        else f"{hours:.1f} hours"
    )
    updates = sum(job.updates for job in left)
    return (
        f"{len(left)} of {counted(len(jobs), 'run')} to do, {counted(updates, 'update')}; "
        f"one after the other: {time}; disk: about {gigabytes(disk_needed(jobs))}"
    )
