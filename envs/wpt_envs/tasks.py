"""The table of tasks: the only place for their names, embodiments, widths and lengths."""

import difflib
from dataclasses import dataclass

# DMControl: embodiment -> (width of its actions, paper's tasks, further tasks)
_DMC = {
    "cartpole": (
        1,
        ("balance",),
        ("balance-sparse", "swingup", "swingup-sparse", "two-poles", "three-poles"),
    ),
    "acrobot": (1, ("swingup", "swingup-sparse", "swingup-hard"), ()),
    "cheetah": (
        6,
        ("run", "run-backwards", "jump", "run-front", "run-back"),
        ("run-hard",),
    ),
    "walker": (
        6,
        ("stand", "walk", "run", "walk-backwards", "run-backwards", "backflip", "walk-hard"),
        (),
    ),
    "quadruped": (
        12,
        ("stand", "walk", "run", "jump", "roll", "roll-fast"),
        ("escape", "fetch"),
    ),
}

_METAWORLD = """
    assembly basketball bin-picking box-close button-press button-press-topdown
    button-press-topdown-wall button-press-wall coffee-button coffee-pull coffee-push dial-turn
    disassemble door-close door-lock door-open door-unlock drawer-close drawer-open faucet-close
    faucet-open hammer hand-insert handle-press handle-press-side handle-pull handle-pull-side
    lever-pull peg-insert-side peg-unplug-side pick-out-of-hole pick-place pick-place-wall
    plate-slide plate-slide-back plate-slide-back-side plate-slide-side push push-back push-wall
    reach reach-wall shelf-place soccer stick-pull stick-push sweep sweep-into window-close
    window-open
""".split()


# Gymnasium-Robotics: embodiment -> (task, width of its actions, control steps an episode)
_ROBOTICS = {
    "fetch": (("reach", 4, 50), ("push", 4, 50), ("pick-and-place", 4, 50), ("slide", 4, 50)),
    "shadow-hand": (("reach", 20, 50), ("block", 20, 100), ("egg", 20, 100), ("pen", 20, 100)),
    "adroit": (("door", 28, 200), ("hammer", 26, 200), ("pen", 24, 200), ("relocate", 30, 200)),
}


@dataclass(frozen=True)
class Task:
    """A task of a suite, which is one row of the table.

    :param suite: "dmc", "metaworld" or "robotics"
    :param name: its name in the suite, such as "walker-run"
    :param embodiment: the robot
    :param action_dim: the robot's number of actions, without padding
    :param frames: control steps of an episode, before any action repeat
    :param metric: "return", or "success" at the last step
    :param in_paper: whether it is one of the paper's 22 + 50 tasks
    """

    suite: str
    name: str
    embodiment: str
    action_dim: int
    frames: int
    metric: str
    in_paper: bool

    @property
    def id(self) -> str:
        """The id for `gymnasium.make`."""
        return f"wpt/{self.suite}-{self.name}-v0"

    @property
    def action_repeat(self) -> int:
        """The default number of control steps in a step of `gymnasium.make`."""
        return 1 if self.suite == "robotics" else 2


def _rows() -> list[Task]:
    rows = []
    for domain, (width, paper, further) in _DMC.items():
        for name in paper + further:
            row = Task("dmc", f"{domain}-{name}", domain, width, 1000, "return", name in paper)
            rows.append(row)
    for name in _METAWORLD:
        rows.append(Task("metaworld", name, "sawyer", 4, 200, "success", True))
    for robot, robot_tasks in _ROBOTICS.items():
        for name, width, frames in robot_tasks:
            row = Task("robotics", f"{robot}-{name}", robot, width, frames, "success", False)
            rows.append(row)
    return rows


#: Every task by its id, such as "wpt/dmc-walker-run-v0".
#:
#: :meta hide-value:
TASKS: dict[str, Task] = {task.id: task for task in _rows()}

#: The ids of the tasks of B.1 of the paper, in the order in which one agent learns them.
ANT_SEQUENCE: tuple[str, ...] = tuple(
    f"wpt/dmc-quadruped-{name}-v0" for name in ("stand", "walk", "run", "jump", "roll", "roll-fast")
)


def suite(name: str, paper_only: bool = True) -> list[Task]:
    """Return the tasks of one suite, in the table's order.

    :param name: "dmc", "metaworld" or "robotics"
    :param paper_only: leave out tasks that are not in the paper
    :raises ValueError: an unknown suite
    """
    rows = [task for task in TASKS.values() if task.suite == name]
    if not rows:
        suites = sorted({task.suite for task in TASKS.values()})
        raise ValueError(f"No suite {name!r}. There are: {', '.join(suites)}")
    return [task for task in rows if task.in_paper or not paper_only]


def suite_width(name: str) -> int:
    """Return the width of a suite's widest actions, which `pad_action_to="suite"` stands for."""
    return max(task.action_dim for task in suite(name, paper_only=False))


def pad_width(suite_name: str, pad_action_to: int | str | None) -> int | None:
    """Return the width that `pad_action_to` stands for.

    :raises ValueError: anything but a number, "suite" and None
    """
    if pad_action_to == "suite":
        return suite_width(suite_name)
    if pad_action_to is None or isinstance(pad_action_to, int):
        return pad_action_to
    raise ValueError(f"pad_action_to={pad_action_to!r}: pass a number, 'suite' or None")


def find(suite_name: str, name: str) -> Task:
    """Return the row of a task.

    :raises ValueError: an unknown name; the message lists the nearest ones
    """
    task = TASKS.get(f"wpt/{suite_name}-{name}-v0")
    if task is None:
        names = [row.name for row in suite(suite_name, paper_only=False)]
        near = difflib.get_close_matches(name, names, n=3) or names
        raise ValueError(
            f"No task {name!r} in suite {suite_name!r}. Nearest: {', '.join(near)}. "
            "All: wpt_envs.tasks.TASKS"
        )
    return task
