"""The typed result of a run; only this module reads and writes `result.json`.

Example::

    result = read_result(Path("runs/demo/wpt/metaworld-drawer-close_0"))
    result.final.mean, result.scores["prior actor"].success_rate, result.command
"""

import shlex
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import total_ordering
from pathlib import Path
from typing import Any, Literal, Self

import numpy as np

from wpt_agents.zoo.statistics import mean_interval
from wpt_agents.zoo.text_files import read_json, write_json

FILE = "result.json"

# The policies that a run may score, in the order in which tables show them.
NOTHING = "nothing"  # the zero action
RANDOM = "random"  # uniform actions
PRIOR_ACTOR = "prior actor"  # the policy that imitates the retrieved trajectories
HEAD_START = "after head start"  # the agent when the head start of fine-tuning ended
IMITATION = "imitating actor"  # its actor alone, if the prior actor takes part in acting, too
LAST = "last"  # the agent at the end of fine-tuning
BEST = "best"  # the best agent of the evaluations during fine-tuning
POLICIES = (NOTHING, RANDOM, PRIOR_ACTOR, HEAD_START, IMITATION, LAST, BEST)
UNTRAINED = (NOTHING, RANDOM)

Metric = Literal["return", "success"]


def final_policy(policies: Collection[str]) -> str:
    """Return the policy that counts for a run: the best one if it was kept, else the last."""
    return BEST if BEST in policies else LAST


@dataclass(frozen=True, order=True)
class Change:
    """One setting that differs from its preset, as in `--set key=value`."""

    key: str
    value: str

    @classmethod
    def parse(cls, text: str) -> Self:
        """Read "key=value"."""
        key, _, value = text.partition("=")
        return cls(key.strip(), value)

    @property
    def short(self) -> Self:
        """The same change with the shortest name of its key: WPT's keywords need no section."""
        return type(self)(self.key.removeprefix("wpt."), self.value.strip())

    def __str__(self) -> str:
        return f"{self.key}={self.value}"


@total_ordering
@dataclass(frozen=True)
class Variant:
    """A preset, the settings that differ from it, and the user's own data, if any.

    `str(variant)` is the name that tables and records show: "tiny size=debug data=mine".

    :param changes: sorted by key; the budget (`learn.frames`) is not among them
    :param data: the dataset's path as the user typed it, None for the preset's own data
    """

    preset: str
    changes: tuple[Change, ...] = ()
    data: str | None = None

    @classmethod
    def parse(cls, text: str) -> Self:
        """Parse `str(variant)`, from CSV cells and the result files of version 0.1.

        Keys are shortened as in later versions: "wpt.gamma" is "gamma".
        """
        preset, *words = shlex.split(text)
        changes = tuple(
            sorted(Change.parse(word).short for word in words if not word.startswith("data="))
        )
        data = [word.removeprefix("data=") for word in words if word.startswith("data=")]
        return cls(preset, changes, data[0] if data else None)

    @property
    def words(self) -> list[str]:
        """Return the words of `str(variant)`, before quoting."""
        data = [] if self.data is None else [f"data={self.data}"]
        return [self.preset, *map(str, self.changes), *data]

    def __str__(self) -> str:
        return shlex.join(self.words)

    def __lt__(self, other: Self) -> bool:
        return str(self) < str(other)

    @property
    def playing(self) -> Self:
        """The preset with the changes that affect untrained policies: env and evaluation."""
        changes = tuple(c for c in self.changes if c.key.startswith(("env.", "evaluate.")))
        return type(self)(self.preset, changes)


@dataclass(frozen=True)
class Score:
    """The returns of one policy over seeded episodes.

    :param successes: whether each episode ended in success; empty if the task reports none
    :param successes_any: whether each episode had success at any step; empty in earlier files, too
    """

    returns: tuple[float, ...]
    successes: tuple[bool, ...] = ()
    successes_any: tuple[bool, ...] = ()

    @classmethod
    def of(cls, stored: Mapping[str, Any]) -> Self:
        """Read a score from a JSON object; values that follow from the episodes are not read."""
        successes_any = tuple(stored.get("successes_any", ()))
        return cls(tuple(stored["returns"]), tuple(stored["successes"]), successes_any)

    @property
    def mean(self) -> float:
        """The mean return."""
        return self.interval[0]

    @property
    def interval(self) -> tuple[float, float | None, float | None]:
        """The mean return and its 95 % interval over episodes by Student's t."""
        return mean_interval(self.returns)

    @property
    def success_rate(self) -> float | None:
        """The share of successful episodes, None if the task reports none."""
        return float(np.mean(self.successes)) if self.successes else None

    @property
    def success_rate_any(self) -> float | None:
        """The share of episodes with success at any step, None if that is unknown."""
        return float(np.mean(self.successes_any)) if self.successes_any else None

    def counted(self, metric: Metric) -> float:
        """Return the score's value by a metric: its success rate, or its mean return."""
        if metric == "return":
            return self.mean
        assert self.success_rate is not None, "a task of metric 'success' reports successes"
        return self.success_rate


