"""Formats for images of trajectories, written and read as their documentation recommends.

A format is a function that writes trajectories into a folder and returns a `Read`.
"""

import warnings
from collections.abc import Callable, Sequence
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

from wpt_agents.data.dataset import TrajectoryDataset
from wpt_agents.data.trajectory import Trajectory

Read = Callable[[int, int, int], np.ndarray]
"""(trajectory, first image, one past the last) -> images"""
Format = Callable[[Path, Sequence[Trajectory]], Read]


def memmap(path: Path, trajectories: Sequence[Trajectory]) -> Read:
    """All images in one raw file, mapped into memory."""
    at = np.cumsum([0, *(len(t.image) for t in trajectories)])
    shape = (int(at[-1]), *trajectories[0].image.shape[1:])
    images = np.lib.format.open_memmap(path / "image.npy", "w+", np.uint8, shape)
    for i, trajectory in enumerate(trajectories):
        images[at[i] : at[i + 1]] = trajectory.image
    images.flush()
    return lambda i, start, stop: np.array(images[at[i] + start : at[i] + stop])


def hdf5(path: Path, trajectories: Sequence[Trajectory], **how: Any) -> Read:
    """One dataset per trajectory, in chunks of 16 images."""
    h5py = import_module("h5py")
    with h5py.File(path / "data.hdf5", "w") as file:
        for i, trajectory in enumerate(trajectories):
            image = trajectory.image
            chunks = (min(16, len(image)), *image.shape[1:])
            file.create_dataset(str(i), data=image, chunks=chunks, **how)
    file = h5py.File(path / "data.hdf5", "r")
    return lambda i, start, stop: file[str(i)][start:stop]


def zarr(path: Path, trajectories: Sequence[Trajectory]) -> Read:
    """One array per trajectory, in chunks of 16 images, with zarr's default zstd."""
    group = import_module("zarr").open_group(str(path / "data.zarr"), mode="w")
    for i, trajectory in enumerate(trajectories):
        image = trajectory.image
        chunks = (min(16, len(image)), *image.shape[1:])
        made = group.create_array(str(i), shape=image.shape, chunks=chunks, dtype="uint8")
        made[:] = image
    arrays = [group[str(i)] for i in range(len(trajectories))]
    return lambda i, start, stop: arrays[i][start:stop]


def npz(path: Path, trajectories: Sequence[Trajectory]) -> Read:
    """One compressed .npz file per trajectory, as in ExORL and DrQ-v2."""
    for i, trajectory in enumerate(trajectories):
        np.savez_compressed(path / f"{i}.npz", observation=trajectory.image)

    def read(i: int, start: int, stop: int) -> np.ndarray:
        with np.load(path / f"{i}.npz") as file:
            return file["observation"][start:stop]

    return read


def minari(path: Path, trajectories: Sequence[Trajectory]) -> Read:
    """Minari with its defaults: JPEG in HDF5."""
    import gymnasium as gym

    minari = import_module("minari")
    episode = import_module("minari.data_collector").EpisodeBuffer
    buffers = [
        episode(
            observations=list(t.image),
            actions=list(t.action),
            rewards=[0.0] * len(t),
            terminations=[False] * len(t),
            truncations=[False] * (len(t) - 1) + [True],
        )
        for t in trajectories
    ]
    environment = mock.patch.dict("os.environ", MINARI_DATASETS_PATH=str(path))
    with environment, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # it warns about missing author, code and e-mail
        made = minari.create_dataset_from_buffers(
            "bench/frames-v0",
            buffers,
            observation_space=gym.spaces.Box(0, 255, trajectories[0].image.shape[1:], np.uint8),
            action_space=gym.spaces.Box(-1, 1, (trajectories[0].action.shape[1],), np.float32),
        )
    return lambda i, start, stop: made[i].observations[start:stop]


def store(path: Path, trajectories: Sequence[Trajectory], codec: str) -> Read:
    """The format of this library."""
    with TrajectoryDataset.create(path / "store", codec=codec) as dataset:
        dataset.extend(trajectories)
    return lambda i, start, stop: dataset[i].image[start:stop]


FORMATS: dict[str, tuple[Format, str]] = {  # and the package it needs
    "store, zstd (default)": (partial(store, codec="zstd"), "zstandard"),
    "store, raw": (partial(store, codec="raw"), "zstandard"),
    "store, jpeg": (partial(store, codec="jpeg"), "PIL"),
    "memmap": (memmap, "numpy"),
    "HDF5": (hdf5, "h5py"),
    "HDF5, gzip 1": (partial(hdf5, compression="gzip", compression_opts=1), "h5py"),
    "HDF5, lzf": (partial(hdf5, compression="lzf"), "h5py"),
    "zarr": (zarr, "zarr"),
    "npz": (npz, "numpy"),
    "Minari": (minari, "minari"),
}
