"""TFRecord files, whose records are a `tf.train.Example` each, read without TensorFlow.

A record is its length (8 bytes), 4 bytes of checksum, the data and 4 more; an Example is a protocol
buffer of named lists of bytes, floats or integers. The checksums are not verified; truncated
files and damaged images are detected anyway.
"""

import struct
from collections.abc import Iterator
from mmap import ACCESS_READ, mmap
from pathlib import Path
from typing import Any

import numpy as np

GZIP, ZLIB = b"\x1f\x8b", b"\x78\x9c"


def find_records(file: Path) -> Iterator[tuple[int, int, bool]]:
    """Yield offset and length of each record's data, and whether it has at most one step.

    :raises ValueError: if the file is truncated or compressed
    """
    end = file.stat().st_size
    at = 0
    if not end:
        return
    with open(file, "rb") as opened:
        data = memoryview(mmap(opened.fileno(), 0, access=ACCESS_READ))
    while at < end:
        head = data[at : at + 12]
        size = struct.unpack("<Q", head[:8])[0] if len(head) == 12 else end
        if at + 16 + size > end:
            raise _unreadable(file, at, bytes(data[:2]))
        yield at + 12, size, _is_single(data[at + 12 : at + 12 + size])
        at += 16 + size


def _unreadable(file: Path, at: int, begin: bytes) -> ValueError:
    """Return the error for a record that goes past the end of its file.

    The first bytes alone do not say that a file is compressed: they may be a record's length.

    :param begin: the first two bytes of the file
    """
    if begin == GZIP:
        return ValueError(
            f"{file} is compressed by gzip as a whole; unpack it first, for example by "
            f"`gunzip < {file.name} > unpacked/{file.name}`"
        )
    if begin == ZLIB:
        return ValueError(f"{file} is compressed by zlib as a whole; write it without compression")
    return ValueError(f"{file} is cut short: a record at byte {at} goes past its end")


def _is_single(data: memoryview) -> bool:
    """Return whether an episode has one step or none. Images are skipped, damage is found later."""
    try:
        for name, feature in _features(data):
            if name == "steps/is_first":
                return sum(len(_values(*field)) for field in _fields(feature)) <= 1
    except (KeyError, IndexError, TypeError, ValueError):
        pass
    return False


def _features(data: memoryview) -> Iterator[tuple[str, memoryview]]:
    """Yield the names and values of a tf.train.Example."""
    for _, features in _fields(data):
        for _, entry in _fields(features):
            pair = dict(_fields(entry))
            if 2 in pair:
                yield bytes(pair[1]).decode(), pair[2]


def read_steps(data: bytes, source: str) -> dict[str, Any]:
    """Return the lists of an episode's steps by name: bytes as a list, numbers as an array."""
    steps: dict[str, Any] = {}
    try:
        for name, feature in _features(memoryview(data)):
            if name.startswith("steps/"):
                steps |= {name[6:]: _values(*field) for field in _fields(feature)}
    except (KeyError, IndexError, TypeError, ValueError) as error:
        raise ValueError(f"{source} is damaged or no tf.train.Example: {error}") from error
    if not steps:
        raise ValueError(f"{source} has no 'steps/...': it is not an RLDS episode")
    return steps


def _values(kind: int, data: memoryview) -> Any:
    """Read a BytesList, FloatList or Int64List, packed (as TensorFlow writes them) or not."""
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
    """Yield (number, value) of a protocol buffer's fields; a value is an int or bytes."""
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
    """Return the base-128 number at `at`, and the offset after it."""
    value = 0
    shift = 0
    while True:
        byte = data[at]
        value |= (byte & 127) << shift
        at += 1
        shift += 7
        if byte < 128:
            return value, at