@dataclass(frozen=True)
class Result:
    """The result of a finished run.

    :param steps: calls of `env.step` in fine-tuning; `frames` counts simulator frames
    :param scores: by policy, see `POLICIES`
    :param seconds: wall-clock seconds of each stage
    :param commit: commit of the code, None outside a checkout; of a resumed run, those of all its
        processes: "COMMIT, COMMIT"
    :param updates: gradient updates of fine-tuning, None if the agent does not count them
    :param cpu_seconds: processor seconds of the learning process, None in results of version 0.1
    :param model: the first digits of the SHA-256 of the final model file
    :param pretrained: the same for the pre-trained model as the run began, None if there is none
    """

    suite: str
    task: str
    method: str
    variant: Variant
    seed: int
    frames: int
    steps: int
    metric: Metric
    scores: Mapping[str, Score]
    seconds: Mapping[str, float] = field(default_factory=dict)
    commit: str | None = None
    updates: int | None = None
    cpu_seconds: float | None = None
    model: str | None = None
    pretrained: str | None = None

    @property
    def final_policy(self) -> str:
        """The policy that counts for the run."""
        return final_policy(self.scores)

    @property
    def final(self) -> Score:
        """The score that counts for the run."""
        return self.scores[self.final_policy]

    def counted(self, policy: str | None = None) -> float:
        """Return a policy's success rate, or its mean return, depending on the metric.

        :param policy: the final one if None
        """
        return self.scores[policy or self.final_policy].counted(self.metric)

    @property
    def identity(self) -> tuple[str, str, Variant, int, int]:
        """The identity of the run: task, method, variant, budget and seed."""
        return self.task, self.method, self.variant, self.frames, self.seed

    @property
    def commit_name(self) -> str:
        """The commit as shown in tables."""
        return self.commit or "unknown"

    @property
    def command(self) -> str:
        """A command that repeats the run from any working directory."""
        task = ["--suite", self.suite, "--tasks", self.task]
        return run_command(task, self.method, self.variant, self.frames, self.seed)


def run_command(task: Sequence[str], method: str, variant: Variant, frames: int, seed: int) -> str:
    """Return the command that makes a run.

    :param task: the options that name its task, or its sequence of tasks
    """
    words = ["python", "-m", "wpt_agents.zoo", "run", *task]
    words += ["--method", method, "--preset", variant.preset]
    words += ["--frames", str(frames), "--seeds", f"{seed}-{seed}"]
    for change in variant.changes:
        words += ["--set", str(change)]
    if variant.data is not None:
        words += ["--data", variant.data]
    return shlex.join(words)


def read_result(folder: Path) -> Result | None:
    """Read the result of the run in `folder`; return None if the run is not finished.

    :raises ValueError: if the file is damaged
    """
    return read_json(folder / FILE, _from_json)


def write_result(folder: Path, result: Result) -> None:
    """Write the result of the run in `folder` atomically."""
    write_json(folder / FILE, _to_json(result))


def read_score(path: Path) -> Score | None:
    """Read the score in a separate file; return None if there is no such file.

    :raises ValueError: if the file is damaged
    """
    return read_json(path, Score.of)


def write_score(path: Path, score: Score) -> None:
    """Write one score to a separate file atomically."""
    write_json(path, _score_json(score))


def _to_json(result: Result) -> dict[str, Any]:
    fields = asdict(result)
    variant = fields.pop("variant")
    scores = {name: _score_json(score) for name, score in result.scores.items()}
    return {**fields, **variant, "scores": scores, "command": result.command}


def _score_json(score: Score) -> dict[str, Any]:
    """Include derived values, because other programs read these files."""
    mean, low, high = score.interval
    computed = {"mean": mean, "low": low, "high": high, "success_rate": score.success_rate}
    computed |= {"success_rate_any": score.success_rate_any}
    return {**asdict(score), **computed}


def _from_json(stored: dict[str, Any]) -> Result:
    """Build a result from a file of this version or of version 0.1.

    In version 0.1 "preset" was the whole name of the variant, and the policies "last" and "best"
    were called "WPT", or "WPT, last" and "WPT".
    """
    if "changes" in stored:
        changes = tuple(sorted(Change(**change).short for change in stored.pop("changes")))
        variant = Variant(stored.pop("preset"), changes, stored.pop("data"))
    else:
        variant = Variant.parse(stored.pop("preset"))
    scores = {name: Score.of(score) for name, score in stored.pop("scores").items()}
    names = {"WPT": LAST}
    if "WPT, last" in scores:
        names = {"WPT, last": LAST, "WPT": BEST}
    scores = {names.get(name, name): score for name, score in scores.items()}
    stored.pop("command", None)
    result = Result(variant=variant, scores=scores, **stored)
    if result.final_policy not in scores:
        raise KeyError(result.final_policy)
    for name, score in scores.items():
        if not score.returns or (result.metric == "success" and not score.successes):
            raise ValueError(f"the score of {name} lacks episodes")
    return result
