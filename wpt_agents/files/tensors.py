"""Safetensors, written to and read from an open file one tensor at a time.

The format is 8 bytes with the length of a JSON header, the header, and the tensors' bytes. The
functions of the package `safetensors` need up to two more copies of all tensors in memory, which
are gigabytes for a model of the paper's size. What `write_tensors` writes is, byte for byte, what
`safetensors.torch.save` returns.
"""

import json
import math
from collections.abc import Mapping
from typing import IO, Any

import torch
from torch import Tensor

TYPES = {  # in the format's own order, by which tensors are sorted, last first
    "BOOL": torch.bool,
    "U8": torch.uint8,
    "I8": torch.int8,
    "I16": torch.int16,
    "F16": torch.float16,
    "BF16": torch.bfloat16,
    "I32": torch.int32,
    "F32": torch.float32,
    "F64": torch.float64,
    "I64": torch.int64,
}
NAMES = {dtype: name for name, dtype in TYPES.items()}
ALIGNMENT, PIECE = 8, 2**24  # bytes


def write_tensors(file: IO[bytes], tensors: Mapping[str, Tensor]) -> None:
    """Write tensors to a file that is open for writing."""
    rank = {dtype: i for i, dtype in enumerate(reversed(NAMES))}
    names = sorted(tensors, key=lambda name: (rank[tensors[name].dtype], name))
    header, end = dict[str, Any](), 0
    for name in names:
        tensor = tensors[name]
        start, end = end, end + tensor.numel() * tensor.element_size()
        header[name] = {"dtype": NAMES[tensor.dtype], "shape": list(tensor.shape)}
        header[name]["data_offsets"] = [start, end]
    text = json.dumps(header, separators=(",", ":"), ensure_ascii=False).encode()
    # padded like the reference implementation, so that tensors begin at a multiple of 8
    text += b" " * (-len(text) % ALIGNMENT)
    file.write(len(text).to_bytes(8, "little"))
    file.write(text)
    for name in names:
        flat = tensors[name].detach().cpu().contiguous().reshape(-1)
        file.write(flat.view(torch.uint8).numpy().data)


def read_tensors(file: IO[bytes], length: int) -> dict[str, Tensor]:
    """Read the tensors of a file that is open for reading, to its end.

    :param length: the length of the file in bytes
    :raises ValueError: if the file is not in this format
    """
    size = int.from_bytes(_filled(bytearray(8), file), "little")
    if size > length - 8:
        raise ValueError(f"its header of {size} bytes is longer than the file")
    header = json.loads(_filled(bytearray(size), file))
    header.pop("__metadata__", None)
    tensors, end = dict[str, Tensor](), 0
    for name, entry in sorted(header.items(), key=lambda item: item[1]["data_offsets"]):
        dtype, shape = TYPES[entry["dtype"]], entry["shape"]
        start, stop = entry["data_offsets"]
        fits = start == end and stop - start == math.prod(shape) * dtype.itemsize
        if not fits or stop > length - 8 - size or min(shape, default=0) < 0:
            raise ValueError(f"its header is inconsistent at {name!r}")
        # read into its final place, so that no second copy is in memory
        memory = torch.empty(stop - start, dtype=torch.uint8)
        _filled(memory.numpy().data, file)
        tensors[name], end = memory.view(dtype).reshape(shape), stop
    # reading to the end makes a zip archive verify the checksum
    if end != length - 8 - size or file.read(1):
        raise ValueError("it is longer than its header says")
    return tensors


def _filled(memory: Any, file: IO[bytes]) -> Any:
    """Fill a buffer from a file in chunks, and return it."""
    view = memoryview(memory)
    for start in range(0, len(view), PIECE):
        piece = file.read(min(PIECE, len(view) - start))
        view[start : start + len(piece)] = piece
        if len(piece) < min(PIECE, len(view) - start):
            raise EOFError("it ends too early")
    return memory
