"""From the words of a command to the runs that it asks for, all checked before any begins."""

from collections.abc import Sequence
from pathlib import Path

from rich.table import Table

from wpt_agents.zoo.benchmark import METHODS, Run
from wpt_agents.zoo.presets import load_preset
from wpt_agents.zoo.stages import console
from wpt_agents.zoo.tasks import find_tasks, short_name


def parse_seeds(text: str) -> list[int]:
    """'3' is 0, 1, 2; '0,5' is 0 and 5; '2-4' is 2, 3, 4."""
    try:
        if text.strip().isdigit():
            seeds = list(range(int(text)))
        else:
            ends = [part.split("-") for part in text.split(",")]
            seeds = [s for e in ends for s in range(int(e[0]), int(e[-1]) + 1)]
    except ValueError:
        seeds = []
    if not seeds:
        raise ValueError(f"--seeds {text!r}: write how many ('3'), which ('0,5') or '0-2'.")
    return list(dict.fromkeys(seeds))


def make_plan(
    suite: str,
    tasks: Sequence[str],
    preset: str,
    seeds: str,
    methods: Sequence[str],
    settings: Sequence[str],
    out: Path,
    workers: int,
    device: str,
) -> list[Run]:
    """One run for each task, method and seed; every name and setting is valid, or ValueError."""
    rows, resolved = find_tasks(suite, tasks), load_preset(suite, preset, settings)
    find_tasks(suite, resolved.collect.tasks)
    return [
        Run(row, seed, method, preset, resolved, out, workers, device)
        for row in rows
        for method in methods
        for seed in parse_seeds(seeds)
    ]


def show_plan(jobs: Sequence[Run], force: bool) -> None:
    """Prints what would be done, and what is there already."""
    table = Table("task", "method", "seed", "env steps", "updates", "state", "folder")
    for job in jobs:
        state = "finished" if job.result() and not force else "to do"
        numbers = f"{job.preset.steps:,}", f"{job.updates:,}"
        names = short_name(job.task), job.method, str(job.seed)
        table.add_row(*names, *numbers, state, str(job.folder))
    console.print(table)
    shared = {job.shared.model_path: job.shared for job in jobs if METHODS[job.method].needs_data}
    for path, each in shared.items():
        episodes = each.preset.collect.episodes * len(each.tasks)
        state = "there" if each.data_path.exists() else f"{episodes} episodes to collect"
        console.print(f"dataset      {state}  [dim]{each.data_path}")
        done = (path / "done.json").exists()
        state = "there" if done else f"{each.preset.pretrain.steps:,} updates to make"
        console.print(f"world model  {state}  [dim]{path}")
