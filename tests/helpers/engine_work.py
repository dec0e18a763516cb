"""The work that tests hand to engines; light to import, because every worker imports it."""

import os
import signal
import time

import gymnasium as gym
from wpt_envs.tasks import TASKS

from wpt_agents.zoo.run.engines import do


def touch(one):
    """Work that leaves a line for each time that it was done."""
    one.folder.mkdir(parents=True, exist_ok=True)
    with open(one.folder / "done.txt", "a") as file:
        file.write(f"{os.getpid()}\n")


def die_once(one):
    """Work whose first process is killed as if by the system."""
    if not (one.folder / "died").exists():
        one.folder.mkdir(parents=True, exist_ok=True)
        (one.folder / "died").touch()
        os.kill(os.getpid(), signal.SIGKILL)
    touch(one)


def die_always(one):
    touch(one)
    os.kill(os.getpid(), signal.SIGKILL)


def fail(one):
    touch(one)
    (one.folder / "error.txt").write_text("Traceback\nRuntimeError: out of luck\n")
    raise RuntimeError("out of luck")


def do_dot(one):
    """A real run, in a process that has never heard of the dot."""
    from dot_runs import make_dot

    TASKS[one.task.id] = one.task
    gym.register(one.task.id, entry_point=make_dot)
    do(one)


def slow_once(one):
    """Work that waits to be preempted, and is quick when it is done again."""
    if not (one.folder / "begun").exists():
        one.folder.mkdir(parents=True, exist_ok=True)
        (one.folder / "begun").write_text(str(os.getpid()))
        time.sleep(60)
    touch(one)
