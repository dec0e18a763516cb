"""Convert the task names that a user types to rows of the task table."""

from collections.abc import Collection, Sequence
from fnmatch import fnmatchcase

from wpt_envs import tasks as table
from wpt_envs.tasks import Task

from wpt_agents.files.names import unknown_name
from wpt_agents.zoo.result import Metric


def find_tasks(suite: str, patterns: Sequence[str]) -> list[Task]:
    """Return the matching tasks of a suite: 'walker-run', 'dmc-walker-run', or 'walker-*'.

    Without a pattern, these are the paper's tasks of the suite, or all if the paper has none. A
    prefix may name another suite, as in 'dmc-walker-run'.
    """
    if suite not in (suites := {row.suite for row in table.TASKS.values()}):
        raise unknown_name("suite", suite, suites)
    if not patterns:
        return table.suite(suite) or table.suite(suite, paper_only=False)
    matches: dict[str, Task] = {}
    for pattern in patterns:
        name = pattern.removeprefix("wpt/").removesuffix("-v0")
        where = next((s for s in suites if name.startswith(f"{s}-")), suite)
        name = name.removeprefix(f"{where}-")
        rows = {row.name: row for row in table.suite(where, paper_only=False)}
        matching = {row.id: row for n, row in rows.items() if fnmatchcase(n, name)}
        elsewhere = [
            s for s in suites if any(t.name == name for t in table.suite(s, paper_only=False))
        ]
        if not matching and elsewhere:
            raise ValueError(
                f"{name} is of the suite {elsewhere[0]}: pass --suite {elsewhere[0]}, or write "
                f"{elsewhere[0]}-{name} where there is no such option"
            )
        if not matching:
            raise unknown_name(f"task in suite {where!r} called", name, rows)
        matches |= matching
    return list(matches.values())


def short_name(task: Task) -> str:
    """Return the name in folders and tables, for example 'dmc-walker-run'."""
    return f"{task.suite}-{task.name}"


def name_in_data(task: Task, names: Collection[str | None]) -> str | None:
    """Return the name of a task in a dataset, None if the dataset does not contain it.

    Collected data use the task's id, the authors' Meta-World data only its name.

    :param names: the tasks of the dataset
    """
    known = (task.id, short_name(task), task.name)
    return next((name for name in known if name in names), None)


def metric_of(task: Task) -> Metric:
    """Return the task's metric, typed."""
    assert task.metric in ("return", "success"), task
    return "success" if task.metric == "success" else "return"
