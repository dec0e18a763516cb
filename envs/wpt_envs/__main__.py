"""python -m wpt_envs {list, montage, likeness, speed}: tasks, renderings and their cost."""

import argparse
from collections.abc import Callable
from pathlib import Path

from wpt_envs.headless import RenderingError
from wpt_envs.tasks import TASKS, Task


def main() -> None:
    """Run one command of the command line."""
    parser = argparse.ArgumentParser(prog="python -m wpt_envs", description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    commands.add_parser("list", help="Print the table of tasks.")
    montage = commands.add_parser(
        "montage",
        help="Draw every task in the three renderings, exact, near and fast, into one picture.",
    )
    montage.add_argument("path", type=Path, help="The picture to write, such as tasks.png.")
    montage.add_argument("--size", type=int, default=64, help="Side of each image in pixels.")
    likeness = commands.add_parser(
        "likeness", help="Print the PSNR of near and fast against exact, in dB."
    )
    likeness.add_argument(
        "--states", type=int, default=20, help="Number of states of each task that are drawn."
    )
    for command in (montage, likeness):
        suites = sorted({task.suite for task in TASKS.values()})
        command.add_argument("--suite", choices=suites, help="Only the tasks of this suite.")
    speed = commands.add_parser(
        "speed",
        help="Print the CPU time of a step for each rendering and the simulator's own renderer.",
    )
    speed.add_argument(
        "--rounds",
        type=int,
        default=5,
        help="Number of rounds of ten steps; the median is printed.",
    )
    arguments = vars(parser.parse_args())
    run: dict[str, Callable[..., None]] = {
        "list": _list,
        "montage": _montage,
        "likeness": _likeness,
        "speed": _speed,
    }
    try:
        run[arguments.pop("command")](**arguments)
    except ImportError as error:
        if (error.name or "").startswith("wpt_envs"):
            raise  # a fault of ours, not a missing package
        if isinstance(error, ModuleNotFoundError) and error.name:
            remedy = 'pip install "wpt-agents[sims]"'
            parser.exit(2, f"Error: {error.name} is not installed: {remedy}\n")
        parser.exit(2, f"Error: {error}\n")  # for example of a library of OpenGL
    except (RenderingError, OSError) as error:  # no traceback, as in the zoo
        parser.exit(2, f"Error: {error}\n")


def _list() -> None:
    print(f"{'id':44s} {'embodiment':12s} {'actions':>7s} {'frames':>6s} {'metric':8s} paper")
    for task in TASKS.values():
        print(
            f"{task.id:44s} {task.embodiment:12s} {task.action_dim:7d} {task.frames:6d} "
            f"{task.metric:8s} {'yes' if task.in_paper else ''}"
        )


def _montage(path: Path, size: int, suite: str | None) -> None:
    from wpt_envs.measure import montage

    montage(_chosen(suite), path, size)


def _likeness(states: int, suite: str | None) -> None:
    from wpt_envs.measure import likeness

    for task in _chosen(suite):
        ratio = likeness(task, states)
        print(
            f"{task.id:44s} near {ratio['near']:5.1f} dB  fast {ratio['fast']:5.1f} dB", flush=True
        )


def _chosen(suite: str | None) -> list[Task]:
    return [task for task in TASKS.values() if suite in (None, task.suite)]


def _speed(rounds: int) -> None:
    from wpt_envs.measure import THE_FOUR, speed

    for name in THE_FOUR:
        costs = speed(TASKS[name], rounds)
        row = "  ".join(
            f"{rendering} {cost:6.2f} ms (x{costs['exact'] / cost:4.1f})"
            for rendering, cost in costs.items()
        )
        print(f"{name:32s} {row}", flush=True)


if __name__ == "__main__":
    main()
