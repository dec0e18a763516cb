"""Minari datasets. Time is as ours: T + 1 observations, action t taken at observation t."""

import os
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from wpt_agents.data.importers.episodes import Episodes, both_limits, needs, rescaled
from wpt_agents.data.trajectory import Trajectory


def local_minari(name: str) -> Path:
    """Where Minari keeps the local dataset of this name."""
    root = os.environ.get("MINARI_DATASETS_PATH") or Path.home() / ".minari" / "datasets"
    return Path(root) / name


class MinariEpisodes(Episodes):
    """A Minari dataset's episodes; actions are rescaled from its action space to [-1, 1].

    :param name: a local dataset's name (`namespace/name-v0`), its folder, or the `data` in it
    :param image_key: where the images are in a dictionary observation; dots go deeper
    :param low: (A,) the actions' limits, if not those of the action space
    :param high: (A,)
    """

    def __init__(
        self,
        name: str | os.PathLike[str],
        image_key: str | None = None,
        low: np.ndarray | None = None,
        high: np.ndarray | None = None,
        **options: Any,
    ) -> None:
        super().__init__(**options)
        self._limits = both_limits(low, high)
        minari = needs("minari", "Minari datasets")
        folder = Path(name)
        if folder.exists():
            inner = folder / "data"
            self._data = minari.MinariDataset(inner if inner.exists() else folder)
        else:
            self._data = minari.load_dataset(str(name))
        self._name, self._key = self._data.spec.dataset_id, image_key
        if self._data.storage.metadata.get("jpeg_encoding"):
            warnings.warn(
                f"Minari stored the images of {self._name} as JPEG, which is lossy; record with "
                "jpeg_encoding=False to keep them as they were",
                stacklevel=2,
            )

    def __len__(self) -> int:
        return self._data.total_episodes

    def __getitem__(self, i: int) -> Trajectory:
        episode, space = self._data[i], self._data.action_space
        source = f"{self._name} episode {episode.id}"
        if not hasattr(space, "low"):
            raise ValueError(f"{self._name} has the actions {space}; they must be a Box")
        limits = self._limits or (space.low, space.high)
        return self._trajectory(
            self._images(episode.observations),
            rescaled(np.asarray(episode.actions), *limits),
            np.asarray(episode.rewards),
            source=source,
            terminated=bool(episode.terminations[-1]),
        )

    def _images(self, observations: Any) -> np.ndarray:
        for key in self._key.split(".") if self._key else ():
            if key not in observations:
                raise ValueError(
                    f"{self._name} has no {key!r}; there are: {', '.join(observations)}"
                )
            observations = observations[key]
        if isinstance(observations, dict):
            raise ValueError(
                f"{self._name} has several observations; give image_key, one of: "
                f"{', '.join(observations)}"
            )
        return np.asarray(observations)
