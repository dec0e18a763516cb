"""A stage that will take more than a minute shows its progress unasked."""

import pytest

from wpt_agents.data import bars
from wpt_agents.data.bars import StageBar, shown


@pytest.fixture
def clock(monkeypatch):
    """A clock that the test moves."""
    now = [0.0]
    monkeypatch.setattr(bars.time, "monotonic", lambda: now[0])
    return now


def run(clock, total, seconds, steps=None, **options):
    """Take steps of some seconds each; return the step at which the bar appeared, or None."""
    with StageBar(total, "clone", **options) as bar:
        for step in range(1, (steps or total) + 1):
            clock[0] += seconds
            bar.update()
            if bar.bar is not None:
                return step


@pytest.mark.parametrize(
    ("total", "seconds", "step"),
    [
        (1000, 0.05, None),  # 50 s
        (1000, 0.1, 51),  # 100 s, which is known once 5 s have passed
        (20, 10.0, 1),  # 200 s
        (6, 10.0, None),  # exactly a minute
    ],
)
def test_the_bar_appears_where_a_stage_takes_more_than_a_minute(clock, total, seconds, step):
    assert run(clock, total, seconds) == step


def test_a_stage_that_becomes_slow_is_noticed_then(clock):
    with StageBar(100, "clone") as bar:
        for seconds in [0.1] * 60 + [3.0] * 10:
            clock[0] += seconds
            bar.update()
    # 6 s for 60 steps; from 36 s for 70 steps, 51 s in all; 10 x 3 s: never above a minute
    assert bar.bar is None
    assert bar.duration() == pytest.approx(36 * 100 / 70)


def test_the_bar_says_how_far_the_stage_is_and_how_long_it_takes(clock, capsys):
    with StageBar(1000, "clone", done=500) as bar:
        clock[0] += 10
        bar.update(50)
    said = capsys.readouterr().err
    assert "clone:  55%" in said and "550/1000" in said


def test_a_wanted_bar_is_there_at_once_and_a_silent_one_never(clock, capsys):
    assert run(clock, 10, 0.0, steps=1, visible=True) == 1
    assert run(clock, 10, 100.0, visible=True, silent=True) is None
    assert run(clock, 10, 100.0, steps=1, visible=True, done=10) is None  # nothing left to do
    assert capsys.readouterr().err.count("clone") >= 1


def test_items_are_yielded_in_order_beside_the_bar(clock, capsys):
    def slow():
        for item in "abc":
            clock[0] += 30
            yield item

    assert list(shown(slow(), 3, "read")) == ["a", "b", "c"]
    assert "read:" in capsys.readouterr().err
