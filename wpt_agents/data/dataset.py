"""The dataset of recorded trajectories (D_off of the paper): a folder, read lazily.

Example::

    with TrajectoryDataset.create("walker") as dataset:
        dataset.append(Trajectory(image, action, embodiment="walker"))
    dataset = TrajectoryDataset.open("walker")
    batch = dataset.sample(16, 64)
"""

import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

from wpt_agents.data.codecs import find_codec
from wpt_agents.data.folder import Folder
from wpt_agents.data.images import Resizer
from wpt_agents.data.index import (
    Entry,
    Meta,
    add_damaged,
    create_folder,
    read_index,
    read_meta,
    undamaged,
)
from wpt_agents.data.reading import StoredTrajectories
from wpt_agents.data.shards import Writer, read_blocks
from wpt_agents.data.trajectory import IMAGE_SIZE, Trajectory
from wpt_agents.data.upkeep import Damage, count_set_aside, describe, find_damage

Source = str | os.PathLike[str]
Door = Callable[..., "TrajectoryDataset"]


class TrajectoryDataset(StoredTrajectories):
    """Recorded trajectories in a folder, with one writer and any number of readers.

    Make a dataset with `create`, `open`, `of` (anything that can serve as a dataset) or one of
    `from_hdf5`, `from_lerobot`, `from_minari`, `from_npz`, `from_official`, `from_rlds`,
    `from_sb3`, `from_tdmpc2` and `from_zarr` (other formats). A reader sees the trajectories that
    were there when it opened the folder. `wpt_agents.data.shards` describes the files.

    Example::

        with TrajectoryDataset.create("data/arm") as dataset:
            dataset.append(Trajectory(image, action, embodiment="arm"))
        dataset = TrajectoryDataset.open("data/arm")
        batch = dataset.sample(16, 64)  # 16 sequences of 64 images
    """

    # `wpt_agents.data.convert` assigns these constructors, since this class knows no other format;
    # `wpt_agents.data` imports that module, so they are always there.
    of: ClassVar[Door]
    from_episodes: ClassVar[Door]
    from_hdf5: ClassVar[Door]
    from_lerobot: ClassVar[Door]
    from_minari: ClassVar[Door]
    from_npz: ClassVar[Door]
    from_official: ClassVar[Door]
    from_rlds: ClassVar[Door]
    from_sb3: ClassVar[Door]
    from_tdmpc2: ClassVar[Door]
    from_zarr: ClassVar[Door]

    def __init__(
        self,
        folders: Sequence[Folder],
        entries: list[Entry],
        folder_of: Sequence[int] | None = None,
        ids: Sequence[int] | None = None,
        workers: int = 0,
    ) -> None:
        super().__init__(folders, entries, folder_of, ids, workers)
        self.path = Path(", ".join(str(folder.path) for folder in self._folders))
        self._writer: Writer | None = None
        self._resize = Resizer(self.image_size, crop_option="append(trajectory, crop=True)")

    def __repr__(self) -> str:
        """The folder, counts, robots and the widths of their actions."""
        robots = sorted({name or "unnamed" for name in self.embodiments})
        return (
            f"<{type(self).__name__} {str(self.path)!r}: {len(self)} trajectories, "
            f"{int(self.lengths.sum())} transitions, robots: {', '.join(robots)}, "
            f"actions: {', '.join(map(str, sorted(set(self.action_dims))))}>"
        )

    @classmethod
    def create(
        cls,
        path: Source,
        image_size: int = IMAGE_SIZE,
        codec: str = "zstd",
        workers: int = 0,
    ) -> "TrajectoryDataset":
        """Make an empty dataset in a new or empty folder.

        :param path: the folder
        :param image_size: height and width of the images, to which others are resized
        :param codec: "zstd" (lossless, about a sixth of the size for simulated images), "raw", or
            "jpeg" (lossy, about a fourth of the size; for camera images, whose noise zstd cannot
            compress)
        :param workers: number of threads that decompress
        :raises ValueError: an unknown codec, or a folder that is not empty
        """
        find_codec(codec)
        create_folder(Path(path).expanduser(), Meta(image_size, codec))
        return cls.open(path, workers)

    @classmethod
    def open(cls, path: Source, workers: int = 0) -> "TrajectoryDataset":
        """Open a dataset. Only its index is read; trajectories that were set aside are left out.

        :param path: the folder
        :param workers: number of threads that decompress
        :raises ValueError: there is no dataset, it is of a newer version, or its index is damaged
        """
        path = Path(path).expanduser().absolute()  # the process may go to another folder later
        meta = read_meta(path)
        find_codec(meta.codec)
        return cls([Folder(path, meta)], undamaged(path, read_index(path)[0]), workers=workers)

    @classmethod
    def open_or_create(cls, path: Source, image_size: int = IMAGE_SIZE) -> "TrajectoryDataset":
        """Open the dataset at `path`, or make an empty one where there is none.

        :param path: the folder
        :param image_size: height and width of the images of a new dataset
        :raises ValueError: as `open` and `create`
        """
        there = (Path(path).expanduser() / "meta.json").exists()
        return cls.open(path) if there else cls.create(path, image_size)

    @classmethod
    def merge(
        cls,
        path: Source,
        datasets: Sequence["TrajectoryDataset | Source"],
        workers: int = 0,
        image_size: int | None = None,
    ) -> "TrajectoryDataset":
        """Copy all trajectories of `datasets`, in their order, into a new dataset at `path`.

        It has their codec, or the lossless "zstd" if their codecs differ.

        :param path: a new or empty folder
        :param datasets: datasets or their folders
        :param workers: number of threads that decompress
        :param image_size: resize the images to this size; required if the datasets' sizes differ
        :raises ValueError: no datasets, images of different sizes, a folder that is not empty, or a
            damaged trajectory; those before it are kept
        """
        opened = [d if isinstance(d, TrajectoryDataset) else cls.open(d) for d in datasets]
        sizes = {dataset.image_size: dataset.path for dataset in opened}
        if not opened:
            raise ValueError("merge got no dataset; pass a list of datasets or of their folders")
        if image_size is None and len(sizes) > 1:
            there = ", ".join(f"{path} has {size}" for size, path in sizes.items())
            raise ValueError(
                f"merge needs datasets of one image size: {there}; pass image_size=64 to resize all"
            )
        codecs = {folder.meta.codec for dataset in opened for folder in dataset._folders}
        codec = codecs.pop() if len(codecs) == 1 else "zstd"
        with cls.create(path, image_size or opened[0].image_size, codec) as merged:
            for dataset in opened:
                merged.extend(dataset)
        return cls.open(path, workers)

    @classmethod
    def join(cls, datasets: Sequence["TrajectoryDataset"]) -> "TrajectoryDataset":
        """Return a read-only view of several datasets as one; nothing is copied.

        :param datasets: at least one
        :raises ValueError: no datasets, or images of different sizes
        """
        if not datasets:
            raise ValueError("join got no dataset; pass a list of datasets")
        if len({dataset.image_size for dataset in datasets}) != 1:
            sizes = ", ".join(f"{d.path} has {d.image_size}" for d in datasets)
            raise ValueError(
                f"Datasets that are used together need one image size: {sizes}; "
                "copy them by TrajectoryDataset.merge(path, datasets, image_size=64)"
            )
        folders: list[Folder] = []
        entries: list[Entry] = []
        folder_of: list[int] = []
        ids: list[int] = []
        for dataset in datasets:
            for i, entry in enumerate(dataset._entries):
                number = 0 if dataset._folder_of is None else dataset._folder_of[i]
                entries.append(entry)
                folder_of.append(len(folders) + number)
                ids.append(dataset._id(i))
            folders += dataset._folders
        view = cls(folders, entries, folder_of, ids, max(d.workers for d in datasets))
        view._whole = list(datasets)
        return view

    def append(self, trajectory: Trajectory, crop: bool = False) -> None:
        """Add a trajectory at the end. Once this returns, readers who open the folder see it.

        Images of another size are resized, with one warning for each size.

        :param trajectory: with images of any size, as `Trajectory` describes them
        :param crop: cut out the middle square of images that are not square, instead of squeezing
        :raises ValueError: non-zero numbers in the actions' padding, a read-only view, or another
            process that is writing to the folder
        """
        if trajectory.image.shape[1:3] != (self.image_size, self.image_size):
            self._resize.crop = crop
            trajectory = replace(trajectory, image=self._resize(trajectory.image))
        if trajectory.action[:, trajectory.action_dim :].any():
            raise ValueError(
                f"Actions past action_dim={trajectory.action_dim} must be zero; "
                f"pass the true action_dim, of at most {trajectory.action.shape[1]}"
            )
        entry = self._begin().append(trajectory)  # `_begin` may replace the list of entries
        self._entries.append(entry)
        self._windows = None

    def extend(self, trajectories: Iterable[Trajectory]) -> None:
        """Add trajectories one by one; those that were added stay if a later one is refused.

        Trajectories of another dataset with the same codec are copied as they are stored: checked,
        but not decoded.

        :param trajectories: another dataset, or any trajectories
        :raises ValueError: as `append`, or a damaged trajectory of the other dataset
        """
        if isinstance(trajectories, TrajectoryDataset):
            metas = {folder.meta for folder in trajectories._folders}
            if metas == {self._folders[0].meta}:
                return trajectories._copy_to(self)
        for trajectory in trajectories:
            self.append(trajectory)

    def _copy_to(self, other: "TrajectoryDataset") -> None:
        writer = other._begin()
        for i, entry in enumerate(list(self._entries)):
            blocks = self._attempt(
                i, lambda folder, e: list(read_blocks(folder.path, e, 0, len(e.sizes) - 1))
            )
            other._entries.append(writer.copy(blocks, entry))
            other._windows = None

    def reserve(self) -> None:
        """Take the write lock now, not at the first append, and read what others appended.

        :raises ValueError: another process writes, or this is a read-only view
        """
        self._begin()

    def _begin(self) -> Writer:
        """Return the writer, which takes the lock when it is made and sees what others appended."""
        if self.is_subset:
            raise ValueError("A subset is read-only; append to the dataset it was taken from")
        if self._writer is None:
            self._writer = Writer(self.path, self._folders[0].meta)
            self._entries = self._writer.entries
            self._windows = None
        return self._writer

    def flush(self) -> None:
        """Force what was appended to the disk, so that it survives a power failure.

        Without it, appended trajectories survive a killed process, but not a power failure.
        """
        if self._writer is not None:
            self._writer.flush()

    def close(self) -> None:
        """Release the write lock and end the threads; the dataset can still be read."""
        if self._writer is not None:
            self._writer.close()
            self._writer = None
        self._threads.close()

    def __getstate__(self) -> dict[str, Any]:
        """Return the state for copies and pickles, which read the same folder without the lock."""
        return {**vars(self), "_writer": None}

    def __enter__(self) -> "TrajectoryDataset":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def info(self) -> dict[str, Any]:
        """Return counts of trajectories, transitions, robots, tasks and bytes as a dictionary.

        `compression` is the ratio of the raw size of the images to the stored size, which includes
        actions and rewards.
        """
        return describe(self._folders, self._entries)

    @property
    def appended(self) -> int:
        """The number of trajectories ever appended: those here, and those set aside."""
        return len(self) + count_set_aside(self._folders)

    def validate(self, progress_bar: bool = False, set_aside: bool = False) -> list[Damage]:
        """Read every byte and list the damaged trajectories.

        :param progress_bar: show a progress bar
        :param set_aside: exclude the damaged ones, here and for everybody who opens the folder from
            now on; the trajectories after them get lower numbers. The file `damaged.json` in the
            folder lists them; delete it to include them again
        :return: the number and the damage of each damaged trajectory
        """
        damaged = find_damage(self._reason, len(self), self._threads.map, progress_bar)
        if set_aside and damaged:
            for folder in self._folders:
                mine = [d for d in damaged if self._folder(d.trajectory) == folder]
                places = {self._entries[d.trajectory].place: d.reason for d in mine}
                if places:
                    add_damaged(folder.path, places)
            self._leave_out({damage.trajectory for damage in damaged})
        return damaged

    def _reason(self, i: int) -> str | None:
        """Return why trajectory `i` cannot be read, or None."""
        try:
            self[i]
        except ValueError as error:
            return str(error)
        return None

    def _leave_out(self, gone: set[int]) -> None:
        keep = [i for i in range(len(self)) if i not in gone]
        self._entries = [self._entries[i] for i in keep]
        self._ids = None if self._ids is None else [self._ids[i] for i in keep]
        of = self._folder_of
        self._folder_of = None if of is None else [of[i] for i in keep]
        self._windows = None
