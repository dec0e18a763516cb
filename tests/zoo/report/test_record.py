"""The record of results: what stands in it, how it grows, what it says together."""

import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
from run_folders import make_run
from typer.testing import CliRunner

from wpt_agents.zoo.commands.app import app
from wpt_agents.zoo.plan.methods import METHODS
from wpt_agents.zoo.report import evidence, record, record_picture, record_tables
from wpt_agents.zoo.report.folders import find_finished
from wpt_agents.zoo.report.names import policy_name
from wpt_agents.zoo.report.record_tables import Key
from wpt_agents.zoo.result import Result, Score, Variant


def lines_of(folder):
    return record.lines_of(find_finished(folder))


def line(method, score, task="dmc-a", seed=0, frames=100, suite="dmc", preset="tiny"):
    return record.Line(
        *(suite, task, method, seed, Variant.parse(preset), frames, score, 0, None, 0, "c", "x")
    )


def test_a_line_holds_the_score_of_the_paper_and_the_command(tmp_path):
    make_run(tmp_path, "dmc-walker-run", seed=2, returns=(300.0, 500.0), preset="tiny size=debug")
    make_run(tmp_path, "metaworld-reach", returns=(3.0, 9.0, 9.0, 9.0), method="no-pretrain")
    lines = {(entry.task, entry.method): entry for entry in lines_of(tmp_path)}
    walker = lines["dmc-walker-run", "wpt"]
    assert (walker.score, walker.return_, walker.success) == (40, 400, None)
    assert (walker.hours, walker.commit) == (pytest.approx(2 / 3600, abs=1e-4), "0123456789ab")
    assert walker.command == (
        "python -m wpt_agents.zoo run --suite dmc --tasks dmc-walker-run --method wpt "
        "--preset tiny --frames 1000 --seeds 2-2 --set size=debug"
    )
    reach = lines["metaworld-reach", "no-pretrain"]
    assert (reach.score, reach.success) == (75, 0.75)
    assert {m for task, m in lines if task == "dmc-walker-run"} == {
        *("nothing", "random", "prior actor", "wpt")
    }


def result(method="wpt", preset="tiny", scores=()):
    where = "dmc", "t", method, Variant.parse(preset), 0, 10, 5
    return Result(*where, "return", {policy: Score((1.0,)) for policy in scores})


def test_a_line_holds_success_at_the_last_step_and_at_any():
    scores = {"last": Score((1.0, 2.0), (True, False), (True, True))}
    run = SimpleNamespace(result=replace(result(), metric="success", scores=scores))
    (one,) = record.lines_of([run])
    assert (one.success, one.success_any) == (0.5, 1.0)


def test_data_of_ones_own_are_in_the_command():
    changes = "data=my/own 'collect.tasks=[a, b]' 'guidance=linear(1,0,9)'"
    command = result(preset=f"tiny {changes}").command
    assert command.endswith(
        "--set 'collect.tasks=[a, b]' --set 'guidance=linear(1,0,9)' --data my/own"
    )


def test_policies_in_between_and_of_other_methods_have_names_of_their_own():
    kept = result("wpt", scores=["last", "best"])
    assert policy_name(kept, "last") == "wpt, last" and policy_name(kept, "best") == "wpt"
    assert policy_name(kept, "after head start") == "wpt, after head start"
    names = [("last", "scratch"), ("prior actor", "no-pretrain"), ("random", "scratch")]
    policies = [policy_name(result(method, scores=["last"]), policy) for policy, method in names]
    assert policies == ["scratch", "prior actor, no-pretrain", "random"]
    assert policy_name(result("kickstart"), "prior actor") == "prior actor"  # the clone of wpt


def test_untrained_policies_are_told_apart_by_how_they_are_played(tmp_path):
    for preset in ("demo", "debug", "demo size=tiny", "demo evaluate.episodes=3"):
        make_run(tmp_path, "dmc-walker-run", method="scratch", preset=preset)
    lines = [str(entry.preset) for entry in lines_of(tmp_path) if entry.method == "random"]
    assert lines == ["debug", "demo", "demo evaluate.episodes=3"]


