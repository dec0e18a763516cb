"""The tables of a report: means, intervals, and the paper beside them."""

import csv
import io
from dataclasses import replace

import pytest
from dot_runs import dot  # noqa: F401  (dot registers the task for each test)
from rich.console import Console
from run_folders import make_run

from wpt_agents.zoo.numbers import interval_text
from wpt_agents.zoo.report import tables
from wpt_agents.zoo.result import Result, Score, Variant, write_result
from wpt_agents.zoo.results import find_results


def fake_result(seed, mean, method="wpt", frames=150_000, untrained=()):
    score = Score((mean - 10, mean + 10))
    scores = {**dict.fromkeys(untrained, Score((-9.0, 11.0))), "last": score}
    where = "dmc", "dmc-walker-run", method, Variant("paper"), seed, frames, frames // 2
    return Result(*where, "return", scores, {}, "abc")


def test_the_report_is_the_mean_over_seeds_beside_the_papers_number(tmp_path):
    for seed, mean in enumerate((700.0, 710.0, 720.0)):
        (tmp_path / str(seed)).mkdir()
        write_result(tmp_path / str(seed), fake_result(seed, mean))
    (row,) = tables.summarise(find_results(tmp_path).values())
    # sd 10, t 4.303 with two degrees of freedom: 710 -+ 4.303 * 10 / sqrt(3) = 24.8
    assert (row.scores, row.mean, row.paper) == ((700, 710, 720), 710, 728.0)
    assert (row.low, row.high) == pytest.approx((685.2, 734.8), abs=0.1)


def test_the_report_keeps_methods_and_budgets_apart():
    other = fake_result(0, 1.0, frames=1)
    rows = tables.summarise([fake_result(0, 1.0), fake_result(0, 2.0, "scratch"), other])
    assert [(row.method, row.frames) for row in rows] == [
        ("scratch", 150_000),
        ("wpt", 1),
        ("wpt", 150_000),
    ]


def test_the_report_prints_as_table_and_as_markdown(capsys):
    rows = tables.summarise([fake_result(0, 1.234), fake_result(0, 456.7, "scratch")])
    Console(width=200).print(tables.summary_table(rows))
    printed = capsys.readouterr().out
    for text in (printed, tables.markdown(rows)):
        assert "1.23" in text
        assert "457" in text
    assert tables.markdown(rows).count("\n") == 6  # heading, line, two rows, and a note


def test_a_bar_in_a_name_does_not_end_its_cell():
    (row,) = tables.summarise([replace(fake_result(0, 1.0), variant=Variant("tiny", data="a|b"))])
    assert r"| tiny 'data=a\|b' |" in tables.markdown([row])


def success_results(*rates):
    """Results on a task that counts successes, one for each success rate in ten episodes."""
    where = "metaworld", "metaworld-reach", "wpt", Variant("tiny")
    scores = [Score((0.0,) * 10, tuple(i < 10 * rate for i in range(10))) for rate in rates]
    return [
        Result(*where, seed, 10, 5, "success", {"last": score}) for seed, score in enumerate(scores)
    ]


def test_two_seeds_are_shown_as_they_are_and_one_has_no_interval(capsys):
    both = success_results(1.0, 0.3)
    for results, cell in ((both, "1.00 and 0.30"), (both[:1], "one seed")):
        rows = tables.summarise(results)
        Console(width=200).print(tables.summary_table(rows))
        assert cell in capsys.readouterr().out and f"| {cell} |" in tables.markdown(rows)
    (row,) = tables.policies([fake_result(0, 1.0), fake_result(1, 9.0)])
    assert (row.seeds_low, row.t_low) == (None, None)
    assert tables.policy_cells(row)[1:5] == ["5.0", "1.00, 9.0", "-5.0 to 15.0", "-"]


def test_an_interval_that_reaches_beyond_a_success_rate_is_cut_off_and_marked():
    # mean 0.9, sd 0.1: 0.9 -+ 4.303 * 0.1 / sqrt(3) = 0.652 to 1.148
    three = tables.summarise(success_results(1.0, 0.9, 0.8))
    assert "| 0.90 | 0.65 to 1.00* |" in tables.markdown(three)
    returns = [fake_result(seed, mean) for seed, mean in enumerate((0.0, 5.0, 10.0))]
    assert "| 5.0 | -7.4 to 17.4 |" in tables.markdown(tables.summarise(returns))
    assert interval_text(-0.2, 1.0, (0.0, 1.0)) == "0.00* to 1.00"


def test_every_policy_has_its_seeds_and_three_intervals():
    results = [fake_result(seed, mean) for seed, mean in enumerate((700.0, 710.0, 720.0))]
    (row,) = tables.policies(results)
    assert (row.name, row.seeds, row.means, row.mean) == ("wpt", (0, 1, 2), (700, 710, 720), 710)
    # six episodes, each 10 from its seed's mean: sd of the mean 10 / sqrt(6) = 4.1, extremes 700
    assert 700 <= row.episodes_low < 705 and 715 < row.episodes_high <= 720
    # all three draws the same seed: probability 1/27 > 2.5 %
    assert (row.seeds_low, row.seeds_high) == (700, 720)
    assert (row.t_low, row.t_high) == pytest.approx((685.2, 734.8), abs=0.1)
    assert (row.episodes, row.commits, row.success) == (2, ("abc",), None)


def test_untrained_policies_are_told_once_however_many_methods_met_them():
    methods = ("wpt", "scratch")
    results = [fake_result(0, 5.0, method, untrained=["nothing"]) for method in methods]
    rows = tables.policies(results)
    assert [(row.method, row.policy) for row in rows] == [
        ("", "nothing"),
        ("scratch", "last"),
        ("wpt", "last"),
    ]
    assert rows[0].seeds_low is None  # one seed
    table = tables.policy_markdown(rows)
    assert "| doing nothing | 1.00 | 1.00 | - | - | - |" in table  # two episodes: no interval
    assert "| scratch | 5.0 |" in table
    assert "Seed 0; 2 episodes per seed; commit abc." in table


def test_seeds_and_commits_are_those_of_each_policy_where_they_differ():
    results = [fake_result(seed, 5.0) for seed in range(3)]
    results += [replace(fake_result(7, 5.0, "scratch"), commit="def")]
    note = tables.policy_note(tables.policies(results))
    assert note == (
        "scratch: seed 7; 2 episodes per seed; commit def. "
        "wpt: seeds 0, 1, 2; 2 episodes per seed; commit abc."
    )


def test_the_csv_reads_back_unrounded():
    rows = tables.policies([fake_result(seed, 1 / 3 + seed) for seed in (0, 4)])
    (read,) = csv.DictReader(io.StringIO(tables.policy_csv(rows)))
    assert read["means"] == f"{rows[0].means[0]} {rows[0].means[1]}" and read["seeds"] == "0 4"
    assert float(read["mean"]) == rows[0].mean
    assert read["success"] == ""


def test_the_same_run_found_twice_is_refused_instead_of_counted_as_two_seeds(tmp_path):
    make_run(tmp_path / "a", "dmc-dot")
    make_run(tmp_path / "b", "dmc-dot")
    with pytest.raises(ValueError, match="are the same run: report one of their folders"):
        find_results(tmp_path)
