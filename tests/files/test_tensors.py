"""Tensors are written as the package safetensors writes them, and read one at a time."""

import io
import json
import tracemalloc

import pytest
import safetensors.torch
import torch

from wpt_agents.files.tensors import TYPES, read_tensors, write_tensors

MANY = {name.lower(): torch.arange(-3, 3).to(dtype) for name, dtype in TYPES.items()} | {
    "empty": torch.zeros(0, 3),
    "scalar": torch.tensor(2.5),
    "turned": torch.arange(12.0).reshape(3, 4).t(),
    "grüße": torch.ones(2, 1, 2, requires_grad=True),
}


def written(tensors):
    file = io.BytesIO()
    write_tensors(file, tensors)
    return file.getvalue()


def read(content):
    return read_tensors(io.BytesIO(content), len(content))


def with_header(header, data=b"\0" * 8):
    text = json.dumps(header).encode()
    return len(text).to_bytes(8, "little") + text + data


def test_the_bytes_are_those_of_the_package_safetensors():
    assert written(MANY) == safetensors.torch.save({k: v.contiguous() for k, v in MANY.items()})
    assert written({}) == safetensors.torch.save({})


def test_every_type_and_shape_comes_back():
    back = read(written(MANY))
    assert back.keys() == MANY.keys()
    for name, tensor in MANY.items():
        assert back[name].dtype == tensor.dtype and torch.equal(back[name], tensor), name


def test_metadata_of_other_writers_is_passed_over():
    content = safetensors.torch.save({"a": torch.ones(3)}, {"format": "pt"})
    assert torch.equal(read(content)["a"], torch.ones(3))


def test_neither_writing_nor_reading_makes_a_second_copy(tmp_path):
    tensors = {str(i): torch.zeros(2**20) for i in range(16)}  # 64 MB
    with open(tmp_path / "file", "wb") as file:
        tracemalloc.start()
        write_tensors(file, tensors)
        writing = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    with open(tmp_path / "file", "rb") as file:
        tracemalloc.start()
        read_tensors(file, (tmp_path / "file").stat().st_size)
        reading = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    assert writing < 2**20 and reading < 2**25  # of Python's memory; torch's own is not counted


F32 = {"dtype": "F32", "shape": [2], "data_offsets": [0, 8]}


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ((99).to_bytes(8, "little") + b"{}", "longer than the file"),
        (with_header({"a": F32 | {"shape": [3]}}), "inconsistent at 'a'"),
        (with_header({"a": F32 | {"shape": [-1, -2]}}), "inconsistent at 'a'"),
        (with_header({"a": F32 | {"data_offsets": [4, 12]}}, b"\0" * 12), "inconsistent at 'a'"),
        (with_header({"a": F32 | {"shape": [2**50], "data_offsets": [0, 2**52]}}), "inconsistent"),
        (with_header({"a": F32, "b": F32}), "inconsistent at 'b'"),
        (with_header({"a": F32}, b"\0" * 12), "longer than its header says"),
    ],
)
def test_a_header_that_does_not_fit_is_refused(content, message):
    with pytest.raises(ValueError, match=message):
        read(content)


def test_a_file_that_ends_too_early_is_refused():
    content = written(MANY)
    with pytest.raises(EOFError, match="ends too early"):
        read_tensors(io.BytesIO(content[:-1]), len(content))
