"""The pages beside a record: the evidence of each task, the pairs, and the picture."""

import time
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from threading import Thread

import pytest
from typer.testing import CliRunner

from wpt_agents.zoo.commands.app import app
from wpt_agents.zoo.report import evidence, pairs, record, record_page, record_picture
from wpt_agents.zoo.report.record_tables import usual_budgets
from wpt_agents.zoo.result import Variant

ROOT = Path(__file__).parents[3]
RECORDS = sorted(path.stem for path in (ROOT / "zoo" / "results").glob("*.csv"))


def line(method, task, score, seed=0, preset="mid", frames=12_000, suite="metaworld"):
    where = suite, f"{suite}-{task}", method, seed, Variant.parse(preset), frames
    return record.Line(*where, score, 10 * score, None, 0.0, "c", "x")


LINES = [
    *[line("random", task, 0.0, frames=0) for task in ("hammer", "drawer-open", "door-lock")],
    *[line("wpt+", "hammer", score, seed) for seed, score in enumerate((60.0, 80.0))],
    *[line("wpt+", "drawer-open", 100.0), line("wpt+", "soccer", 30.0)],
    *[line("prior actor", "hammer", score, seed) for seed, score in enumerate((40.0, 60.0))],
    *[line("prior actor", "drawer-open", 100.0), line("prior actor", "soccer", 50.0)],
    *[line("prior actor", "soccer", 90.0, seed=5)],  # wpt+ has no such seed
    *[line("scratch", "hammer", 10.0), line("scratch", "hammer", 20.0, frames=36_000)],
    *[line("scratch", "push", 10.0)],
    *[line("wpt+", "hammer", 1.0, preset="mid reward_grad=10")],
    *[line("wpt+", "door-lock", 99.0, preset="mid reward_grad=10")],
]


def rows(markdown):
    return [row.strip("| ").split(" | ") for row in markdown.splitlines() if row.startswith("|")]


def test_a_row_has_the_papers_scores_and_the_mean_of_our_seeds():
    head, _, *table = rows(evidence.markdown(LINES))
    assert head == [
        *("task", "DreamerV3, paper", "DrQ-v2, paper", "WPT, paper"),
        *("random", "prior actor", "scratch", "scratch, 3x frames", "wpt+"),
    ]
    by_task = {row[0]: row[1:] for row in table}
    means = ["**mean**", "**mean, with a gap**"]
    assert list(by_task) == ["drawer-open", "hammer", "push", "soccer", *means]
    # Table 3: hammer has 0.07, 0.40 and 1.0 at 150k; wpt+ (60 + 80) / 2, prior actor (40 + 60) / 2
    assert by_task["hammer"] == [
        "7.0",
        "40.0",
        "100",
        "0.00",
        "50.0 (2)",
        "10.0",
        "20.0",
        "70.0 (2)",
    ]
    assert by_task["push"][4:] == ["-", "10.0", "-", "-"]


def test_each_mean_is_over_the_columns_tasks_and_the_papers_over_those_of_ours():
    *_, mean, gap = rows(evidence.markdown(LINES))
    # WPT on drawer-open, hammer, soccer, where wpt+ was run (not push): (100 + 100 + 67) / 3 = 89
    assert mean[3] == "89.0 (67.0 to 100, 3 tasks)"
    # wpt+: (100 + 70 + 30) / 3 = 66.7; prior actor: (100 + 50 + (50 + 90) / 2) / 3 = 73.3. One
    # resample in 27 consists of the lowest score alone, more than the 2.5 % that are cut off
    assert (mean[8], mean[5]) == ("66.7 (30.0 to 100, 3 tasks)", "73.3 (50.0 to 100, 3 tasks)")
    assert (mean[6], mean[7]) == ("10.0 (2 tasks)", "20.0 (1 task)")  # scratch, and 3x frames
    # with a gap: drawer-open and hammer, where the paper has 13 33 100 and 7 40 100
    assert (gap[1], gap[3], gap[8]) == ("10.0 (2 tasks)", "100 (2 tasks)", "85.0 (2 tasks)")


