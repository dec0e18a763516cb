"""What a command asks for, apart from the tasks."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Request:
    """The options of the command `run` that are the same for all tasks.

    :param preset: the preset's name
    :param seeds: how many, or which ones, as `--seeds` takes them
    :param settings: changes to the preset, as `--set` takes them
    :param out: the folder for run folders, and for data and models that they share
    :param workers: the number of processes that collect
    :param data: the user's own dataset, None for the preset's
    """

    preset: str
    seeds: str = "1"
    methods: Sequence[str] = ("wpt",)
    settings: Sequence[str] = ()
    out: Path = Path("runs")
    workers: int = 2
    device: str = "auto"
    data: Path | None = None
