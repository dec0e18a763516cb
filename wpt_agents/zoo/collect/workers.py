"""Worker processes that end with their parent process."""

import os
import signal
import threading
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context, parent_process


def worker_pool(workers: int) -> ProcessPoolExecutor:
    """Return a pool of new processes, which do not inherit any state."""
    return ProcessPoolExecutor(workers, mp_context=get_context("spawn"), initializer=_begin)


def _begin() -> None:
    end_with_parent()
    # A terminal sends Ctrl-C to all processes. The parent reports it; a worker ends without a word.
    if signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:  # as in background jobs of a script
        signal.signal(signal.SIGINT, signal.SIG_DFL)


def end_with_parent() -> None:
    """End this process as soon as its parent has ended, even if the parent was killed.

    Otherwise it would continue, and its locks would block a restart of the command.
    """
    parent = parent_process()
    assert parent is not None

    def wait() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()
