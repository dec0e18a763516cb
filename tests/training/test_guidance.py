import numpy as np
import pytest

from wpt_agents.training.guidance import draw_window, linear, parse_schedule


def rng(seed=0):
    return np.random.default_rng(seed)


def test_linear_by_hand():
    schedule = linear(1, 0.1, 100)
    # half way: (1 + 0.1) / 2
    values = [schedule(step) for step in (-5, 0, 50, 100, 10**9)]
    assert values == pytest.approx([1, 1, 0.55, 0.1, 0.1])


@pytest.mark.parametrize(
    ("text", "step", "value"),
    [
        ("linear(1,0,50000)", 25_000, 0.5),
        ("linear(1, 0.1, 100_000)", 50_000, 0.55),
        ("linear(0,1e0,2e3)", 1000, 0.5),
        ("0.25", 7, 0.25),
        (0.5, 10**9, 0.5),
        (0, 0, 0.0),
        (1, 0, 1.0),
    ],
)
def test_what_a_schedule_may_look_like(text, step, value):
    assert parse_schedule(text)(step) == pytest.approx(value)


@pytest.mark.parametrize(
    "text",
    [
        "linear(1,0,1,150000)",  # as the paper prints it for Meta-World: a decimal comma
        "linear(1,0)",
        "linear(1,0,0)",
        "linear(1,0,-5)",
        "linear(1,0,e)",
        "linear(1,0,50000) + 1",
        "cosine(1,0,50000)",
        "linear",
        "",
    ],
)
def test_another_schedule_is_refused_with_an_example(text):
    with pytest.raises(ValueError, match=r"not understood.*'linear\(1,0,50000\)'"):
        parse_schedule(text)


def test_a_weight_may_be_larger_than_a_probability():
    assert parse_schedule("linear(20,4,100)", most=np.inf)(50) == pytest.approx(12)
    with pytest.raises(ValueError, match=r"guidance='linear.*from 0 to 1,"):
        parse_schedule("linear(20,4,100)")
    for wrong in (-1, np.inf, "linear(1e999,0,10)"):
        with pytest.raises(ValueError, match=r"kickstart=.*a number from 0 on,"):
            parse_schedule(wrong, np.inf, "kickstart")


@pytest.mark.parametrize("length", [1, 2, 7, 25, 100, 500])
def test_windows_lie_inside_the_episode_and_are_never_empty(length):
    generator = rng()
    for _ in range(300):
        start, stop = draw_window(1.0, length, generator)
        assert 0 <= start < stop <= length


def test_an_episode_is_guided_as_often_as_said():
    generator, n = rng(), 5000
    assert all(draw_window(0.0, 100, generator) == (0, 0) for _ in range(100))
    share = sum(draw_window(0.3, 100, generator) != (0, 0) for _ in range(n)) / n
    # standard deviation sqrt(.3 * .7 / 5000) = 0.0065
    assert share == pytest.approx(0.3, abs=0.025)


def test_the_tenths_are_equally_likely_and_so_is_every_start():
    generator = rng()
    windows = np.array([draw_window(1.0, 10, generator) for _ in range(10_000)])
    durations = windows[:, 1] - windows[:, 0]
    # Chi-square with 9 degrees of freedom exceeds 27.9 once in a thousand
    assert ((np.bincount(durations)[1:] - 1000) ** 2 / 1000).sum() < 27.9
    starts = np.bincount(windows[durations == 1, 0], minlength=10)
    assert ((starts - starts.mean()) ** 2 / starts.mean()).sum() < 27.9


def test_a_whole_window_is_the_whole_episode():
    generator = rng()
    windows = {draw_window(1.0, 10, generator) for _ in range(500)}
    assert [w for w in windows if w[1] - w[0] == 10] == [(0, 10)]


def test_the_same_seed_draws_the_same_windows():
    one, two, other = ([draw_window(0.5, 50, g) for _ in range(20)] for g in (rng(), rng(), rng(1)))
    assert one == two != other
