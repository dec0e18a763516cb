"""RLDS episodes as TFDS stores them: TFRecord files, each record one episode's `tf.train.Example`.

Step t holds observation t and the action taken at it, with the reward it brought. The last step's
action means nothing (`is_last`), so that T + 1 steps are T actions and T + 1 images.

Read by hand, without TensorFlow: a record is its length (8 bytes), 4 bytes of checksum, the data
and 4 more; an Example is a protocol buffer of named lists of bytes, floats or integers. The
checksums are not verified; a file that is cut short or an image that is damaged is found anyway.
"""

import io
import os
import struct
import warnings
from collections.abc import Iterator, Sequence
from mmap import ACCESS_READ, mmap
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

JPEG = b"\xff\xd8"


class RldsEpisodes(Episodes):
    """The episodes of all TFRecord files in a folder and the folders in it, by file name.

    :param folder: of one dataset version and, for one split alone, with `split`
    :param image_key: which image of the observation, if there are several
    :param action_key: the action, or the part of it to take
    :param low: (A,) the actions' limits, if they are not in [-1, 1]
    :param high: (A,)
    :param split: only files of this split, `train` for example
    """

    def __init__(
        self,
        folder: str | os.PathLike[str],
        image_key: str | None = None,
        action_key: str = "action",
        low: Sequence[float] | None = None,
        high: Sequence[float] | None = None,
        split: str | None = None,
        **options: Any,
    ) -> None:
        super().__init__(**options)
        self._key, self._action = image_key, action_key
        self._limits = both_limits(low, high)
        self._folder = Path(folder)
        pattern = f"*-{split}.tfrecord*" if split else "*.tfrecord*"
        records = [
            (file, at, size, single)
            for file in sorted(self._folder.rglob(pattern))
            for at, size, single in _records(file)
        ]
        if not records:
            raise ValueError(f"{folder} holds no episode in files named {pattern}")
        self._records = [record[:3] for record in records if not record[3]]
        warn_left_out(len(records) - len(self._records), folder)
        self._warned = False

    def __len__(self) -> int:
        return len(self._records)

    def __getitem__(self, i: int) -> Trajectory:
        file, at, size = self._records[i]
        source = f"{file.relative_to(self._folder).as_posix()} at byte {at}"
        with open(file, "rb") as opened:
            opened.seek(at)
            steps = _steps(opened.read(size), source)
        image = self._images(steps, source)
        action = self._find(steps, self._action, source)
        action = np.asarray(action, np.float32).reshape(len(image), -1)[:-1]
        if self._limits:
            action = rescaled(action, *self._limits)
        reward = steps.get("reward")
        return self._trajectory(
            image,
            action,
            None if reward is None else np.asarray(reward, np.float32)[:-1],
            source,
            terminated=bool(np.any(steps.get("is_terminal", [0])[-1:])),
        )

    def _find(self, steps: dict[str, Any], key: str, source: str) -> Any:
        if key not in steps:
            raise ValueError(f"{source} has no {key!r} in its steps; there are: {', '.join(steps)}")
        return steps[key]

    def _images(self, steps: dict[str, Any], source: str) -> np.ndarray:
        """The episode's images, each resized as soon as it is decoded."""
        pictures = sorted(
            k for k, v in steps.items() if isinstance(v, list) and v and _is_picture(v[0])
        )
        key = self._key if self._key is None or "/" in self._key else f"observation/{self._key}"
        if key is None and len(pictures) != 1:
            raise ValueError(
                f"{source} has {len(pictures)} images a step; give image_key, one of: "
                f"{', '.join(pictures) or 'none, it has no images'}"
            )
        encoded = self._find(steps, key or pictures[0], source)
        if key is not None and key not in pictures:
            raise ValueError(
                f"{source} has no images under {key!r}; give image_key, one of: "
                f"{', '.join(pictures) or 'none, it has no images'}"
            )
        if encoded[0].startswith(JPEG) and not self._warned:
            self._warned = True
            warnings.warn(f"The images of {self._folder} are JPEG, which is lossy", stacklevel=4)
        image, found = needs("PIL.Image", "images in RLDS datasets"), []
        for each in encoded:
            try:
                picture = np.array(image.open(io.BytesIO(each)).convert("RGB"))
            except (OSError, SyntaxError) as error:
                raise ValueError(f"{source} has a damaged image: {error}") from error
            found.append(as_images(picture[None], self.image_size))
        return np.concatenate(found)


