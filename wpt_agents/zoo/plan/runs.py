"""Runs as data, and their creation and validation from the options of a command."""

import shlex
import sys
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from wpt_envs.tasks import Task

from wpt_agents.agents.base import PixelAgent
from wpt_agents.agents.wpt import WPT
from wpt_agents.training.hyperparameters import Hyperparameters
from wpt_agents.zoo.plan.checks import action_widths, check_preset, too_wide
from wpt_agents.zoo.plan.effects import check_changes, check_effects, check_given_model
from wpt_agents.zoo.plan.methods import Method, defaults, find_method
from wpt_agents.zoo.plan.presets import Preset, load_preset
from wpt_agents.zoo.plan.request import Request
from wpt_agents.zoo.plan.shared import Shared
from wpt_agents.zoo.result import Change, Variant
from wpt_agents.zoo.tasks import find_tasks, short_name

LARGEST_SEED = 2**32 - 1  # of NumPy's older generators, which SB3 seeds
EVALUATION = 1  # separates the seeds of evaluation from those of training


def this_command() -> str:
    """Return the command that this process was started with."""
    return shlex.join([sys.executable, *sys.orig_argv[1:]])


@dataclass(frozen=True)
class Run:
    """One run: a task, a method and a seed with the settings of a preset.

    :param changes: of the preset, without those that a later one overrules
    :param data: the user's own dataset, None for the preset's
    :param data_name: `data` as the user wrote it; `data` itself may be absolute
    :param command: the user's command, regardless of the process that executes the run
    :param sequence: the name of the sequence of tasks that the run belongs to, or empty
    :param record: the CSV file to which the scores are added when the run is finished
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
    changes: tuple[Change, ...] = ()
    data_name: str = ""
    command: str = field(default_factory=this_command, compare=False)
    sequence: str = ""
    record: Path | None = field(default=None, compare=False)

    def __post_init__(self) -> None:
        find_method(self.method)

    @property
    def algorithm(self) -> Method:
        """The method: agent, keywords, and what it needs."""
        return find_method(self.method)

    @property
    def variant(self) -> Variant:
        """The preset with its changes, except the budget."""
        changes = tuple(sorted(c for c in self.changes if c.key != "learn.frames"))
        data = self.data_name or str(self.data) if self.data is not None else None
        return Variant(self.preset_name, changes, data)

    @property
    def folder(self) -> Path:
        """out/preset/method/task_seed, the layout that RL Zoo's plots expect.

        A task of a sequence is in out/preset/method/sequence_seed/task.
        """
        folder = self.out / self.preset_name / self.method
        if self.sequence:
            return folder / f"{self.sequence}_{self.seed}" / short_name(self.task)
        return folder / f"{short_name(self.task)}_{self.seed}"

    @property
    def title(self) -> str:
        """The run's heading: task, method and seed."""
        return f"{short_name(self.task)}, {self.method}, seed {self.seed}"

    @property
    def shared(self) -> Shared:
        """The stages that this run shares with others."""
        cache = self.out / "cache"
        agent = self.algorithm.agent
        return Shared(
            self.preset, self.task.suite, cache, self.workers, self.device, self.data, agent=agent
        )

    @property
    def keywords(self) -> dict[str, Any]:
        """The keywords of the agent, including the method's own."""
        plus = self.preset.plus if self.algorithm.plus else {}
        specific = self.preset.of_agent(self.algorithm.agent)
        return self.algorithm.settings({**self.preset.wpt, **plus}, specific)

    @property
    def full_keywords(self) -> Mapping[str, Any]:
        """The keywords of the agent, with defaults (or those of its size) for the ones not set."""
        agent = self.algorithm.agent
        values = {**defaults(agent), **self.keywords}
        if issubclass(agent, PixelAgent):
            values |= agent.keywords(**self.keywords).resolved().as_dict()
        return values

    @property
    def retrieves(self) -> bool:
        """True if the run needs trajectories of the task's robot from the dataset."""
        if not self.algorithm.needs_data or not issubclass(self.algorithm.agent, WPT):
            return self.algorithm.needs_data
        values = self.full_keywords
        names = ("guidance", "kickstart", "ibrl", "residual", "offline_ratio", "adapt_steps")
        return Hyperparameters.of({name: values[name] for name in names}).retrieves

    @property
    def updates(self) -> int | None:
        """The approximate number of updates of fine-tuning; None if unknown."""
        agent = SimpleNamespace(**self.full_keywords)
        if hasattr(agent, "update_every"):
            paying = max(self.preset.steps - int(agent.learning_starts), 0)
            return paying // int(agent.update_every)
        if not issubclass(self.algorithm.agent, WPT):
            return None
        if self.preset.steps < agent.learning_starts:
            return 0
        per_step = agent.train_ratio / (agent.batch_size * agent.batch_length)
        # What the steps before `learning_starts` have earned counts towards the head start.
        more = max(agent.actor_delay - agent.learning_starts * per_step, 0)
        return int(self.preset.steps * per_step + more)

    @property
    def evaluation_seed(self) -> int:
        """The seed of the evaluation episodes; below 2**31, as some simulators require."""
        state = np.random.SeedSequence([self.seed, EVALUATION]).generate_state(1)
        return int(state[0] >> 1)

    def config(self) -> dict[str, Any]:
        """Return the resolved configuration, the content of `config.yaml`."""
        names = {"suite": self.task.suite, "task": self.task.id, "method": self.method}
        data = {"data": self.shared.data_source} if self.data is not None else {}
        sections = self.preset.as_dict()
        del sections["wpt"]
        specific = {self.algorithm.section: self.keywords}
        return {
            **names,
            "seed": self.seed,
            "preset": self.preset_name,
            **data,
            **sections,
            **specific,
        }


