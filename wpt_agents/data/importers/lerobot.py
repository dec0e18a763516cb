"""LeRobot datasets of version 3: parquet tables, and mp4 videos or images in the tables.

Row t holds observation t and the action taken at it. There is no observation after the last action,
so that action is left out, and no terminal state is seen.
"""

import io
import json
import os
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from wpt_agents.data.importers.episodes import (
    Episodes,
    as_images,
    both_limits,
    needs,
    rescaled,
    warn_left_out,
)
from wpt_agents.data.trajectory import Trajectory


class LeRobotEpisodes(Episodes):
    """A dataset's episodes; actions are rescaled from the limits in its statistics to [-1, 1].

    :param folder: with `meta/info.json`
    :param camera: which camera, if there are several
    :param low: (A,) the actions' limits, instead of the least and greatest in the data
    :param high: (A,)
    """

    def __init__(
        self,
        folder: str | os.PathLike[str],
        camera: str | None = None,
        low: Sequence[float] | None = None,
        high: Sequence[float] | None = None,
        **options: Any,
    ) -> None:
        super().__init__(**options)
        given = both_limits(low, high)
        self._parquet = needs("pyarrow.parquet", "LeRobot datasets")
        self._folder = Path(folder)
        self._info = json.loads(_text(self._folder / "meta" / "info.json"))
        version = str(self._info.get("codebase_version"))
        if not version.startswith("v3."):
            raise ValueError(f"{folder} is of version {version}; convert it to v3.0 with lerobot")
        self._camera = self._choose(camera)
        self._low, self._high = given or self._limits()
        self._rows = self._episodes()
        self._open: tuple[Path, Any] | None = None
        if self._info["features"][self._camera]["dtype"] == "video":
            warnings.warn(
                f"LeRobot stored the images of {folder} as video, which is lossy; record with "
                "dtype 'image' to keep them as they were",
                stacklevel=2,
            )

    def _choose(self, camera: str | None) -> str:
        features = self._info["features"]
        cameras = [name for name, f in features.items() if f["dtype"] in ("video", "image")]
        chosen = [name for name in cameras if camera in (None, name)]
        if len(chosen) != 1:
            raise ValueError(
                f"{self._folder} has {len(chosen)} cameras for camera={camera!r}; give one of: "
                f"{', '.join(cameras) or 'none, it has no images'}"
            )
        return chosen[0]

    def _limits(self) -> tuple[np.ndarray, np.ndarray]:
        """The least and greatest actions in the data."""
        stats = json.loads(_text(self._folder / "meta" / "stats.json"))["action"]
        return np.asarray(stats["min"], np.float64), np.asarray(stats["max"], np.float64)

    def _episodes(self) -> list[dict[str, Any]]:
        files = sorted((self._folder / "meta" / "episodes").rglob("*.parquet"))
        wanted = ("episode_index", "tasks", "length", "data/", f"videos/{self._camera}/")
        rows = []
        for file in files:
            names = self._parquet.read_schema(file).names
            columns = [name for name in names if name.startswith(wanted)]
            rows += self._parquet.read_table(file, columns=columns).to_pylist()
        long = [row for row in rows if row["length"] > 1]
        warn_left_out(len(rows) - len(long), self._folder)
        return sorted(long, key=lambda row: row["episode_index"])

    def __len__(self) -> int:
        return len(self._rows)

    def __getitem__(self, i: int) -> Trajectory:
        row = self._rows[i]
        source = f"{self._folder.name} episode {row['episode_index']}"
        table = self._table(row)
        if table.num_rows != row["length"]:
            raise ValueError(f"{source} has {table.num_rows} rows, {row['length']} expected")
        action = np.array(table["action"].to_pylist(), np.float64)
        reward = (
            table["next.reward"].to_numpy()[:-1] if "next.reward" in table.schema.names else None
        )
        video = self._info["features"][self._camera]["dtype"] == "video"
        image = self._video(row, table, source) if video else self._pictures(table)
        tasks = row.get("tasks") or [None]
        return self._trajectory(
            image,
            rescaled(action.reshape(len(action), -1), self._low, self._high)[:-1],
            reward,
            source,
            embodiment=self.embodiment or self._info.get("robot_type"),
            task=self.task or tasks[0],
        )

    def _table(self, row: dict[str, Any]) -> Any:
        """The episode's rows, in order; the file is kept for the next episode."""
        path = self._folder / self._info["data_path"].format(
            chunk_index=row["data/chunk_index"], file_index=row["data/file_index"]
        )
        if self._open is None or self._open[0] != path:
            names = self._parquet.read_schema(path).names
            wanted = ("action", "episode_index", "frame_index", "timestamp", "next.reward")
            columns = [name for name in names if name in (*wanted, self._camera)]
            self._open = path, self._parquet.read_table(path, columns=columns)
        table = self._open[1]
        mine = np.flatnonzero(table["episode_index"].to_numpy() == row["episode_index"])
        return table.take(mine).sort_by("frame_index")

    def _pictures(self, table: Any) -> np.ndarray:
        image = needs("PIL.Image", "images in LeRobot datasets")
        found = []
        for cell in table[self._camera].to_pylist():
            picture = image.open(io.BytesIO(cell["bytes"]) if cell["bytes"] else cell["path"])
            found.append(as_images(np.array(picture.convert("RGB"))[None], self.image_size))
        return np.concatenate(found)

    def _video(self, row: dict[str, Any], table: Any, source: str) -> np.ndarray:
        """The episode's frames, each resized as soon as it is decoded."""
        prefix = f"videos/{self._camera}/"
        path = self._folder / self._info["video_path"].format(
            video_key=self._camera,
            chunk_index=row[prefix + "chunk_index"],
            file_index=row[prefix + "file_index"],
        )
        times = row[prefix + "from_timestamp"] + np.ravel(table["timestamp"].to_numpy()).astype(
            np.float64
        )
        found: list[np.ndarray] = []
        slack = 0.5 / self._info["fps"]
        for time, frame in _frames(path, float(times[0]), slack):
            if len(found) == len(times) or abs(time - times[len(found)]) > slack:
                break
            found.append(as_images(frame[None], self.image_size))
        if len(found) < len(times):
            raise ValueError(f"{source}: {path} has no frame at {times[len(found)]:.3f} s")
        return np.concatenate(found)


def _frames(path: Path, start: float, slack: float) -> Any:
    """Yields (time, frame) of a video from `start` seconds on."""
    av = needs("av", "videos")
    try:
        with av.open(str(path)) as container:
            stream = container.streams.video[0]
            container.seek(int(start / stream.time_base), stream=stream)
            for frame in container.decode(stream):
                if frame.time >= start - slack:
                    yield frame.time, frame.to_ndarray(format="rgb24")
    except (OSError, av.FFmpegError) as error:
        raise ValueError(f"{path} cannot be read: {error}") from error


def _text(path: Path) -> str:
    if not path.exists():
        raise ValueError(f"{path} does not exist; is this a LeRobot dataset of version 3?")
    return path.read_text()