def _is_picture(data: bytes) -> bool:
    return data.startswith((JPEG, b"\x89PNG"))


def _records(file: Path) -> Iterator[tuple[int, int, bool]]:
    """Yields where each record's data begin, how long they are, and whether it is `_is_single`."""
    end, at = file.stat().st_size, 0
    if not end:
        return
    with open(file, "rb") as opened:
        data = memoryview(mmap(opened.fileno(), 0, access=ACCESS_READ))
    while at < end:
        head = data[at : at + 12]
        size = struct.unpack("<Q", head[:8])[0] if len(head) == 12 else end
        if at + 16 + size > end:
            raise ValueError(f"{file} is cut short: a record at byte {at} goes past its end")
        yield at + 12, size, _is_single(data[at + 12 : at + 12 + size])
        at += 16 + size


def _is_single(data: memoryview) -> bool:
    """Whether an episode has one step; its images are skipped, and damage is found later."""
    try:
        for name, feature in _features(data):
            if name == "steps/is_first":
                return [len(_values(*each)) for each in _fields(feature)] == [1]
    except (KeyError, IndexError, TypeError, ValueError):
        pass
    return False


def _features(data: memoryview) -> Iterator[tuple[str, memoryview]]:
    """The names and values of a tf.train.Example."""
    for _, features in _fields(data):
        for _, entry in _fields(features):
            pair = dict(_fields(entry))
            if 2 in pair:
                yield bytes(pair[1]).decode(), pair[2]


def _steps(data: bytes, source: str) -> dict[str, Any]:
    """The lists of an episode's steps by name: bytes in a list, numbers in an array."""
    steps: dict[str, Any] = {}
    try:
        for name, feature in _features(memoryview(data)):
            if name.startswith("steps/"):
                steps |= {name[6:]: _values(*each) for each in _fields(feature)}
    except (KeyError, IndexError, TypeError, ValueError) as error:
        raise ValueError(f"{source} is damaged or no tf.train.Example: {error}") from error
    if not steps:
        raise ValueError(f"{source} holds no 'steps/...': it is no RLDS episode")
    return steps


def _values(kind: int, data: memoryview) -> Any:
    """BytesList, FloatList or Int64List, packed as TensorFlow writes them or not."""
    values = [value for _, value in _fields(data)]
    if kind == 1:
        return [bytes(value) for value in values]
    if kind == 2:
        return np.frombuffer(b"".join(values), "<f4")
    numbers: list[int] = []
    for value in values:
        if isinstance(value, int):
            numbers.append(value)
            continue
        at = 0
        while at < len(value):
            number, at = _varint(value, at)
            numbers.append(number)
    return np.array(numbers, np.uint64).view(np.int64)


def _fields(data: memoryview) -> Iterator[tuple[int, Any]]:
    """Yields (number, value) of a protocol buffer's fields: an int, or the bytes as they are."""
    at = 0
    while at < len(data):
        key, at = _varint(data, at)
        if key & 7 == 0:
            value, at = _varint(data, at)
            yield key >> 3, value
            continue
        if key & 7 == 2:
            size, at = _varint(data, at)
        else:
            size = {1: 8, 5: 4}[key & 7]
        if at + size > len(data):
            raise ValueError("a field goes past the end")
        yield key >> 3, data[at : at + size]
        at += size


def _varint(data: memoryview, at: int) -> tuple[int, int]:
    """A base-128 number at `at`, and where the next thing begins."""
    value, shift = 0, 0
    while True:
        byte = data[at]
        value |= (byte & 127) << shift
        at, shift = at + 1, shift + 7
        if byte < 128:
            return value, at