def test_success_at_any_step_has_a_row_of_the_runs_where_it_is_known():
    known = {("hammer", 0): 0.75, ("hammer", 1): 0.25, ("drawer-open", 0): 1.0}
    lines = [
        replace(one, success_any=known[one.task.removeprefix("metaworld-"), one.seed])
        if one.method == "wpt+" and not one.preset.changes and "soccer" not in one.task
        else one
        for one in LINES
    ]
    text = evidence.markdown(lines)
    head, *_, last = rows(text)
    assert last[0] == "**mean, success at any step**" and "at any step, where" in text
    cells = dict(zip(head, last, strict=True))  # ((75 + 25) / 2 + 100) / 2
    assert (cells["wpt+"], cells["prior actor"], cells["WPT, paper"]) == (
        "75.0 (2 tasks)",
        "-",
        "-",
    )
    assert "any step" not in evidence.markdown(LINES)


def test_a_gap_needs_both_baselines_low_and_the_papers_wpt_high(monkeypatch):
    low, high = {"a": 40.0, "b": 40.0, "c": 40.1, "d": 0.0}, {"a": 70.0, "b": 69.9, "c": 99.0}
    other = {"a": 0.0, "b": 0.0, "c": 0.0, "d": 0.0}
    for baselines in ((low, other), (other, low)):
        paper = dict(zip(("dreamer-v3", "drq-v2"), baselines, strict=True)) | {"wpt": high}
        scores = {"wpt+": {task: {0: 1.0} for task in "abcde"}}  # the paper does not have e
        one = evidence.Evidence("metaworld", Variant("mid"), 12_000, scores, paper)
        assert one.with_gap == ["a"]
    without = evidence.Evidence(
        "metaworld", Variant("mid"), 12_000, {"wpt+": {"b": {0: 1.0}}}, paper
    )
    assert "with a gap" not in evidence.table(without) + evidence.explanation(without)


def test_tasks_that_were_run_with_changed_settings_alone_are_named():
    *_, last = evidence.markdown(LINES).splitlines()
    assert "only run with changed settings" in last and last.endswith(": metaworld-door-lock.")
    changed = [line("wpt", "hammer", 5.0, preset="mid ibrl=true")]
    assert evidence.evidence(changed) == [] and "metaworld-hammer." in evidence.markdown(changed)


def test_the_usual_preset_is_an_unchanged_one_even_if_only_changed_ones_ran_ours():
    lines = [line("scratch", "a", 1.0), line("wpt", "a", 1.0, preset="mid ibrl=true", frames=9)]
    assert usual_budgets(lines) == {"metaworld": (12_000, Variant("mid"))}


def test_pairs_count_tasks_by_their_common_seeds():
    by_names = {(p.first, p.second): p for p in pairs.pairs(LINES) if p.where == "metaworld"}
    clone = by_names["wpt+", "prior actor"]
    # hammer ((60 - 40) + (80 - 60)) / 2 = 20, drawer-open 0, soccer by seed 0 alone: 30 - 50 = -20
    assert sorted(clone.differences) == [-20, 0, 20]
    # wpt+ (70 + 100 + 30) / 3, the prior actor (50 + 100 + 50) / 3
    means = "66.7 (30.0 to 100)", "66.7 (50.0 to 100)"
    assert clone.cells[:5] == ["metaworld", "wpt+", means[0], "prior actor", means[1]]
    assert clone.cells[5:] == ["3", "1", "1", "1", "0.00 (-20.0 to 20.0)", "-20.0", "1"]
    # scratch has seed 0 of hammer alone: 60 - 10. A single task has no interval
    cells = by_names["wpt+", "scratch"].cells
    assert cells[2:5] == ["60.0 (-)", "scratch", "10.0 (-)"]
    assert cells[5:] == ["1", "1", "0", "0", "50.0 (-)", "50.0", "1"]
    assert by_names["wpt+", "scratch, 3x frames"].differences == [40]  # 60 - 20
    # the paper: hammer 70 - 100, drawer-open 100 - 100, soccer 30 - 67
    assert sorted(by_names["wpt+", pairs.PAPER_WPT].differences) == pytest.approx([-37, -30, 0])
    assert [second for _, second in by_names] == [
        *("prior actor", "scratch", "scratch, 3x frames", pairs.PAPER_WPT)
    ]


