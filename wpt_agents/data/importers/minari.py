"""Minari datasets. The timing is ours: T + 1 observations, action t taken at observation t."""

import os
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from wpt_agents.data.importers.episodes import Episodes, needs
from wpt_agents.data.importers.keys import is_images
from wpt_agents.data.trajectory import Trajectory


def local_minari(name: str) -> Path:
    """Return the folder of a local Minari dataset."""
    root = os.environ.get("MINARI_DATASETS_PATH") or Path.home() / ".minari" / "datasets"
    return Path(root) / name


class MinariEpisodes(Episodes):
    """A Minari dataset's episodes; actions are rescaled from its action space to [-1, 1].

    :param name: a local dataset's name (`namespace/name-v0`), its folder, the `data` in it, or a
        MinariDataset
    :param options: those of `Episodes`; dots or slashes in keys separate the levels of nested
        dictionaries
    """

    def __init__(self, name: Any, **options: Any) -> None:
        super().__init__(**options)
        self._refuse_done_key("Minari")
        minari = needs("minari", "Minari datasets")
        if isinstance(name, str | os.PathLike):
            folder = Path(name)
            if folder.exists():
                inner = folder / "data"
                with _named(str(folder)):
                    self._data = minari.MinariDataset(inner if inner.exists() else folder)
            else:
                try:
                    self._data = minari.load_dataset(str(name))
                except FileNotFoundError as error:
                    raise FileNotFoundError(
                        f"{name} is neither a folder nor a Minari dataset in "
                        f"{local_minari('')}; to download one of Minari's, run: minari download "
                        f"{name}"
                    ) from error
        else:
            self._data = name
        self._name = self._data.spec.dataset_id
        if self._data.storage.metadata.get("jpeg_encoding"):
            warnings.warn(
                f"Minari stored the images of {self._name} as JPEG, which is lossy; record with "
                "jpeg_encoding=False to keep them as they were",
                stacklevel=2,
            )

    def __len__(self) -> int:
        return int(self._data.total_episodes)

    def __getitem__(self, i: int) -> Trajectory:
        with _named(f"Episode {i} of {self._name}"):
            episode = self._data[i]
        source = f"{self._name} episode {episode.id}"
        parts = [self._actions(key, episode.actions) for key in self.action_keys or ("",)]
        action, low, high = (np.concatenate(part, axis=-1) for part in zip(*parts, strict=True))
        return self._trajectory(
            self._images(episode.observations),
            action,
            np.asarray(episode.rewards),
            source,
            None if self.limits is not None else (low, high),
            terminated=bool(episode.terminations[-1]),
        )

    def _actions(self, key: str, actions: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the actions under a key, and the limits of their space."""
        space = self._data.action_space
        for part in _parts(key):
            space = space[part] if part in getattr(space, "spaces", {}) else None
        chosen = np.asarray(self._leaf(actions, key, "action_key"))
        if not hasattr(space, "low"):
            raise ValueError(f"{self._name} has the actions {space}; they must be a Box")
        # arrays of several keys are concatenated as columns, so each is flattened
        return chosen.reshape(len(chosen), -1), np.ravel(space.low), np.ravel(space.high)

    def _images(self, observations: Any) -> np.ndarray:
        """Return the images under `image_key`, or the only ones there are."""
        pictures = list(_pictures(observations)) if self.image_key is None else []
        if len(pictures) == 1:
            return pictures[0]
        return self._leaf(observations, self.image_key, "image_key")

    def _leaf(self, tree: Any, key: str | None, option: str) -> np.ndarray:
        """Return the array under a key in nested dictionaries.

        :raises ValueError: if there is nothing, or a dictionary
        """
        for part in _parts(key):
            if not isinstance(tree, dict) or part not in tree:
                there = ", ".join(tree) if isinstance(tree, dict) else "an array without keys"
                raise ValueError(f"{self._name} has no {part!r}; there are: {there}")
            tree = tree[part]
        if isinstance(tree, dict):
            raise ValueError(
                f"{self._name} has a dictionary of arrays; pass {option} "
                f"(--{option.replace('_', '-')}), one of: {', '.join(tree)}"
            )
        return np.asarray(tree)


@contextmanager
def _named(what: str) -> Iterator[None]:
    """Add the name of the damaged part, which the errors of HDF5 and Arrow lack."""
    try:
        yield
    except (OSError, KeyError, RuntimeError, AssertionError) as error:
        raise ValueError(
            f"{what} is damaged ({error}): download or record this Minari dataset again"
        ) from error


def _pictures(tree: Any) -> Iterator[np.ndarray]:
    """Iterate over the images in nested dictionaries."""
    if isinstance(tree, dict):
        for branch in tree.values():
            yield from _pictures(branch)
    elif is_images(np.asarray(tree)):
        yield np.asarray(tree)


def _parts(key: str | None) -> list[str]:
    return key.replace("/", ".").split(".") if key else []