def test_only_intervals_of_success_rates_end_at_0_and_100():
    def low(suite):
        lines = [line("wpt", score, seed=i, suite=suite) for i, score in enumerate((1, 9, 2))]
        [cells] = record_tables.by_task(lines).values()
        [cell] = cells.values()
        return str(cell).split(" to ")[0].split("(")[1]

    assert low("metaworld") == low("robotics") == "0.00*"
    assert float(low("returns-of-your-own")) < 0


def test_budgets_are_kept_apart_where_there_is_no_run_of_wpt():
    lines = [line("scratch", 10.0, frames=100), line("scratch", 90.0, frames=300)]
    lines += [line("scratch", 50.0, frames=900, preset="small"), line("random", 1.0, frames=0)]
    means = record_tables.by_suite(lines)
    scores = {method: cell.mean for method, suites in means.items() for _, cell in suites.values()}
    assert scores == {
        **{"random": 1.0, "scratch": 10.0, "scratch, 3x frames": 90.0},
        "scratch, 9x frames, small": 50.0,
    }


def test_a_record_of_another_suffix_is_refused_before_anything_is_written(tmp_path):
    make_run(tmp_path / "runs", "dmc-walker-run")
    for name in ("record.md", "record.png", "record"):
        words = ["report", str(tmp_path / "runs"), "--record", str(tmp_path / name)]
        assert "a record is a .csv" in str(CliRunner().invoke(app, words).exception)
    assert [path.name for path in tmp_path.iterdir()] == ["runs"]


def test_an_unknown_choice_of_media_is_refused_before_anything_is_written(tmp_path):
    make_run(tmp_path / "runs", "dmc-walker-run")
    words = ["report", str(tmp_path / "runs"), "--record", str(tmp_path / "a.csv")]
    ran = CliRunner().invoke(app, [*words, "--media", "firsts"])
    assert "Did you mean 'first'" in str(ran.exception)
    assert [path.name for path in tmp_path.iterdir()] == ["runs"]


def test_a_record_grows_and_replaces_the_same_run(tmp_path):
    path = tmp_path / "small.csv"
    first = [line("wpt", 1.5), line("wpt", 2.0, seed=1)]
    assert record.update(path, first) == record.read(path) == first
    again = record.update(path, [line("wpt", 9.0, seed=1), line("scratch", 3.0)])
    assert [(entry.method, entry.score) for entry in again] == [
        *[("scratch", 3.0), ("wpt", 1.5), ("wpt", 9.0)]
    ]
    assert path.read_text().splitlines()[0] == (
        "suite,task,method,seed,preset,frames,score,return,success,hours,commit,command,"
        "updates,cpu_hours,model_hash,policy,success_any"
    )


def test_policies_that_a_run_no_longer_has_are_dropped_when_it_is_recorded_again(tmp_path):
    path = tmp_path / "small.csv"
    others = [line("prior actor, no-pretrain", 4.0), line("wpt, last", 5.0, seed=1)]
    record.update(path, [line("wpt", 1.0), line("wpt, last", 2.0), line("prior actor", 3.0)])
    record.update(path, others)
    again = record.update(path, [line("wpt", 9.0), line("prior actor", 8.0)])
    assert {(one.method, one.seed): one.score for one in again} == {
        ("wpt", 0): 9.0,
        ("prior actor", 0): 8.0,
        ("prior actor, no-pretrain", 0): 4.0,
        ("wpt, last", 1): 5.0,
    }


def test_every_method_keeps_its_own_prior_actor_and_tables_show_that_of_wpt(tmp_path):
    path = tmp_path / "small.csv"
    for method, score in (("wpt", 1.0), ("wpt+", 2.0), ("kickstart", 3.0), ("wpt", 4.0)):
        command = f"python -m wpt_agents.zoo run --method {method} --seeds 0-0"
        names = method, "prior actor"
        record.update(path, [replace(line(name, score), command=command) for name in names])
    clones = [one for one in record.read(path) if one.method == "prior actor"]
    assert [(one.run_method, one.score) for one in clones] == [
        *[("wpt", 4.0), ("kickstart", 3.0), ("wpt+", 2.0)]
    ]
    [seen] = [one for one in record.shown(record.read(path)) if one.method == "prior actor"]
    assert seen.score == 4.0


