"""Compare the dataset with other formats, and measure it at the paper's scale.

Times are CPU time of this process, all its threads, with the files in the page cache.
"""

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import nullcontext
from dataclasses import replace
from importlib import import_module
from importlib.util import find_spec
from itertools import chain
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch

from wpt_agents.agents.wpt import WPT
from wpt_agents.data.dataset import TrajectoryDataset
from wpt_agents.data.trajectory import Trajectory
from wpt_agents.data.windows import Windows
from wpt_agents.zoo.bench.formats import FORMATS, Read, store
from wpt_agents.zoo.bench.timing import memory_mib
from wpt_agents.zoo.collect.collection import collect
from wpt_agents.zoo.collect.workers import worker_pool

Rows = Iterator[dict[str, Any]]
BATCH = 16, 64  # Table 2's
DMC = [
    f"wpt/dmc-{n}-v0" for n in ("walker-run", "cartpole-swingup", "cheetah-run", "quadruped-run")
]
METAWORLD = [
    f"wpt/metaworld-{n}-v0" for n in ("drawer-close", "button-press-topdown", "assembly", "hammer")
]
STEPS = 167  # so that 60,000 trajectories have the paper's 10 million transitions
NEAR = {"rendering": "near"}


def rows(quick: bool = False, folder: Path | None = None) -> Rows:
    """Yield a row for each case; see `compare`, `sampling` and `large_store` for the columns.

    :param quick: use few synthetic frames and a small store, only to check that it runs
    :param folder: the folder of frames and stores (6 GB); existing ones are reused
    """
    with nullcontext(folder) if folder else TemporaryDirectory() as place:
        path = Path(place)
        frames = {"synthetic": synthetic(4, 99)} if quick else collected(path)
        for name, trajectories in frames.items():
            yield from compare(name, trajectories, draws=1 if quick else 20)
        every = list(chain.from_iterable(frames.values()))
        if quick:
            yield from sampling(every, "debug", updates=1)
            yield from large_store(path / "large", count=10, copies=2, workers=[2])
        else:
            yield from sampling(every, "tiny", updates=5)
            yield from large_store(path / "large", count=600, copies=100, workers=[0, 4])


def synthetic(count: int, steps: int, seed: int = 0) -> list[Trajectory]:
    """Sprites that move over a patchwork, with noise on 64 bytes per image."""
    rng = np.random.default_rng(seed)
    return [_synthetic(rng, steps) for _ in range(count)]


def _synthetic(rng: np.random.Generator, steps: int) -> Trajectory:
    patches = rng.integers(256, size=(8, 8, 3), dtype=np.uint8)
    ground = patches.repeat(8, axis=0).repeat(8, axis=1)
    image = np.broadcast_to(ground, (steps + 1, 64, 64, 3)).copy()
    for _ in range(3):
        sprite = rng.integers(256, size=(8, 8, 3), dtype=np.uint8)
        way = np.cumsum(rng.integers(-2, 3, (steps + 1, 2)), axis=0) % 56
        for frame, (y, x) in zip(image, way, strict=True):
            frame[y : y + 8, x : x + 8] = sprite
    flat = image.reshape(steps + 1, -1)
    noisy = rng.integers(flat.shape[1], size=(steps + 1, 64))
    flat[np.arange(steps + 1)[:, None], noisy] = rng.integers(256, size=noisy.shape)
    action = rng.uniform(-1, 1, (steps, 6)).astype(np.float32)
    return Trajectory(image, action, embodiment="sprites", source="synthetic")


def collected(path: Path) -> dict[str, list[Trajectory]]:
    """8 episodes of DMControl, 20 of Meta-World, and the latter with camera noise."""
    dmc = collect(path / "dmc", DMC, 2, workers=1, env=NEAR)
    metaworld = collect(path / "mw", METAWORLD, 5, workers=1, behaviour="scripted", env=NEAR)
    rng = np.random.default_rng(0)
    noisy = [replace(t, image=_noisy(t.image, rng)) for t in metaworld]
    return {"DMControl": list(dmc), "Meta-World": list(metaworld), "Meta-World, noisy": noisy}


def _noisy(image: np.ndarray, rng: np.random.Generator, sigma: float = 2.0) -> np.ndarray:
    return np.clip(np.rint(image + rng.normal(0, sigma, image.shape)), 0, 255).astype(np.uint8)


def compare(name: str, trajectories: Sequence[Trajectory], draws: int) -> Rows:
    """Measure each format on the same frames: bytes per frame, ratio to raw, error, speeds."""
    for form in FORMATS:
        what = {"what": "format", "frames": name, "format": form}
        package = FORMATS[form][1]
        if find_spec(package) is not None:
            import_module(package)  # excluded from the time of writing
            with TemporaryDirectory() as place:
                yield what | _measure(Path(place), form, trajectories, draws)
        else:
            yield what | {"absent": f"pip install {package}"}


