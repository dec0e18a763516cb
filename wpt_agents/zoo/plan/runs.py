"""From the words of a command to the runs that it asks for, all checked before any begins."""

import json
import shlex
import sys
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from wpt_envs.rendering import QUALITIES
from wpt_envs.tasks import Task

from wpt_agents.data.dataset import TrajectoryDataset
from wpt_agents.files.names import unknown_name
from wpt_agents.training.checks import check_hyperparameters
from wpt_agents.training.guidance import ever, parse_schedule
from wpt_agents.zoo.collect.collection import BEHAVIOURS
from wpt_agents.zoo.plan.methods import METHODS
from wpt_agents.zoo.plan.presets import Preset, load_preset, wpt_keywords
from wpt_agents.zoo.run.shared import Shared
from wpt_agents.zoo.tasks import find_tasks, short_name

EVALUATION = 1  # the purpose in a seed's derivation: evaluation never sees training's episodes


def this_command() -> str:
    """The command that this process was started with."""
    return shlex.join([sys.executable, *sys.orig_argv[1:]])


@dataclass(frozen=True)
class Run:
    """One run, fully told before it begins.

    :param changes: of the preset, each "key=value"
    :param data_name: how the data's folder was written; `data` itself may be made absolute
    :param command: what the user typed, whichever process does the run
    """

    task: Task
    seed: int
    method: str
    preset_name: str
    preset: Preset
    out: Path
    workers: int = 2
    device: str = "auto"
    data: Path | None = None
    changes: tuple[str, ...] = ()
    data_name: str = ""
    command: str = field(default_factory=this_command, compare=False)

    def __post_init__(self) -> None:
        if self.method not in METHODS:
            raise unknown_name("method", self.method, METHODS)

    @property
    def label(self) -> str:
        """The preset's name and what was changed of it, but for `frames`, which stand apart."""
        changes = [c for c in self.changes if not c.startswith("learn.frames=")]
        own_data = [f"data={self.data_name or self.data}"] if self.data is not None else []
        return shlex.join([self.preset_name, *sorted(changes), *own_data])

    @property
    def folder(self) -> Path:
        """out/preset/method/task_seed, the layout that RL Zoo's plots read."""
        name = f"{short_name(self.task)}_{self.seed}"
        return self.out / self.preset_name / self.method / name

    @property
    def shared(self) -> Shared:
        """The stages that this run shares with others."""
        cache = self.out / "cache"
        return Shared(self.preset, self.task.suite, cache, self.workers, self.device, self.data)

    @property
    def wpt(self) -> dict[str, Any]:
        """The keywords of WPT, the method's switches included."""
        return {**self.preset.wpt, **METHODS[self.method].wpt}

    @property
    def retrieves(self) -> bool:
        """Whether trajectories are retrieved, for rehearsal or for guidance."""
        wpt = wpt_keywords() | self.wpt
        clones = ever(parse_schedule(wpt["guidance"])) or ever(
            parse_schedule(wpt["kickstart"], np.inf)
        )
        return METHODS[self.method].needs_data and bool(wpt["offline_ratio"] or clones)

    @property
    def updates(self) -> int:
        """The fine-tuning updates that the run will make, within an episode's worth."""
        wpt = wpt_keywords() | self.wpt
        if self.preset.steps < wpt["learning_starts"]:
            return 0
        earned = self.preset.steps * wpt["train_ratio"] / (wpt["batch_size"] * wpt["batch_length"])
        return int(max(earned, wpt["actor_delay"]))

    @property
    def evaluation_seed(self) -> int:
        """Where evaluation's episodes start; below 2**31, as some simulators want."""
        state = np.random.SeedSequence([self.seed, EVALUATION]).generate_state(1)
        return int(state[0] >> 1)

    def config(self) -> dict[str, Any]:
        """The resolved configuration, as `config.yaml` holds it."""
        about = {"suite": self.task.suite, "task": self.task.id, "method": self.method}
        return {
            **about,
            "seed": self.seed,
            "preset": self.preset_name,
            **({"data": self.shared.data_source} if self.data is not None else {}),
            **self.preset.as_dict(),
            "wpt": self.wpt,
        }

    def result(self) -> dict[str, Any] | None:
        """What `result.json` holds, None while the run is not finished."""
        path = self.folder / "result.json"
        return json.loads(path.read_text()) if path.exists() else None


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
    data: Path | None = None,
) -> list[Run]:
    """One run for each task, method and seed; every name and setting is valid, or ValueError."""
    rows, resolved = find_tasks(suite, tasks), load_preset(suite, preset, settings)
    for row in rows:
        if row.suite != suite:
            raise ValueError(f"{short_name(row)} is of the suite {row.suite}: --suite {row.suite}")
    check_hyperparameters({**wpt_keywords(), **resolved.wpt})
    for name, value, known in (
        ("env.rendering", resolved.env.rendering, QUALITIES),
        ("collect.behaviour", resolved.collect.behaviour, set(BEHAVIOURS) - {"policy"}),
    ):
        if value not in known:
            raise unknown_name(name, value, known)
    collected = find_tasks(suite, resolved.collect.tasks)
    widths = {row.action_dim for row in collected}
    if data is not None:
        widths = set(TrajectoryDataset.open(data).action_dims)
    changes = tuple({setting.partition("=")[0]: setting for setting in settings}.values())
    for method in dict.fromkeys(methods):
        check_changes(method, changes)
    fixed = preset, resolved, out, workers, device, data, changes, str(data or "")
    jobs = [
        Run(row, seed, method, *fixed)
        for row in rows
        for method in dict.fromkeys(methods)
        for seed in parse_seeds(seeds)
    ]
    for job in jobs:
        check_width(job, widths)
    return jobs


def check_changes(method: str, changes: Sequence[str]) -> None:
    """Refuses a setting that the method itself sets, and so would overrule."""
    if method not in METHODS:
        raise unknown_name("method", method, METHODS)
    for change in changes:
        name, _, value = change.partition("=")
        if name.removeprefix("wpt.") in (own := METHODS[method].wpt):
            own_value = own[name.removeprefix("wpt.")]
            raise ValueError(
                f"--method {method} means {name}={own_value}, so --set {name}={value} would have "
                "no effect: leave it out, or take --method wpt"
            )


def check_width(job: Run, widths: Collection[int]) -> None:
    """Refuses a task that the model cannot act in, or whose robot the data do not show.

    :param widths: of the actions in the data
    """
    needed, wpt, method = job.task.action_dim, wpt_keywords() | job.wpt, METHODS[job.method]
    if job.retrieves and needed not in widths:
        raise ValueError(
            f"{short_name(job.task)} has {needed} actions, and nothing in the data has as many "
            f"({', '.join(map(str, sorted(widths)))}): name other --tasks, add such a task to "
            "collect.tasks (--set), give --data that hold it, or use --method scratch or "
            "pretrain-only"
        )
    widest = max(needed, *widths) if method.needs_data else needed
    if widest > wpt["max_action_dim"]:
        whose = f"{short_name(job.task)} has" if needed == widest else "The data have"
        raise ValueError(
            f"{whose} {widest} actions, the preset's max_action_dim is "
            f"{wpt['max_action_dim']}: --set max_action_dim={widest}"
        )