@pytest.mark.parametrize("name", ["baselines", "mid", "small-benchmark", "tried"])
def test_every_line_of_the_records_is_shown_except_further_prior_actors(name):
    lines = record.read(Path(__file__).parents[3] / "zoo" / "results" / f"{name}.csv")
    seen = record.shown(lines)
    hidden = [line for line in lines if line not in seen]
    assert all(line.method == "prior actor" for line in hidden)
    assert len(seen) + len(hidden) == len(lines) and [x for x in lines if x in seen] == seen


def test_a_score_of_another_commit_or_model_is_not_replaced_silently(tmp_path):
    path = tmp_path / "small.csv"
    first = [replace(line("wpt", 1.0), return_=10.0, model_hash="m1"), line("wpt", 2.0, seed=1)]
    record.update(path, first)
    record.update(path, [replace(first[0], commit="d"), replace(first[1], return_=20.0)])
    other = replace(first[0], score=3.0, return_=30.0, model_hash="m2", commit="d")
    with pytest.warns(
        UserWarning,
        match=r"small.csv now has other scores: dmc-a, wpt, seed 0: 1 of commit d and model m1 "
        r"by 3 of commit d and model m2$",
    ):
        record.update(path, [other])


def test_rows_whose_seeds_began_with_different_models_are_named():
    lines = [replace(line("wpt", 1.0), model_hash="m1"), line("wpt", 2.0, seed=1)]
    lines += [replace(line("wpt", 3.0, seed=2), model_hash="m1"), line("scratch", 1.0)]
    page = record_tables.markdown(lines)
    assert "\n- dmc-a, wpt, tiny, 100 frames: m1 (seed 0, 2); unknown (seed 1)\n" in page
    assert "pre-trained models" not in record_tables.markdown(lines[::2])


def test_budgets_that_are_almost_equal_do_not_share_a_column():
    budgets = {100_000: 1.0, 300_000: 2.0, 300_400: 3.0}
    lines = [line("scratch", score, frames=frames) for frames, score in budgets.items()]
    names = ["scratch", "scratch, 3x frames", "scratch, 300,400 frames"]
    assert list(record_tables.by_suite(lines)) == names
    [one] = evidence.evidence(lines)
    assert [scores["dmc-a"][0] for scores in one.scores.values()] == [1.0, 2.0, 3.0]


def test_a_run_is_recorded_once_however_its_settings_were_written(tmp_path):
    path = tmp_path / "small.csv"
    record.update(path, [line("wpt", 1.0, preset="tiny gamma=0.9 size=mid")])
    text = path.read_text().replace("gamma=0.9 size=mid", "size=mid wpt.gamma=0.9")
    path.write_text(text)
    [one] = record.update(path, [line("wpt", 2.0, preset="tiny gamma=0.9 size=mid")])
    assert (str(one.preset), one.score) == ("tiny gamma=0.9 size=mid", 2.0)


def test_presets_are_kept_apart():
    lines = [line("wpt", 40.0), line("wpt", 90.0, preset="small"), line("scratch", 5.0)]
    assert len({entry.identity for entry in lines}) == 3
    assert set(record_tables.by_suite(lines)) == {"wpt", "wpt, tiny", "scratch, tiny"}
    assert "| dmc-a | wpt | small | 100 | 90.0 | 90.0 | 0.00 |" in record_tables.markdown(lines)


def test_changed_settings_are_named_also_without_a_run_of_the_unchanged_preset():
    lines = [line("wpt", 40.0, preset="tiny gamma=0.9"), line("random", 1.0, frames=0)]
    lines += [line("wpt", 50.0, preset="tiny size=mid")]
    names = {"random", "wpt, tiny gamma=0.9", "wpt, tiny size=mid"}
    assert set(record_tables.by_suite(lines)) == names


def test_another_csv_is_refused(tmp_path):
    (tmp_path / "other.csv").write_text("a,b\n1,2\n")
    with pytest.raises(ValueError, match=r"other.csv is not a record.*its columns are suite"):
        record.read(tmp_path / "other.csv")
    (tmp_path / "other.csv").write_bytes(b"suite\n\xff\n")
    with pytest.raises(ValueError, match=r"other.csv is not a record.*can't decode"):
        record.read(tmp_path / "other.csv")


