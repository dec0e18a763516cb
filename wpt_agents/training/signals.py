"""Ctrl-C and SIGTERM, deferred until an update is complete and the model is saved."""

import os
import signal
import sys
import threading
from contextlib import suppress
from types import FrameType
from typing import Any, Self

SIGNALS = (signal.SIGINT, signal.SIGTERM)


class StopSignals:
    """Defer Ctrl-C and SIGTERM while the block runs; a second signal takes effect at once.

    Example::

        with StopSignals() as signals:
            for batch in batches:
                update(batch)
                if signals.received:
                    save()
                    signals.deliver(signals.received)

    Signals that the process ignores stay ignored, and outside of the main thread, where Python
    handles no signals, the block changes nothing.

    :param message: what the first signal prints to the standard error, "" for nothing
    :ivar received: the number of the signal that was received, 0 for none
    """

    def __init__(self, message: str = "") -> None:
        self.message = message
        self.received = 0
        self._before: dict[int, Any] = {}  # handlers by signal

    def __enter__(self) -> Self:
        self.start()
        return self

    def start(self) -> None:
        """Begin to defer signals; without effect if it has begun already."""
        if self._before or threading.current_thread() is not threading.main_thread():
            return
        for number in SIGNALS:
            handler = signal.getsignal(number)
            if handler not in (signal.SIG_IGN, None):
                self._before[number] = signal.signal(number, self._note)

    def __exit__(self, *_: object) -> None:
        self._restore()
        if self.received:  # after the last update
            signal.raise_signal(self.received)

    def _note(self, number: int, frame: FrameType | None) -> None:
        if self.received:
            self.deliver(number)
        self.received = number
        if self.message:
            # Not by `print`, which the signal may have interrupted. Ctrl-C also ends the program
            # that reads the output, such as `tee`, and a notebook's output is no file.
            with suppress(OSError, ValueError):
                os.write(sys.stderr.fileno(), f"\n{self.message}\n".encode())

    def deliver(self, number: int) -> None:
        """Let a signal have the effect that it would have had without this block.

        If the process continues, as its own handler may decide, signals are deferred again.
        """
        self.received = 0
        before = dict(self._before)
        self._restore()
        signal.raise_signal(number)
        for again in before:
            self._before[again] = signal.signal(again, self._note)

    def _restore(self) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)
        self._before.clear()