def test_pairs_show_tasks_with_a_gap_and_those_on_which_the_prior_actor_leaves_room():
    compared = {(p.where, p.second): p for p in pairs.pairs(LINES) if p.second == "prior actor"}
    gap = compared["metaworld, with a gap", "prior actor"]
    assert sorted(gap.scores) == [(70, 50), (100, 100)]  # hammer and drawer-open
    room = compared["metaworld, prior actor below 80", "prior actor"]
    assert sorted(room.scores) == [(30, 50), (70, 50)]  # soccer and hammer
    assert "at least 70" in pairs.markdown(LINES) and "below 80" in pairs.markdown(LINES)
    lines = [line("wpt+", "soccer", 30.0), line("scratch", "soccer", 10.0)]  # 67 in the paper
    assert [pair.where for pair in pairs.pairs(lines)] == ["metaworld", "metaworld"]
    assert "with a gap" not in pairs.markdown(lines)


def test_five_wins_of_five_are_a_p_value_of_a_sixteenth_and_two_suites_are_added_up():
    lines = [
        line(method, f"task-{i}", score, suite=suite, frames=frames)
        for suite, tasks, frames in (("dmc", 2, 40_000), ("metaworld", 3, 12_000))
        for i in range(tasks)
        for method, score in (("wpt+", 50.0), ("scratch", 50.0 - 10 * (i + 1)))
    ]
    # differences 10 20 and 10 20 30, so 18 on average and 10 at least; p = 2 / 2^5
    *_, both = pairs.pairs(lines)
    assert both.cells[:2] == ["all", "wpt+"] and both.cells[5:9] == ["5", "5", "0", "0"]
    assert both.cells[9].startswith("18.0 (") and both.cells[10:] == ["10.0", "0.062"]


def test_groups_of_tasks_of_two_suites_are_added_up_each():
    gaps = ("metaworld", "hammer", 12_000), ("dmc", "walker-walk-hard", 40_000)
    others = ("metaworld", "soccer", 12_000), ("dmc", "walker-stand", 40_000)
    lines = [
        line(method, task, score, suite=suite, frames=frames)
        for suite, task, frames in (*gaps, *others)
        for method, score in (("wpt+", 50.0), ("scratch", 20.0))
    ]
    numbers = {
        pair.where: len(pair.scores) for pair in pairs.pairs(lines) if pair.second == "scratch"
    }
    assert numbers == {
        **{"dmc": 2, "dmc, with a gap": 1, "metaworld": 2, "metaworld, with a gap": 1},
        **{"all": 4, "all, with a gap": 2},
    }


def test_equal_tasks_differ_by_zero_despite_rounding_errors():
    pair = pairs.Pair("dmc", "wpt", "scratch", ((0.3, 0.1 + 0.2),))
    assert pair.cells[6:] == ["0", "1", "0", "0.00 (-)", "0.00", "1"]


KEPT = ("", 70.0), (", last", 7.0)  # the best policy and the last one of a run


