"""Tests of many tasks: some of them in each test run, all of them in `make nightly`."""

from collections.abc import Iterable

import pytest


def one_in_eight(names: Iterable[str]) -> list:
    """Return the names for `parametrize`; all but every eighth one are marked `nightly`."""
    return [
        name if i % 8 == 0 else pytest.param(name, marks=pytest.mark.nightly)
        for i, name in enumerate(names)
    ]
