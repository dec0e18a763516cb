"""Workers end with the process that began them, however that ended."""

import os
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import pytest

from wpt_agents.zoo.collect import workers

PARENT = """
import os
import sys
import time

from wpt_agents.zoo.run.engines import Local, Resources
from wpt_agents.zoo.collect.workers import worker_pool


def wait(path):
    with open(path, "w") as file:
        file.write(str(os.getpid()))
    time.sleep(600)


if __name__ == "__main__":
    START
    time.sleep(600)
"""
STARTS = {
    "pool": "worker_pool(1).submit(wait, sys.argv[1]).result()",
    "engine": "Local(Resources()).start(wait, sys.argv[1])",
}


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self").exists(), reason="looks at processes through /proc")
@pytest.mark.parametrize("start", STARTS.values(), ids=STARTS)
def test_a_worker_ends_with_a_killed_parent(tmp_path, start):
    script, pid_file = tmp_path / "parent.py", tmp_path / "pid"
    script.write_text(PARENT.replace("START", start))
    parent = subprocess.Popen([sys.executable, str(script), str(pid_file)])
    try:
        worker = int(until(lambda: pid_file.exists() and pid_file.read_text()))
        assert alive(worker)
    finally:
        parent.send_signal(signal.SIGKILL)
        parent.wait()
    try:
        until(lambda: not alive(worker))
    finally:
        with suppress(ProcessLookupError):
            os.kill(worker, signal.SIGKILL)


def until(true, seconds=300):
    """What `true` returns once it is true."""
    end = time.monotonic() + seconds
    while not (value := true()):
        assert time.monotonic() < end
        time.sleep(0.05)
    return value


def alive(pid):
    with suppress(ProcessLookupError, FileNotFoundError):
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
        return state != "Z"  # one that nobody waits for is not alive
    return False


POOL = """
import signal
import sys
import time

from wpt_agents.zoo.collect.workers import worker_pool


def begin(path):
    open(path, "w").close()


if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored in background jobs
    with worker_pool(1) as pool:
        pool.submit(begin, sys.argv[1]).result()
        try:
            time.sleep(600)
        except KeyboardInterrupt:
            print("interrupted")
"""


@pytest.mark.parametrize("ignored", [True, False])
def test_workers_ignore_ctrl_c_if_their_parent_does(ignored, monkeypatch):
    monkeypatch.setattr(workers, "end_with_parent", lambda: None)
    before = signal.signal(signal.SIGINT, signal.SIG_IGN if ignored else signal.default_int_handler)
    try:
        workers._begin()
        assert signal.getsignal(signal.SIGINT) is (signal.SIG_IGN if ignored else signal.SIG_DFL)
    finally:
        signal.signal(signal.SIGINT, before)


@pytest.mark.slow
def test_ctrl_c_ends_workers_without_a_traceback(tmp_path):
    script, begun = tmp_path / "pool.py", tmp_path / "begun"
    script.write_text(POOL)
    command = [sys.executable, str(script), str(begun)]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen(command, start_new_session=True, **pipes) as parent:
        until(begun.exists)
        time.sleep(0.5)  # the worker waits for more work
        os.killpg(parent.pid, signal.SIGINT)  # as a terminal does
        try:
            assert parent.communicate(timeout=60) == ("interrupted\n", "")
        finally:
            if parent.poll() is None:
                os.killpg(parent.pid, signal.SIGKILL)
