"""Sequences of tasks that one agent learns in turn, as in Fig. 4 of the paper.

A sequence is a file of zoo/sequences: its suite, its tasks, and changes of the suite's presets.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from wpt_agents.files.names import unknown_name
from wpt_agents.zoo.plan.methods import METHODS, find_method
from wpt_agents.zoo.plan.presets import preset_folder, read_yaml
from wpt_agents.zoo.plan.request import Request
from wpt_agents.zoo.plan.runs import Run, make_plan


@dataclass(frozen=True)
class TaskSequence:
    """The content of zoo/sequences/<name>.yaml.

    :param default: changes to every preset, in the format of presets
    :param presets: further changes, by the presets' names
    """

    suite: str
    tasks: Sequence[str]
    default: Mapping[str, Mapping[str, Any]]
    presets: Mapping[str, Mapping[str, Mapping[str, Any]]]

    def changes(self, preset: str) -> list[Mapping[str, Mapping[str, Any]]]:
        """Return the changes to a preset, in order."""
        return [self.default, self.presets.get(preset, {})]


@dataclass(frozen=True)
class SequenceRun:
    """A method and a seed on the tasks of a sequence, each of which is a `Run`.

    :param name: of the sequence
    :param runs: one for each task, in the order of learning
    """

    name: str
    runs: Sequence[Run]

    @property
    def folder(self) -> Path:
        """The folder of all tasks, out/preset/method/name_seed."""
        return self.runs[0].folder.parent

    @property
    def title(self) -> str:
        """The heading: sequence, method and seed."""
        return f"sequence {self.name}, {self.runs[0].method}, seed {self.runs[0].seed}"

    def config(self) -> dict[str, Any]:
        """Return the resolved configuration, the content of `config.yaml`."""
        tasks = [run.task.id for run in self.runs]
        return self.runs[0].config() | {"task": self.name, "tasks": tasks}


def sequence_names() -> list[str]:
    """Return the names of all sequences."""
    return sorted(path.stem for path in (preset_folder() / "sequences").glob("*.yaml"))


def find_sequence(name: str) -> TaskSequence:
    """Return the sequence of this name.

    :raises ValueError: if there is none
    """
    if name not in sequence_names():
        raise unknown_name("sequence", name, sequence_names())
    return TaskSequence(
        **read_yaml((preset_folder() / "sequences" / f"{name}.yaml").read_text(encoding="utf-8"))
    )


def able_methods() -> list[str]:
    """Return the methods whose agents can continue with the next task of a sequence."""
    return [name for name, method in METHODS.items() if hasattr(method.agent, "next_task")]


def make_sequences(name: str, request: Request) -> list[SequenceRun]:
    """Return the sequence for each method and seed.

    :raises ValueError: if a name or setting is invalid, or the method learns only single tasks
    """
    sequence = find_sequence(name)
    for method in request.methods:
        if find_method(method) and method not in able_methods():
            raise ValueError(
                f"--method {method} learns single tasks; a sequence can be learned by "
                f"{', '.join(able_methods())}"
            )
    changes = [*sequence.changes(request.preset), {"packnet": {"tasks": len(sequence.tasks)}}]
    runs = make_plan(sequence.suite, sequence.tasks, request, changes)
    groups: dict[tuple[str, int], list[Run]] = {}
    for run in runs:
        groups.setdefault((run.method, run.seed), []).append(replace(run, sequence=name))
    return [SequenceRun(name, group) for group in groups.values()]
