"""Faults that tests inject: processes that are killed in the middle of writing, and full disks."""

import ctypes
import errno
import os
import signal
import sys
from contextlib import contextmanager
from itertools import count
from multiprocessing import get_context
from unittest import mock

import pytest

NO_MOUNTS = 77


def started(work, *args):
    """A process forked off, which needs no import of its own."""
    process = get_context("fork").Process(target=work, args=args, daemon=True)
    process.start()
    return process


def done(*processes):
    """Waits for the processes, which must end well."""
    for process in processes:
        process.join(60)
    codes = [process.exitcode for process in processes]
    if NO_MOUNTS in codes:
        pytest.skip("this system lets a test mount nothing, not even for itself")
    assert codes == [0] * len(codes)


def killed(work, *args):
    """Whether a forked process was killed before `work` was done; it must end in one way or other.

    :return: False once the work was done without being killed
    """
    process = started(work, *args)
    process.join(60)
    assert process.exitcode in (0, -signal.SIGKILL), process.exitcode
    return process.exitcode != 0


@contextmanager
def failing(call, fault, rng):
    """Lets `fault` happen at writing system call number `call` and after; a write does a part."""
    write, fsync, calls = os.write, os.fsync, count()

    def failing_write(descriptor, data):
        if next(calls) >= call:
            write(descriptor, data[: rng.randrange(len(data) + 1)])
            fault()
        return write(descriptor, data)

    def failing_fsync(descriptor):
        if next(calls) >= call:
            fault()
        fsync(descriptor)

    with mock.patch("os.write", failing_write), mock.patch("os.fsync", failing_fsync):
        yield


NAMES = {"os.mkdir", "os.rename", "os.remove", "os.rmdir"}  # audit events, as Python calls them
WRITES = {"write", "sendfile"}  # functions written in C that put bytes into a file


def kill_at_change(number, every=1):
    """Kills this process right before change `number` of the file system.

    A change is an opening for writing, a write, an fsync, and a name that is made, changed or
    removed. What is in a buffer of Python's when the process is killed is lost, as in life.

    :param every: of the writes, which are hundreds in a model file, count each `every`-th only
    """
    calls, writes, fsync = count(), count(), os.fsync

    def step():
        if next(calls) == number:
            kill_oneself()

    def audit(event, args):
        if event in NAMES or (event == "open" and _for_writing(args)):
            step()

    def profile(_, event, function):
        if event == "c_call" and function.__name__ in WRITES and next(writes) % every == 0:
            step()

    def counted_fsync(descriptor):
        step()
        fsync(descriptor)

    os.fsync = counted_fsync
    sys.addaudithook(audit)
    sys.setprofile(profile)


def _for_writing(args):
    _, mode, flags = args
    if mode is not None:
        return any(letter in mode for letter in "wax+")
    return bool(flags & (os.O_WRONLY | os.O_RDWR))


def kill_oneself():
    os.kill(os.getpid(), signal.SIGKILL)


def no_space():
    raise OSError(errno.ENOSPC, "No space left on device")


def mount(source, target, kind, flags, data=None):
    if ctypes.CDLL(None, use_errno=True).mount(source, target, kind, flags, data):
        os._exit(NO_MOUNTS)


def mounts_of_its_own():
    """Puts this process where what it mounts is seen by nobody else; root may, others often."""
    new_mounts, new_user, private = 0x20000, 0x10000000, 0x4000 | 0x40000
    uid, libc = os.getuid(), ctypes.CDLL(None, use_errno=True)
    if not hasattr(libc, "unshare") or libc.unshare(new_mounts | (new_user if uid else 0)):
        os._exit(NO_MOUNTS)
    if uid:
        with open("/proc/self/uid_map", "w") as file:
            file.write(f"{uid} {uid} 1")
    mount(None, b"/", None, private)


def small_disk(path, size):
    """Mounts a disk of this size, such as b"2m", at `path`, for this process alone."""
    mounts_of_its_own()
    mount(b"tmpfs", os.fsencode(path), b"tmpfs", 0, b"size=" + size)