def test_pairs_never_use_a_policy_that_was_chosen_by_evaluations():
    best = [line("wpt", "hammer", 90.0), line("wpt, last", "hammer", 40.0)]
    pair = pairs.pairs([*best, line("prior actor", "hammer", 50.0)])[0]
    assert (pair.first, pair.differences) == ("wpt", [-10])
    longer = [line(f"scratch{end}", "hammer", score, frames=36_000) for end, score in KEPT]
    usual = [line(f"scratch{end}", "hammer", score + 1) for end, score in KEPT]
    (one,) = evidence.evidence([*best, *usual, *longer])
    assert pairs.last_scores(one, "scratch, 3x frames") == {"metaworld-hammer": {0: 7.0}}
    assert pairs.last_scores(one, "scratch") == {"metaworld-hammer": {0: 8.0}}
    assert "`METHOD, last`" in evidence.markdown(best)
    assert "`METHOD, last`" not in evidence.markdown(LINES)


def test_a_record_of_many_tasks_is_drawn_in_rows_and_one_of_few_in_panels(monkeypatch, tmp_path):
    drawn = []
    for name in ("draw_rows", "draw_panels"):
        draw = getattr(record_picture, name)
        monkeypatch.setattr(record_picture, name, lambda x, d=draw, n=name: drawn.append(n) or d(x))
    many = [line("wpt+", f"task-{i}", 50.0) for i in range(9)]
    changed = [line("wpt+", f"task-{i}", 9.0, preset="mid x=1") for i in range(9, 18)]
    for lines in (many, many[:8] + changed, changed):
        record_picture.draw(tmp_path / "a.png", lines)
    assert drawn == ["draw_rows", "draw_panels", "draw_panels"]


def test_rows_leave_out_changed_settings_and_show_the_papers_score_hollow():
    (panel,) = record_picture.draw_rows(evidence.evidence(LINES)).axes
    drawn = {curve.get_label(): list(curve.get_xdata()) for curve in panel.get_lines()}
    names = ["random", "prior actor", "scratch", "scratch, 3x frames", "wpt+"]
    paper = "the paper's WPT, 150,000 frames"
    assert list(drawn) == [*names, paper]
    assert sorted(drawn["wpt+"]) == [30, 70, 100]  # neither 1 nor 99
    assert panel.get_lines()[-1].get_markerfacecolor() == "none"
    assert [tick.get_text() for tick in panel.get_yticklabels()] == [
        *("drawer-open", "hammer", "push", "soccer")
    ]


def added():
    """Lines of a suite and a method that were added to the zoo."""
    scores = {"scratch": (10.0, 20.0), "mine": (30.0, 15.0), "random": (0.0, 0.0)}
    return [
        line(method, task, score, suite="dots")
        for method, by_task in scores.items()
        for task, score in zip(("left", "right"), by_task, strict=True)
    ]


def test_a_method_that_was_added_is_compared_with_the_others():
    [pair] = pairs.pairs(added())
    assert (pair.where, pair.first, pair.second) == ("dots", "mine", "scratch")
    assert pair.differences == [20.0, -5.0]


def test_where_the_paper_has_no_scores_none_are_mentioned():
    [one] = evidence.evidence(added())
    assert "paper" not in evidence.explanation(one)
    assert "paper" not in record_picture.draw_panels(added())._supxlabel.get_text()
    assert "paper" in record_picture.draw_panels(LINES)._supxlabel.get_text()


def test_negative_scores_of_hard_tasks_are_within_the_picture():
    hard = [line("random", "walker-walk-hard", -14.0, frames=0, suite="dmc")]
    hard += [line("wpt", "walker-walk-hard", 88.0, suite="dmc")]
    for figure in (
        record_picture.draw_rows(evidence.evidence(hard)),
        record_picture.draw_panels(hard),
    ):
        (panel,) = figure.axes
        assert -24 < panel.get_xlim()[0] < -14 and panel.get_xlim()[1] < 105
    assert record_picture.draw_panels(LINES).axes[0].get_xlim()[0] == -4


