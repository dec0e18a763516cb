"""Archives of arrays that were damaged on the disk."""

import errno
import os
import stat
from contextlib import nullcontext

import numpy as np
import pytest

from wpt_agents.files.archive import load_arrays, save_arrays

FLAGS = 8  # the places of fields in an entry of the zip's central directory
METHOD = 10
OFFSET = 42


@pytest.mark.parametrize(
    ("field", "value"),
    [(FLAGS, 1), (METHOD, 8), (METHOD, 99), (OFFSET + 3, 0xFF)],
    ids=["encrypted", "compressed", "unknown compression", "out of the file"],
)
def test_a_damaged_directory_is_a_value_error(field, value, tmp_path):
    path = tmp_path / "arrays"
    save_arrays(path, "Test", {}, {"a": np.full(50, 0xFF, np.uint8)})
    content = bytearray(path.read_bytes())
    content[content.rindex(b"PK\x01\x02") + field] = value
    path.write_bytes(content)
    with pytest.raises(ValueError, match="arrays is damaged or not a Test"):
        load_arrays(path, "Test")


@pytest.mark.parametrize(("number", "fails"), [(errno.EINVAL, False), (errno.EIO, True)])
def test_file_systems_that_cannot_sync_folders_are_written_to(tmp_path, monkeypatch, number, fails):
    fsync = os.fsync

    def of_files_only(descriptor):
        if stat.S_ISDIR(os.fstat(descriptor).st_mode):
            raise OSError(number, os.strerror(number))
        fsync(descriptor)

    monkeypatch.setattr(os, "fsync", of_files_only)
    with pytest.raises(OSError, match="Input/output") if fails else nullcontext():
        save_arrays(tmp_path / "arrays", "Test", {}, {"a": np.ones(3)})
    assert load_arrays(tmp_path / "arrays", "Test")[1]["a"].tolist() == [1, 1, 1]


def test_a_missing_file_is_not_called_damaged(tmp_path):
    with pytest.raises(FileNotFoundError):
        load_arrays(tmp_path / "arrays", "Test")