def test_a_record_saved_by_a_spreadsheet_is_read_and_one_with_a_cut_line_is_refused(tmp_path):
    path = tmp_path / "results.csv"
    lines = record.update(path, [line("wpt", 50.0), line("scratch", 40.0)])
    content = path.read_bytes()
    path.write_bytes(b"\xef\xbb\xbf" + content.replace(b"\n", b"\r\n"))
    assert record.read(path) == lines
    for wrong in (content.rstrip().removesuffix(b",,,,"), content.rstrip() + b",x\n"):
        path.write_bytes(wrong)
        with pytest.raises(ValueError, match=r"too many or too few cells: \['dmc', 'dmc-a'"):
            record.read(path)


def test_a_benchmark_counts_as_much_as_the_other_whatever_its_number_of_tasks():
    lines = [
        *[line("wpt", 0.0, f"dmc-{i}", seed) for i in range(3) for seed in range(2)],
        *[line("wpt", score, "mw-a", seed, 50, "mw") for seed, score in enumerate((80.0, 100.0))],
        *[line("scratch", 30.0, "mw-a", 0, 150, "mw"), line("random", 7.0, "mw-a", 0, 0, "mw")],
    ]
    suites = record_tables.by_suite(lines)
    assert suites["wpt"]["dmc"][0] == 3 and suites["wpt"]["mw"][1].mean == 90
    both = suites["wpt"]["both"][1]
    assert (both.mean, both.low, both.high) == (45, 40, 50)
    assert suites["scratch, 3x frames"]["mw"][1].low is None  # of one seed
    fewer = record_tables.by_suite(
        [entry for entry in lines if (entry.task, entry.seed) != ("dmc-0", 1)]
    )
    assert fewer["wpt"]["mw"][1].low is None  # two seeds of a single task
    assert fewer["wpt"]["dmc"][1].low is None and fewer["wpt"]["both"][1].low is None  # one of one
    assert set(suites) == {"wpt", "scratch, 3x frames", "random"} and "both" not in suites["random"]


def test_the_command_writes_table_and_picture_beside_the_record(tmp_path):
    for seed in range(3):
        make_run(tmp_path / "runs", "dmc-walker-run", seed, returns=(300.0, 500.0))
    path = tmp_path / "small.csv"
    ran = CliRunner().invoke(app, ["report", str(tmp_path / "runs"), "--record", str(path)])
    assert ran.exit_code == 0, ran.output
    assert len(record.read(path)) == 12
    assert (
        "| dmc-walker-run | wpt | debug | 1,000 | 40.0 (40.0 to 40.0) | 40.0 40.0 40.0 | 400 |"
        in (path.with_suffix(".md").read_text())
    )
    assert path.with_suffix(".png").stat().st_size > 1000
    assert "small.csv; beside it small.md, small.png" in ran.output.replace("\n", "")


@pytest.mark.parametrize("form", ["--markdown", "--csv"])
def test_a_record_is_kept_whatever_is_printed(tmp_path, form):
    make_run(tmp_path / "runs", "dmc-walker-run")
    path = tmp_path / "small.csv"
    words = ["report", str(tmp_path / "runs"), form, "--record", str(path)]
    assert CliRunner().invoke(app, words).exit_code == 0
    assert len(record.read(path)) == 4


def test_three_suites_have_no_mean_of_both():
    lines = [line("wpt", 1.0, task=suite, suite=suite) for suite in ("dmc", "mw", "robotics")]
    assert set(record_tables.by_suite(lines)["wpt"]) == {"dmc", "mw", "robotics"}


