"""Progress bars of stages: shown on request, and in any case where a stage takes over a minute."""

import sys
import time
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, Self, TypeVar

T = TypeVar("T")
LONG = 60.0  # seconds that a stage may take without a bar
LOOK = 5.0  # seconds after which its duration is estimated


class StageBar:
    """The progress of a stage, and how long it will still take.

    Unless it is `visible`, the bar is hidden in the first seconds. Then it appears if the stage, at
    its pace so far, takes more than a minute, so that nobody waits for long without a message.

    Example::

        with StageBar(len(files), "convert") as bar:
            for file in files:
                convert(file)
                bar.update()

    :param total: number of steps of the stage
    :param name: what the stage does, shown in front of the bar
    :param visible: whether to show the bar from the start
    :param done: number of steps that were made before
    :param unit: name of a step
    :param silent: whether to show nothing in any case
    """

    def __init__(
        self,
        total: int,
        name: str,
        visible: bool = False,
        done: int = 0,
        unit: str = "it",
        silent: bool = False,
    ) -> None:
        self.total = total
        self.name = name
        self.visible = visible
        self.before = done
        self.done = done
        self.unit = unit
        self.silent = silent or done >= total
        self.bar: Any = None
        self.start = time.monotonic()

    def __enter__(self) -> Self:
        if self.visible and not self.silent:
            self._show()
        return self

    def __exit__(self, *_: object) -> None:
        if self.bar is not None:
            self.bar.close()

    def update(self, steps: int = 1, values: Mapping[str, str] | None = None) -> None:
        """Count steps that were made.

        :param steps: their number
        :param values: names and values to show beside the bar
        """
        self.done += steps
        if self.bar is not None:
            if values:
                self.bar.set_postfix(values, refresh=False)
            self.bar.update(steps)
        elif not self.silent and self.duration() > LONG:
            self._show()

    def duration(self) -> float:
        """Return the seconds that the stage takes at its pace so far, 0 while it is too early."""
        passed = time.monotonic() - self.start
        made = self.done - self.before
        return passed * (self.total - self.before) / made if passed > LOOK and made else 0.0

    def _show(self) -> None:
        from tqdm.auto import tqdm

        self.bar = tqdm(
            total=self.total,
            initial=self.done,
            desc=self.name,
            unit=self.unit,
            mininterval=0.2 if sys.stderr.isatty() else 10,  # a log file needs fewer lines
        )


def shown(
    items: Iterable[T], total: int, name: str, visible: bool = False, done: int = 0
) -> Iterator[T]:
    """Iterate over the items of a stage beside its `StageBar`."""
    with StageBar(total, name, visible, done) as bar:
        for item in items:
            yield item
            bar.update()