def parse_seeds(text: str) -> list[int]:
    """Read '3' as 0, 1, 2; '0,5' as 0 and 5; '2-4' as 2, 3, 4."""
    try:
        if text.strip().isdigit():
            seeds = list(range(int(text)))
        else:
            parts = [part.partition("-") for part in text.split(",")]
            ranges = [range(int(a), int(b if dash else a) + 1) for a, dash, b in parts]
            seeds = [seed for part in ranges for seed in part] if all(ranges) else []
    except ValueError:
        seeds = []
    if not seeds:
        raise ValueError(f"--seeds {text!r}: write how many ('3'), which ('0,5') or '0-2'.")
    if max(seeds) > LARGEST_SEED:
        raise ValueError(f"--seeds {text!r}: a seed is at most {LARGEST_SEED}, take smaller ones")
    return list(dict.fromkeys(seeds))


def make_plan(
    suite: str,
    tasks: Sequence[str],
    request: Request,
    sections: Sequence[Mapping[str, Mapping[str, Any]]] = (),
) -> list[Run]:
    """Return one run for each task, method and seed.

    :param sections: changes to the preset, applied before those of `request.settings`
    :raises ValueError: if a name or setting is invalid
    """
    rows = find_tasks(suite, tasks)
    preset = load_preset(suite, request.preset, request.settings, sections)
    for row in rows:
        if row.suite != suite:
            raise ValueError(f"{short_name(row)} is of the suite {row.suite}: --suite {row.suite}")
    check_preset(preset)
    changes = effective_changes(request.settings)
    methods = list(dict.fromkeys(request.methods))
    for method in methods:
        check_changes(method, changes)
    check_effects(changes, methods, preset, request.data)
    check_given_model(preset, methods)
    runs = [
        Run(
            task=row,
            seed=seed,
            method=method,
            preset_name=request.preset,
            preset=preset,
            out=request.out,
            workers=request.workers,
            device=request.device,
            data=request.data,
            changes=changes,
            data_name=str(request.data or ""),
        )
        for row in rows
        for method in methods
        for seed in parse_seeds(request.seeds)
    ]
    widths = action_widths(suite, preset, request.data)
    for run in runs:
        check_width(run, widths)
    return runs


def effective_changes(settings: Sequence[str]) -> tuple[Change, ...]:
    """Return the settings that no later one overrules.

    A keyword of WPT also overrules the same keyword of the section `plus` before it.
    """
    changes: dict[str, Change] = {}
    for change in (Change.parse(text).short for text in settings):
        changes.pop(f"plus.{change.key}", None)
        changes[change.key] = change
    return tuple(changes.values())


def check_width(run: Run, widths: Collection[int]) -> None:
    """Raise an error for a task that does not fit the model or whose robot is not in the data.

    :param widths: the numbers of actions that occur in the data
    """
    needed = run.task.action_dim
    if run.algorithm.needs_data and not widths:
        raise ValueError(
            f"--data {run.data} holds no trajectories: collect or import some into it, or use "
            "other --data"
        )
    if run.retrieves and needed not in widths:
        add = "" if run.data is not None else "add such a task to collect.tasks (--set), "
        raise ValueError(
            f"{short_name(run.task)} has {needed} actions, and nothing in the data has as many "
            f"({', '.join(map(str, sorted(widths)))}): use other --tasks, {add}use --data that has "
            "one, or use --method scratch or pretrain-only"
        )
    limit = run.full_keywords.get("max_action_dim")
    widest = max(needed, *widths) if run.algorithm.needs_data else needed
    if limit is not None and widest > limit:
        whose = f"{short_name(run.task)} has" if needed == widest else "The data have"
        starts = run.algorithm.pretrained and run.shared.given_model
        raise too_wide(whose, widest, limit, " pretrain.model=" if starts else "")