def test_the_pages_rows_are_those_of_the_records_tables():
    root = Path(__file__).parents[3]
    table = (root / "zoo" / "results" / "small-benchmark.md").read_text().splitlines()
    page = (root / "docs" / "small-benchmark.md").read_text().splitlines()
    ablation = [line for line in page if line.startswith(("| dmc-", "| metaworld-"))]
    assert len(ablation) == 12 and set(ablation) <= set(table)
    begin = page.index("| method | DMControl | Meta-World | both |") + 2
    scores = page[begin : page.index("", begin)]  # a row for each method, a column for each suite
    assert len(scores) == 7
    for row in scores:
        method, *cells = [cell.strip() for cell in row.strip("|").split("|")]
        for suite, cell in zip(("dmc", "metaworld", "both"), cells, strict=True):
            matching = [
                x for x in table if re.match(rf"\| {suite} \| {method} \| \d+ \| \d+ \|", x)
            ]
            assert not cell or matching[0].endswith(f"| {cell} |")


def test_the_baselines_on_the_page_of_results_are_those_of_their_record():
    root = Path(__file__).parents[3]
    page = (root / "docs" / "results.md").read_text()
    rows = re.findall(r"^\| .*\|$", page.split("\n## Baselines\n")[1].split("\n## ")[0], re.M)
    recorded = {
        (one.method, f"{one.success:.2f} ({one.return_:.0f})")
        for one in record.read(root / "zoo" / "results" / "baselines.csv")
        if one.success is not None
    }
    shown = set()
    for row in rows:
        first, *cells = row.replace("*", "").strip("|").split("|")
        names = re.findall(r"`([^`]+)`", first) or [""]
        method = names[0]
        if first.strip().startswith("prior actor"):
            method = "prior actor" if method == "wpt+" else f"prior actor, {method}"
        shown |= {(method, score) for score in re.findall(r"\d\.\d\d \(\d+\)", " ".join(cells))}
    assert len(shown) >= 18 and shown <= recorded


def test_methods_are_told_from_doing_nothing_to_ours():
    assert set(METHODS) < set(record.ORDER)
    order = ["nothing", "scratch", "wpt", "wpt, last", "kickstart", "another's"]
    lines = [line(method, 1.0, task=task) for task in "ba" for method in reversed(order)]
    shown = sorted(lines, key=record.order)
    assert [(x.task, x.method) for x in shown] == [(task, m) for task in "ab" for m in order]
    assert list(record_tables.by_suite(lines)) == [
        "nothing",
        "scratch",
        "wpt, last",
        "wpt",
        *order[4:],
    ]


def test_a_method_of_two_presets_is_drawn_with_what_was_changed():
    keys = [
        Key("scratch", Variant.parse("tiny"), 10),
        Key("wpt", Variant.parse("tiny"), 10),
        Key("wpt", Variant.parse("tiny train_ratio=64"), 10),
    ]
    assert record_picture.row_names(keys) == ["scratch", "wpt", "wpt,\ntrain_ratio=64"]
    assert (
        record_picture.row_names([*keys, Key("wpt", Variant.parse("tiny"), 30)])[1]
        == "wpt, 10 frames"
    )
    others = [Key("wpt", Variant.parse("tiny"), 10), Key("wpt", Variant.parse("small"), 10)]
    assert record_picture.row_names(others) == ["wpt,\ntiny", "wpt,\nsmall"]


def test_a_method_of_two_budgets_is_drawn_with_both():
    keys = [
        Key("nothing", Variant(""), 0),
        Key("scratch", Variant.parse("tiny"), 100),
        Key("scratch", Variant.parse("tiny"), 3000),
    ]
    assert record_picture.row_names(keys) == [
        "nothing",
        "scratch, 100 frames",
        "scratch, 3,000 frames",
    ]


def test_two_seeds_have_no_interval_by_students_t():
    assert str(record_tables.Cell.of([0.0, 85.0])) == "42.5"
    assert str(record_tables.Cell.of([40.0, 50.0, 60.0])) == "50.0 (25.2 to 74.8)"
    # sd 11.5, 6.7 -+ 4.303 * 11.5 / sqrt(3) = 28.7; a success rate is not negative
    scores = enumerate((0.0, 0.0, 20.0))
    rates = [line("wpt", score, seed=seed, suite="metaworld") for seed, score in scores]
    (cells,) = record_tables.by_task(rates).values()
    assert [str(cell) for cell in cells.values()] == ["6.7 (0.00* to 35.4)"]
