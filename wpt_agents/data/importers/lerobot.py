"""LeRobot datasets of versions 2 and 3: parquet tables, and mp4 videos or images in the tables.

Version 2 has a table and a video for each episode, and JSON lines about the episodes; in version 3,
tables and videos hold many episodes.
Row t holds observation t and the action taken at it. There is no observation after the last action,
so that action is dropped, and no terminal state is seen.
"""

import io
import json
import os
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from wpt_agents.data.importers.episodes import Episodes, as_images, needs, warn_left_out
from wpt_agents.data.trajectory import Trajectory
from wpt_agents.files.folders import files_below


class LeRobotEpisodes(Episodes):
    """A dataset's episodes; actions are rescaled from the limits in its statistics to [-1, 1].

    :param folder: with `meta/info.json`
    :param camera: the camera, if there are several; the same as `image_key`. The last part of its
        name is enough
    :param episodes: only the episodes of these indices, as in LeRobotDataset
    :param options: those of `Episodes`; `low` and `high` replace the minimum and maximum
        actions in the statistics
    """

    def __init__(
        self,
        folder: str | os.PathLike[str],
        camera: str | None = None,
        episodes: Sequence[int] | None = None,
        **options: Any,
    ) -> None:
        super().__init__(**options)
        self._refuse_done_key("LeRobot")
        self._parquet = needs("pyarrow.parquet", "LeRobot datasets")
        self._folder = Path(folder)
        self._info = _json(self._folder / "meta" / "info.json")
        version = str(self._info.get("codebase_version"))
        if not version.startswith(("v2.", "v3.")):
            raise ValueError(f"{folder} is of version {version}; convert it to v2.1 with lerobot")
        self._single = version.startswith("v2.")  # each file holds a single episode
        self._camera = self._choose(camera or self.image_key)
        self._actions = self._choose_actions()
        self._own_limits = None if self.limits is not None else self._read_limits()
        self._rows = self._episodes(episodes)
        self._open: tuple[Path, Any] | None = None
        if self._is_video:
            warnings.warn(
                f"LeRobot stored the images of {folder} as video, which is lossy; record with "
                "dtype 'image' to keep them as they were",
                stacklevel=2,
            )

    @property
    def _is_video(self) -> bool:
        return bool(self._info["features"][self._camera]["dtype"] == "video")

    def _choose(self, camera: str | None) -> str:
        features: dict[str, Any] = self._info["features"]
        cameras = [name for name, f in features.items() if f["dtype"] in ("video", "image")]
        chosen = [name for name in cameras if camera in (None, name)]
        if not chosen and camera is not None:
            chosen = [name for name in cameras if name.endswith(f".{camera}")]
        if len(chosen) != 1:
            raise ValueError(
                f"{self._folder} has {len(chosen)} cameras for camera={camera!r}; pass one of: "
                f"{', '.join(cameras) or 'none, it has no images'}"
            )
        return chosen[0]

    def _choose_actions(self) -> tuple[str, ...]:
        features = self._info["features"]
        missing = [name for name in self.action_keys or ("action",) if name not in features]
        if missing:
            similar = [name for name in features if "action" in name]
            raise ValueError(
                f"{self._folder} has no feature {missing[0]!r}; pass action_key (--action-key), "
                f"one or several of: {', '.join(similar or features)}"
            )
        return self.action_keys or ("action",)

    def _read_limits(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the minimum and maximum actions, from the dataset's statistics."""
        meta = self._folder / "meta"
        path = meta / "stats.json"
        if path.exists():
            parts = [_json(path)]
        else:  # version 2.1 has those of each episode
            path = meta / "episodes_stats.jsonl"
            parts = [line["stats"] for line in _lines(path)] if path.exists() else []
        missing = [
            name
            for name in self._actions
            if not parts or any(not {"min", "max"} <= set(part.get(name, ())) for part in parts)
        ]
        if missing:
            raise ValueError(
                f"{path} has no minimum and maximum of {missing[0]!r}; pass the limits of "
                "the actions, low=[...] and high=[...] (--low, --high)"
            )
        low, high = (
            np.array([np.concatenate([np.ravel(p[a][end]) for a in self._actions]) for p in parts])
            for end in ("min", "max")
        )
        return low.min(0).astype(np.float64), high.max(0).astype(np.float64)

    def _episodes(self, chosen: Sequence[int] | None) -> list[dict[str, Any]]:
        meta = self._folder / "meta"
        rows = _lines(meta / "episodes.jsonl") if self._single else self._tabulated(meta)
        if not rows:
            raise ValueError(f"{self._folder} has no episodes in its folder meta")
        if chosen is not None:
            rows = [row for row in rows if row["episode_index"] in set(chosen)]
            missing = set(chosen) - {row["episode_index"] for row in rows}
            if missing:
                raise ValueError(f"{self._folder} has no episode {min(missing)}")
        long = [row for row in rows if row["length"] > 1]
        warn_left_out(len(rows) - len(long), self._folder)
        return sorted(long, key=lambda row: int(row["episode_index"]))

    def _tabulated(self, meta: Path) -> list[dict[str, Any]]:
        """Return the rows about episodes in the tables of version 3."""
        prefixes = ("episode_index", "tasks", "length", "data/", f"videos/{self._camera}/")
        rows = []
        for file in sorted(files_below(meta / "episodes", "*.parquet")):
            rows += self._columns(file, lambda name: name.startswith(prefixes)).to_pylist()
        return rows

    def _columns(self, path: Path, chooses: Callable[[str], bool]) -> Any:
        """Return the columns of a parquet file that `chooses` picks by their names.

        :raises ValueError: if the file cannot be read
        """
        try:
            names = self._parquet.read_schema(path).names
            return self._parquet.read_table(path, columns=[n for n in names if chooses(n)])
        except (OSError, ValueError, NotImplementedError) as error:  # what pyarrow raises
            raise ValueError(f"{path} cannot be read: {error}") from error

    def _file(self, row: dict[str, Any], kind: str, prefix: str) -> Path:
        """Return an episode's table or video.

        :param kind: `data_path` or `video_path`
        :param prefix: of the columns that name the file, in version 3
        """
        number = row["episode_index"]
        name: str = self._info[kind].format(
            video_key=self._camera,
            chunk_index=row.get(f"{prefix}chunk_index"),
            file_index=row.get(f"{prefix}file_index"),
            episode_chunk=number // self._info.get("chunks_size", 1000),
            episode_index=number,
        )
        return self._folder / name

    def __len__(self) -> int:
        return len(self._rows)

    def __getitem__(self, i: int) -> Trajectory:
        row = self._rows[i]
        source = f"{self._folder.name} episode {row['episode_index']}"
        table = self._table(row)
        if table.num_rows != row["length"]:
            raise ValueError(
                f"{source} has {table.num_rows} rows, but {row['length']} are expected"
            )
        parts = [np.array(table[name].to_pylist(), np.float64) for name in self._actions]
        action = np.concatenate([part.reshape(len(part), -1) for part in parts], axis=1)
        rewarded = "next.reward" in table.schema.names
        image = self._video(row, table, source) if self._is_video else self._pictures(table, source)
        tasks = row.get("tasks") or [None]
        return self._trajectory(
            image,
            action[:-1],
            np.ravel(table["next.reward"].to_pylist())[:-1] if rewarded else None,
            source,
            self._own_limits,
            embodiment=self.embodiment or self._robot(),
            task=self.task or tasks[0],
        )

    def _robot(self) -> str | None:
        robot = self._info.get("robot_type")
        return None if robot == "unknown" else robot  # not the name of one robot

    def _table(self, row: dict[str, Any]) -> Any:
        """Return the episode's rows in order; the file is cached for the next episode."""
        path = self._file(row, "data_path", "data/")
        if self._open is None or self._open[0] != path:
            usual = ("episode_index", "frame_index", "timestamp", "next.reward")
            names = (*usual, *self._actions, self._camera)
            self._open = path, self._columns(path, lambda name: name in names)
        table = self._open[1]
        # a file holds many episodes
        mine = np.flatnonzero(table["episode_index"].to_numpy() == row["episode_index"])
        return table.take(mine).sort_by("frame_index")

    def _pictures(self, table: Any, source: str) -> np.ndarray:
        """Return images stored in the table, or at paths relative to the dataset."""
        reader = needs("PIL.Image", "images in LeRobot datasets")
        images = []
        for cell in table[self._camera].to_pylist():
            data = io.BytesIO(cell["bytes"]) if cell["bytes"] else self._folder / cell["path"]
            try:
                picture = np.array(reader.open(data).convert("RGB"))
            except (OSError, SyntaxError) as error:
                raise ValueError(f"{source}: {cell['path']} cannot be read: {error}") from error
            images.append(as_images(picture[None], self._resize))
        return np.concatenate(images)

    def _video(self, row: dict[str, Any], table: Any, source: str) -> np.ndarray:
        """Return the episode's frames, each resized as soon as it is decoded."""
        prefix = f"videos/{self._camera}/"
        path = self._file(row, "video_path", prefix)
        begin = 0.0 if self._single else row[f"{prefix}from_timestamp"]
        times = begin + np.ravel(table["timestamp"].to_numpy()).astype(np.float64)
        images: list[np.ndarray] = []
        slack = 0.5 / self._info["fps"]  # half a frame, because time stamps may be rounded
        for time, frame in _frames(path, float(times[0]), slack):
            if len(images) == len(times) or abs(time - times[len(images)]) > slack:
                break
            images.append(as_images(frame[None], self._resize))
        if len(images) < len(times):
            raise ValueError(f"{source}: {path} has no frame at {times[len(images)]:.3f} s")
        return np.concatenate(images)


def _frames(path: Path, start: float, slack: float) -> Iterator[tuple[float, np.ndarray]]:
    """Yield (time, frame) of a video from `start` seconds on."""
    av = needs("av", "videos")
    try:
        with av.open(str(path)) as container:
            stream = container.streams.video[0]
            container.seek(int(start / stream.time_base), stream=stream)
            for frame in container.decode(stream):
                if frame.time >= start - slack:
                    yield frame.time, frame.to_ndarray(format="rgb24")
    except (OSError, IndexError, av.FFmpegError) as error:  # IndexError: no stream of images
        raise ValueError(f"{path} cannot be read: {error}") from error


def _json(path: Path) -> dict[str, Any]:
    content: dict[str, Any] = _parsed(path, json.loads)
    return content


def _lines(path: Path) -> list[dict[str, Any]]:
    lines: list[dict[str, Any]] = _parsed(
        path, lambda text: [json.loads(line) for line in text.split("\n") if line.strip()]
    )
    return lines


def _parsed(path: Path, parse: Callable[[str], Any]) -> Any:
    if not path.exists():
        raise ValueError(f"{path} does not exist; is this a LeRobot dataset of version 2 or 3?")
    try:
        return parse(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(f"{path} is damaged: {error}") from error
