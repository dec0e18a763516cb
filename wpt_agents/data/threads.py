"""Threads that read in parallel and in advance, as decompression releases Python's global lock."""

import os
from collections import deque
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import ThreadPoolExecutor
from itertools import count
from typing import TypeVar

In = TypeVar("In")
Out = TypeVar("Out")


class Threads:
    """A `map` over a number of threads, which are started on first use.

    :param workers: number of threads; 0 for the plain `map`
    """

    def __init__(self, workers: int) -> None:
        self.workers = workers
        self._pool: ThreadPoolExecutor | None = None
        self._owner = 0

    def __reduce__(self) -> tuple[type["Threads"], tuple[int]]:
        """Let copies and pickles start threads of their own."""
        return type(self), (self.workers,)

    def map(self, function: Callable[[In], Out], items: Iterable[In]) -> Iterable[Out]:
        """Apply `function` to each item; results come in the items' order."""
        if self.workers < 1:
            return map(function, items)
        if self._pool is None or self._owner != os.getpid():  # threads do not survive a fork
            self._pool = ThreadPoolExecutor(self.workers, "dataset")
            self._owner = os.getpid()
        return self._pool.map(function, items)

    def close(self) -> None:
        """End the threads; a later `map` starts new ones."""
        if self._pool is not None:
            self._pool.shutdown()
            self._pool = None


def prefetched(draw: Callable[[int], Out], start: int, ahead: int) -> Generator[Out, None, None]:
    """Yield draw(start), draw(start + 1), ... without end.

    :param ahead: number of results that are prepared in the background
    """
    with ThreadPoolExecutor(1, "batches") as pool:
        waiting = deque(pool.submit(draw, k) for k in range(start, start + ahead + 1))
        try:
            for k in count(start + ahead + 1):
                yield waiting.popleft().result()
                waiting.append(pool.submit(draw, k))
        finally:
            pool.shutdown(cancel_futures=True)