def _measure(
    path: Path, form: str, trajectories: Sequence[Trajectory], draws: int
) -> dict[str, Any]:
    images = sum(len(t.image) for t in trajectories)
    raw = images * trajectories[0].image[0].nbytes
    began = time.process_time()
    read = FORMATS[form][0](path, trajectories)
    writing = time.process_time() - began
    stored = sum(file.stat().st_size for file in path.rglob("*") if file.is_file())
    off = [
        np.abs(read(i, 0, len(t.image)).astype(int) - t.image).mean()
        for i, t in list(enumerate(trajectories))[::4]
    ]
    if form.startswith("store"):
        dataset = TrajectoryDataset.open(path / "store")
        seconds = _seconds(lambda k: dataset.sample(*BATCH, rng=np.random.default_rng(k)), draws)
    else:
        windows = Windows(np.array([len(t) for t in trajectories]))
        seconds = _seconds(lambda k: _windows(windows, read, k), max(1, draws // 10))
    return {
        "bytes_per_frame": round(stored / images),
        "ratio": round(raw / stored, 2),
        "mean_error": round(float(np.mean(off)), 2),
        "write_mb_per_s": round(raw / 1e6 / writing),
        "windows_per_s": round(BATCH[0] / seconds, 1),
    }


def _windows(windows: Windows, read: Read, seed: int) -> torch.Tensor:
    chosen = windows.draw(*BATCH, np.random.default_rng(seed))
    return torch.stack(
        [torch.from_numpy(np.concatenate([read(*p) for p in row])) for row in chosen]
    )


def _seconds(draw: Callable[[int], object], draws: int) -> float:
    """Return the CPU seconds per draw, after one warm-up draw."""
    draw(0)
    began = time.process_time()
    for k in range(1, draws + 1):
        draw(k)
    return (time.process_time() - began) / draws


def sampling(trajectories: Sequence[Trajectory], size: str, updates: int) -> Rows:
    """Compare the CPU time of a B16 x T64 batch with that of a world-model update on it."""
    with TemporaryDirectory() as place:
        store(Path(place), trajectories, "zstd")
        dataset = TrajectoryDataset.open(Path(place) / "store")
        batch = _seconds(lambda k: dataset.sample(*BATCH, rng=np.random.default_rng(k)), 20)
        at: list[float] = []
        WPT.pretrain(
            dataset,
            steps=updates + 1,
            size=size,
            max_action_dim=dataset.max_action_dim,
            callback=lambda step, metrics: at.append(time.process_time()),
            seed=0,
        )
        update = float(np.median(np.diff(at))) - batch
    yield {
        "what": "sampling",
        "size": size,
        "batch_ms": round(1e3 * batch, 1),
        "update_ms": round(1e3 * update, 1),
        "times_faster": round(update / batch, 1),
    }


def large_store(path: Path, count: int, copies: int, workers: Sequence[int]) -> Rows:
    """Measure a store of `count` synthetic trajectories, each `copies` times, in a new process."""
    make_store(path, count, copies)
    for threads in workers:
        with worker_pool(1) as pool:
            yield {"what": "large store", **pool.submit(use_store, path, threads).result()}


def make_store(path: Path, count: int, copies: int) -> None:
    """Write `count` trajectories `copies` times; existing ones are kept."""
    with TrajectoryDataset.open_or_create(path.with_name(f"{path.name}-base")) as base:
        base.extend(synthetic(count, STEPS)[len(base) :])
    with TrajectoryDataset.open_or_create(path) as dataset:
        while len(dataset) < count * copies:
            dataset.extend(base.subset(range(len(dataset) % count, count)))


def use_store(path: Path, workers: int, draws: int = 50) -> dict[str, Any]:
    """Open a store and sample: seconds, windows per second, and additional resident memory."""
    before = memory_mib("VmRSS")
    began = time.process_time()
    dataset = TrajectoryDataset.open(path, workers)
    opening = time.process_time() - began
    batches = dataset.batches(*BATCH, action_width=6, seed=0)
    seconds = _seconds(lambda k: next(batches), draws)
    info = dataset.info()
    batches.close()
    dataset.close()
    return {
        "workers": workers,
        "trajectories": info["trajectories"],
        "transitions": info["transitions"],
        "gb": round(info["bytes"] / 1e9, 2),
        "open_s": round(opening, 2),
        "windows_per_s": round(BATCH[0] / seconds),
        "resident_mib": round(memory_mib("VmHWM") - before, 0),
    }