def test_a_method_with_only_changed_settings_is_in_the_panel_with_their_names(
    monkeypatch, tmp_path
):
    lines = [line("drq-v2", "hammer", 5.0), line("wpt+", "hammer", 7.0, preset="mid x=1")]
    lines += [line("drq-v2", "hammer", 6.0, preset="mid x=1")]  # it has the unchanged preset, too
    lines += [line("wpt", "hammer", 8.0, preset=f"mid x={i}") for i in range(2)]  # two settings
    lines += [line("wpt+", "push", 9.0, preset="mid x=1")]  # no task of the unchanged preset
    figures = []
    monkeypatch.setattr(record_picture, "save", lambda figure, _: figures.append(figure))
    record_picture.draw(tmp_path / "a.png", lines)
    (panel,) = figures[0].axes
    labels = [tick.get_text() for tick in panel.get_yticklabels()]
    assert labels == ["wpt+,\nx=1", "drq-v2", "the paper's WPT,\n150,000 frames"]


def test_policies_in_between_are_not_drawn_in_rows_at_any_budget():
    names = ["wpt, last", "wpt, last, 3x frames", "wpt+, after head start, 3x frames", "nothing"]
    names += ["wpt+, imitating actor"]
    assert not any(map(record_picture.drawn, names))
    assert all(map(record_picture.drawn, ["wpt", "prior actor, no-pretrain", "scratch, 3x frames"]))


def test_labels_of_several_lines_have_room_in_a_panel():
    lines = [line("wpt", "hammer", 5.0, preset=f"mid x={i} y={i}") for i in range(3)]
    figure = record_picture.draw_panels(lines)
    figure.draw_without_rendering()
    boxes = [tick.get_window_extent() for tick in figure.axes[0].get_yticklabels()]
    assert len(boxes) == 4  # with the paper's
    assert all(lower.y1 < upper.y0 for upper, lower in pairwise(boxes))


def test_pages_are_renewed_without_run_folders(tmp_path):
    path = tmp_path / "mid.csv"
    record.update(path, LINES)
    before = path.read_bytes()
    ran = CliRunner().invoke(app, ["report", str(tmp_path / "none"), "--record", str(path)])
    assert ran.exit_code == 0, ran.output
    assert path.read_bytes() == before and path.with_suffix(".png").stat().st_size > 1000
    assert path.with_suffix(".md").read_text() == record_page.markdown(record.read(path))


def test_two_processes_that_record_at_once_lose_no_line(tmp_path, monkeypatch):
    def read_slowly(path):
        lines = read(path)
        time.sleep(0.2)
        return lines

    read = record.read
    monkeypatch.setattr(record, "read", read_slowly)
    monkeypatch.setattr(record_picture, "draw", lambda *_: None)
    path = tmp_path / "mid.csv"
    record.update(path, LINES[:1])
    threads = [Thread(target=record_page.update, args=(path, [one])) for one in LINES[1:4]]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    lines = read(path)
    assert set(lines) == set(LINES[:4])
    assert path.with_suffix(".md").read_text() == record_page.markdown(lines)
    assert {file.name for file in tmp_path.iterdir()} == {"mid.csv", "mid.md"}


def test_a_record_that_does_not_exist_or_is_empty_needs_runs(tmp_path):
    path = tmp_path / "mid.csv"
    words = ["report", str(tmp_path / "none"), "--record", str(path)]
    assert "No finished run below" in str(CliRunner().invoke(app, words).exception)
    assert not list(tmp_path.iterdir())
    record.update(path, [])
    assert "No finished run below" in str(CliRunner().invoke(app, words).exception)
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("name", RECORDS)
def test_the_tables_in_the_repository_are_those_of_its_records(name):
    assert {"baselines", "mid", "small-benchmark", "tried"} <= set(RECORDS)
    path = ROOT / "zoo" / "results" / f"{name}.csv"
    assert (
        record_page.markdown(record.shown(record.read(path))) == path.with_suffix(".md").read_text()
    )
