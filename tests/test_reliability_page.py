"""docs/reliability.md names tests that exist, one row for each of its 32 faults."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs" / "reliability.md").read_text()
ROWS = re.findall(r"^\| (\d+) \|(.*)\|$", PAGE, re.M)


@pytest.mark.parametrize(("number", "row"), ROWS, ids=lambda cell: cell if cell.isdigit() else "")
def test_each_row_names_tests_that_exist_and_says_what_holds(number, row):
    *_, tests, state = row.split("|")
    named = re.findall(r"\[(test_\w+)\]\(\.\./(tests/[\w/]+\.py)\)( \(n\))?", tests)
    assert named and tests.count("](") == len(named)
    for name, path, nightly in named:
        source = (ROOT / path).read_text()
        (definition,) = re.findall(rf"((?:^@.*\n)*)^def {name}\(", source, re.M)
        assert bool(nightly) == ("mark.nightly" in definition), name
    assert "PASS" in state or "missing" in state


def test_there_is_a_row_for_each_fault():
    assert [int(number) for number, _ in ROWS] == list(range(1, 33))
