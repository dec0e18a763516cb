"""Workers end with the process that began them, however that ended."""

import os
import signal
import subprocess
import sys
import time

import pytest

PARENT = """
import time
from multiprocessing import get_context

from wpt_agents.zoo.workers import end_with_parent, worker_pool


def wait(path):
    with open(path, "w") as file:
        file.write(str(os.getpid()))
    time.sleep(600)


def child(path):
    end_with_parent()
    wait(path)
"""
STARTS = {
    "pool": "with worker_pool(1) as pool: pool.submit(wait, sys.argv[1]).result()",
    "forkserver": "get_context('forkserver').Process(target=child, args=sys.argv[1:]).start()",
}


@pytest.mark.parametrize("start", STARTS.values(), ids=STARTS)
def test_a_worker_ends_with_a_killed_parent(tmp_path, start):
    script, told = tmp_path / "parent.py", tmp_path / "pid"
    main = f"\nif __name__ == '__main__':\n    {start}\n    time.sleep(600)\n"
    script.write_text("import os\nimport sys\n" + PARENT + main)
    parent = subprocess.Popen([sys.executable, str(script), str(told)])
    try:
        worker = int(until(lambda: told.exists() and told.read_text()))
        assert alive(worker)
    finally:
        parent.send_signal(signal.SIGKILL)
        parent.wait()
    until(lambda: not alive(worker))


def until(true, seconds=60):
    """What `true` returns once it is true."""
    end = time.monotonic() + seconds
    while not (value := true()):
        assert time.monotonic() < end
        time.sleep(0.05)
    return value


def alive(pid):
    try:
        os.kill(pid, 0)
        with open(f"/proc/{pid}/stat") as file:  # one that nobody waits for is not alive
            return file.read().rpartition(")")[2].split()[0] != "Z"
    except (ProcessLookupError, FileNotFoundError):
        return False
