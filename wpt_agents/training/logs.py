"""The learning curve of pre-training: `progress.csv` and TensorBoard events."""

import csv
import sys
from collections import defaultdict
from collections.abc import Mapping
from pathlib import Path

import torch
from stable_baselines3.common.logger import (
    CSVOutputFormat,
    HumanOutputFormat,
    KVWriter,
    Logger,
    TensorBoardOutputFormat,
)
from stable_baselines3.common.utils import get_latest_run_id
from torch import Tensor

try:
    from torch.utils.tensorboard.writer import SummaryWriter
except ImportError:
    SummaryWriter = None  # type: ignore[assignment, misc]

LOG_EVERY = 50  # updates of pre-training
STEP = "time/pretrain_steps"


class ContinuedCSV(CSVOutputFormat):
    """SB3's writer of `progress.csv`, which continues an existing file."""

    def __init__(self, path: Path) -> None:
        path.touch()
        self.file = open(path, "r+", encoding="utf-8")  # `close` closes it
        self.separator = ","
        self.quotechar = '"'
        header = self.file.readline()
        self.keys = header.strip().split(",") if header.endswith("\n") else []
        self.file.seek(0, 2)

    def keep(self, step: int) -> None:
        """Drop the rows of later updates, which are made again, and an incomplete row.

        Files of version 0.1 have no column of steps: a row stands for `LOG_EVERY` updates.
        """
        self.file.seek(0)
        lines = self.file.readlines()
        rows = list(csv.DictReader(lines))
        kept = lines[:1]
        for number, (line, row) in enumerate(zip(lines[1:], rows, strict=True), 1):
            whole = line.endswith("\n") and len(line.split(",")) == len(self.keys)
            if whole and float(row.get(STEP) or number * LOG_EVERY) <= step:
                kept.append(line)
        self.file.seek(0)
        self.file.writelines(kept)
        self.file.truncate()
        self.file.flush()


class ContinuedTensorBoard(TensorBoardOutputFormat):
    """SB3's TensorBoard writer, which hides the events after a step: they are written again."""

    def __init__(self, folder: Path, step: int) -> None:
        self.writer = SummaryWriter(str(folder), purge_step=step + 1 if step else None)
        self._is_closed = False


class PretrainingLog:
    """Write means of the metrics of pre-training over `LOG_EVERY` updates, or the last ones.

    :param run_dir: folder of `progress.csv` and, where tensorboard is installed, of its events
    :param tensorboard_log: folder of TensorBoard's runs; this one is named "pretrain_1" and so on
    :param verbose: 1 to print a table, too
    :param step: number of updates that were made before
    """

    def __init__(
        self, run_dir: Path | None, tensorboard_log: str | None, verbose: int, step: int
    ) -> None:
        outputs: list[KVWriter] = []
        if run_dir is not None:
            run_dir.mkdir(parents=True, exist_ok=True)
            table = ContinuedCSV(run_dir / "progress.csv")
            table.keep(step)
            outputs.append(table)
            if SummaryWriter is not None:
                outputs.append(ContinuedTensorBoard(run_dir, step))
        if tensorboard_log is not None:
            if SummaryWriter is None:
                raise ImportError(
                    "tensorboard_log= needs tensorboard, which is not installed: pip install "
                    "tensorboard"
                )
            number = get_latest_run_id(tensorboard_log, "pretrain") + (0 if step else 1)
            outputs.append(ContinuedTensorBoard(Path(tensorboard_log, f"pretrain_{number}"), step))
        if verbose:
            outputs.append(HumanOutputFormat(sys.stdout))
        self.logger = Logger(None, outputs)
        self.step = step
        self.pending: dict[str, list[Tensor]] = defaultdict(list)

    def add(self, metrics: Mapping[str, Tensor]) -> None:
        """Log an update; write a row if it is the last of `LOG_EVERY`."""
        self.step += 1
        for name, value in metrics.items():
            self.pending[name].append(value)
        if self.step % LOG_EVERY == 0:
            self.write()

    def write(self) -> None:
        """Write a row of the updates since the last one, if there were any."""
        if not self.pending:
            return
        for name, values in self.pending.items():
            self.logger.record(name, float(torch.stack(values).mean()))
        self.pending.clear()
        self.logger.record(STEP, self.step, exclude="tensorboard")
        self.logger.dump(self.step)

    def close(self) -> None:
        """Close the files."""
        self.logger.close()
