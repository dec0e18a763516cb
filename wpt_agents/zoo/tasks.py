"""From what a user types to rows of the task table."""

from collections.abc import Collection, Sequence
from fnmatch import fnmatchcase

from wpt_envs import tasks as table
from wpt_envs.tasks import Task

from wpt_agents.files.names import unknown_name
from wpt_agents.zoo.result import Metric


def find_tasks(suite: str, patterns: Sequence[str]) -> list[Task]:
    """The tasks of a suite that match: 'walker-run', 'dmc-walker-run', or a pattern, 'walker-*'.

    No pattern: the paper's tasks of the suite, or all of them if the paper has none. A prefix may
    name another suite, 'dmc-walker-run'.
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
                f"{name} is of the suite {elsewhere[0]}: write {elsewhere[0]}-{name}, or --suite "
                f"{elsewhere[0]} where there is such an option"
            )
        if not matching:
            raise unknown_name(f"task in suite {where!r} called", name, rows)
        matches |= matching
    return list(matches.values())


def short_name(task: Task) -> str:
    """'dmc-walker-run', as folders and tables call it."""
    return f"{task.suite}-{task.name}"


def name_in_data(task: Task, names: Collection[str | None]) -> str | None:
    """Return the name that data have for a task, or None if they have none.

    Data that were collected have its id. The authors' data of Meta-World have its name alone.

    :param names: the tasks of the data
    """
    known = (task.id, short_name(task), task.name)
    return next((name for name in known if name in names), None)


def metric_of(task: Task) -> Metric:
    """Return what the task counts, typed."""
    assert task.metric in ("return", "success"), task
    return "success" if task.metric == "success" else "return"
