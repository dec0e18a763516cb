"""The page says what the run folders say, and needs nothing but itself."""

import re
from html.parser import HTMLParser
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from run_folders import make_run, write_page

from wpt_agents.zoo.plan.methods import METHODS
from wpt_agents.zoo.report import aggregates, figures, headline
from wpt_agents.zoo.report.aggregates import misprint, references
from wpt_agents.zoo.report.folders import find_finished
from wpt_agents.zoo.report.paper_tables import Cell, TableRow, shared_note, without_notes
from wpt_agents.zoo.results import find_results


def make_runs(folder):
    for seed in (0, 1):
        make_run(folder, "dmc-walker-run", seed, "wpt", (700.0, 760.0))
        make_run(folder, "dmc-walker-run", seed, "scratch", (90.0, 110.0))
        make_run(folder, "metaworld-reach", seed, "wpt", (9.0, 1.0 + 8 * seed))
    failed = folder / "debug" / "wpt" / "dmc-walker-walk_0"
    failed.mkdir()
    (failed / "config.yaml").write_text("task: x")
    (failed / "error.txt").write_text("Traceback\nRuntimeError: <out> of luck\n")
    return folder


@pytest.fixture
def runs(tmp_path):
    return make_runs(tmp_path)


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    """The text of a page about `runs`; one for all tests, which only read it."""
    runs = make_runs(tmp_path_factory.mktemp("runs"))
    write_page(runs, runs / "report" / "index.html")
    return (runs / "report" / "index.html").read_text()


class Reader(HTMLParser):
    """Collects attributes, and checks that elements close in order."""

    def __init__(self):
        super().__init__()
        self.open, self.links, self.ids = [], [], []

    def handle_starttag(self, tag, attributes):
        self.handle_startendtag(tag, attributes)
        if tag not in ("meta", "br", "img"):
            self.open.append(tag)

    def handle_startendtag(self, tag, attributes):
        values = dict(attributes)
        self.links += [values[key] for key in ("src", "href", "xlink:href") if key in values]
        self.ids += [values["id"]] if "id" in values else []

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def read(page):
    reader = Reader()
    reader.feed(page)
    assert reader.open == []
    return reader


def text(page):
    return re.sub(r"\s+", " ", re.sub(r"<(style|svg).*?</\1>|<[^>]+>", " ", page, flags=re.S))


def test_the_page_needs_no_network_and_no_script(page):
    outside = {link for link in read(page).links if not link.startswith(("#", "data:"))}
    assert outside == {"https://arxiv.org/abs/2108.13264"}  # a link to read, nothing that loads
    assert "<script" not in page and "@import" not in page and "url(http" not in page


def test_every_link_within_the_page_leads_somewhere(page):
    reader = read(page)
    assert {link[1:] for link in reader.links if link.startswith("#")} <= set(reader.ids)
    runs = [name for name in reader.ids if name.startswith("run-")]
    assert len(runs) == len(set(runs)) == 6


def test_our_numbers_stand_beside_the_papers(page):
    row = text(re.search(r"<tr><td>walker-run</td>.*?</tr>", page, re.S)[0])
    assert "730" in row and "728" in row  # ours, and Table 5's
    assert "100" in row  # scratch
    assert "Table 5: DMControl, return" in page and "Table 4" in page
    assert "wpt ours: 1,000 frames, seeds 0, 1, commit 0123456789ab" in text(page)


def test_budgets_seeds_and_commits_stand_in_the_cells_where_they_differ(tmp_path):
    make_run(tmp_path, "dmc-walker-run", 0)
    for seed in range(2):
        make_run(tmp_path, "dmc-cheetah-run", seed)
    write_page(tmp_path, tmp_path / "index.html")
    page = text((tmp_path / "index.html").read_text())
    assert "1,000 frames, seeds 0, commit 0123456789ab" in page
    assert "1,000 frames, seeds 0, 1, commit 0123456789ab" in page


def test_budgets_seeds_and_commits_stand_at_the_columns_head_where_they_agree():
    def row(*notes):
        return TableRow("task", False, [], [Cell(0.0, "a", note=note) for note in notes])

    rows = [row("1k frames", "1k frames"), row("1k frames", "2k frames")]
    notes = [shared_note(rows, place) for place in range(2)]
    assert notes == ["1k frames", ""]
    assert [[cell.note for cell in without_notes(r, notes).ours] for r in rows] == [
        ["", "1k frames"],
        ["", "2k frames"],
    ]


def test_tasks_that_were_not_run_are_folded_away(page):
    section = re.search(r'<section id="table-5">.*?</section>', page, re.S)[0]
    shown, far, folded = section.split("<details")
    rows = re.findall(r"<tr[^>]*><td>(.*?)</td>", shown)
    assert rows == ["walker-run", "mean", "median"]
    assert "21 more tasks of the paper, not run here" in folded and "acrobot-swingup" in folded
    assert "ours" not in far + folded  # no column of dashes


def test_one_seed_has_no_interval_and_the_page_says_so(tmp_path):
    make_run(tmp_path, "dmc-walker-run", 0, "wpt", (700.0, 760.0))
    make_run(tmp_path, "dmc-walker-run", 0, "scratch", (90.0, 110.0))
    write_page(tmp_path, tmp_path / "index.html")
    page = text((tmp_path / "index.html").read_text())
    assert "0.73 to 0.73" not in page
    assert "1 of 22 1 0.73 0.73 0.73 0.27" in page  # mean, median, IQM, optimality gap
    assert "scratch 1.00 1" in page  # probability of improvement, tasks in common
    assert "730 one seed" in page
    assert "No task has three seeds, so this cannot be said." in page
    assert "No run of the method" not in page


def test_misprints_of_the_paper_are_marked_with_what_the_rows_give(page):
    means = re.findall(r'<tr class="aggregate"><td>mean</td>.*?</tr>', page, re.S)
    assert any("0.90* rows give 0.656" in text(mean) for mean in means)


def test_which_printed_aggregates_do_not_follow_from_their_rows():
    wrong = {(r.task, r.method, r.samples): misprint(r) for r in references() if misprint(r)}
    assert {key: round(value, 4) for key, value in wrong.items()} == {
        ("mean", "dreamer-v3", 1_000_000): 0.6559,
        ("mean", "drq-v2", 150_000): 0.4298,
        ("mean", "wpt", 150_000): 0.7536,
        ("median", "wpt", 150_000): 0.835,
        ("mean", "ncrl", 150_000): 619.5455,
    }


def test_aggregates_profiles_curves_ablation_and_improvement_are_there(page):
    shown = text(page)
    # walker-run: 0.73 in both seeds; the paper's on the same task 0.728
    assert "wpt debug, 1,000 frames 1 of 22 2 0.73 0.73 0.73 0.27 0.73 0.73" in shown
    assert "scratch 1.00 1" in shown  # probability of improvement, tasks in common
    titles = re.findall(r'aria-label="([^"]*)"', page)
    assert "DMControl: performance profile" in titles and "metaworld-reach" in titles
    assert "DMControl: ablation, debug, 1,000 frames" in titles
    assert "Mean of the two suites" in shown


def test_every_run_shows_its_command_seed_commit_and_the_first_its_pictures(page):
    card = re.search(r'id="run-dmc-walker-run-scratch-debug-1000-1".*?</details>', page, re.S)[0]
    assert "python -m wpt_agents.zoo run --tasks dmc-walker-run" in card
    assert "seed 1" in card and "0123456789ab" in card
    assert page.count("<video") == 2  # one a task
    assert page.count("data:image/jpeg;base64,") == 4  # predictions and what was retrieved
    assert page.count("what was retrieved") == 2


def test_a_suite_and_a_method_that_were_added_are_on_the_page_under_their_names(tmp_path):
    for seed in range(2):
        for method, low in (("mine", 9.0), ("scratch", 0.0), ("wpt", 0.0)):
            make_run(tmp_path, "dots-left", seed, method, (low, 10.0))
    write_page(tmp_path, tmp_path / "index.html")
    page = (tmp_path / "index.html").read_text()
    assert "<h2>dots</h2>" in page
    assert "wpt scratch 0.50 1 wpt mine 0.00 1 mine scratch 1.00 1" in text(page)


@pytest.mark.parametrize(("media", "videos"), [("all", 6), ("none", 0)])
def test_how_many_videos_the_page_holds_is_ones_choice(runs, media, videos):
    write_page(runs, runs / "index.html", media)
    assert (runs / "index.html").read_text().count("<video") == videos


def test_the_seeds_under_a_table_of_policies_are_those_of_each_policy(tmp_path):
    for seed in range(2):
        make_run(tmp_path, "dmc-walker-run", seed, "scratch")
    make_run(tmp_path, "dmc-walker-run", 0)
    write_page(tmp_path, tmp_path / "index.html")
    page = text((tmp_path / "index.html").read_text())
    assert "prior actor, wpt: seed 0; 2 episodes per seed; commit 0123456789ab." in page
    assert "scratch: seeds 0, 1; 2 episodes per seed" in page


def test_what_failed_is_told_and_escaped(page):
    assert "RuntimeError: &lt;out&gt; of luck" in page


def test_a_page_of_failures_alone_is_made_too(tmp_path):
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "config.yaml").write_text("")
    write_page(tmp_path, tmp_path / "index.html")
    assert "stopped, or still running" in (tmp_path / "index.html").read_text()


def test_figures_are_whole_svg_in_the_pages_colours():
    band = np.array([1.0, 2.0]), np.array([0.5, 1.5]), np.array([1.5, 2.5])
    line = figures.Line("wpt", np.array([0.0, 10.0]), band)
    drawn = figures.lines("a & b", "x", "y", [line], ["wpt"])
    root = ElementTree.fromstring(drawn.replace("<svg", '<svg xmlns="http://www.w3.org/2000/svg"'))
    assert root.get("aria-label") == "a & b"
    colours = set(re.findall(r"(?:fill|stroke): ([^;\"]+)", drawn)) - {"none"}
    assert colours == {"var(--series-1)", "var(--ink)", "var(--muted)", "var(--line)"}


def test_bars_below_zero_are_drawn(monkeypatch):
    drawn = []
    monkeypatch.setattr(figures, "svg", lambda figure, _: drawn.append(figure))
    for value in (-0.14, 0.0):
        figures.bars("a", "y", {"none": (value, None, None)}, [figures.INK])
    below, zero = (figure.axes[0].get_ylim() for figure in drawn)
    assert below[0] <= -0.14 and zero == (0, 1)


def test_the_papers_aggregate_is_over_the_tasks_that_were_run():
    tasks = ["dmc-walker-run", "dmc-walker-stand"]  # 728.0 and 969.4 in Table 5
    aggregate = aggregates.paper_aggregate("dmc", tasks, "wpt", 150_000)
    assert aggregate.mean == pytest.approx((0.728 + 0.9694) / 2)
    assert aggregates.paper_aggregate("dmc", tasks, "no-rehearsal", 150_000) is None


def test_every_colour_of_the_figures_is_on_the_page_light_and_dark(page):
    used = {variable for variable in figures.VARIABLES.values() if "series" in variable}
    assert len(used) == len(figures.SERIES)
    looks = {(figures.colour_of(m, METHODS), figures.dashes_of(m, METHODS)) for m in METHODS}
    assert len(looks) == len(METHODS)  # more methods than colours: dashes tell them apart
    for variable in used:
        assert page.count(f"{variable[4:-1]}: #") == 2
    template = Path(figures.__file__).with_name("page.html.jinja").read_text()
    assert f"% {len(figures.SERIES)} + 1" in template  # the key's


def test_the_key_tells_methods_of_one_colour_apart(tmp_path):
    methods = list(METHODS)
    for method in methods:
        make_run(tmp_path, "dmc-walker-run", method=method)
    write_page(tmp_path, tmp_path / "index.html")
    page = (tmp_path / "index.html").read_text()
    key = re.search(r'<div class="key">.*?</div>', page, re.S)[0]
    swatches = re.findall(r'<i style="background: ([^"]*)"></i>([^<]*)', key)
    assert [label for _, label in swatches] == methods
    assert len({look for look, _ in swatches}) == len(methods)


def test_a_policy_is_above_another_when_their_intervals_over_seeds_are_apart():
    high, low, wide, single = [9, 10, 11], [1, 2, 3], [0, 2, 10], [1]
    assert headline.above(high, low) and not headline.above(low, high)
    assert not headline.above(high, wide)  # t's interval of 0, 2, 10 reaches to 17
    assert not headline.above(high, single) and not headline.above(single, low)


def test_the_headline_compares_successes_where_they_are_the_score(tmp_path):
    for seed in range(3):  # 4.9 and less is no success
        make_run(tmp_path, "metaworld-reach", seed, "wpt", (4.9 - seed / 100, 4.9))
        make_run(tmp_path, "metaworld-reach", seed, "scratch", (0.0, 5.1 + seed / 100))
    [line] = headline.headlines(list(find_results(tmp_path).values()))
    against = {rival.policy: (rival.above, rival.below) for rival in line.against}
    assert against == {"random policy": (0, 0), "prior actor": (0, 0), "same, from scratch": (0, 1)}


def test_both_suites_are_told_of_at_their_least_budget(tmp_path):
    make_run(tmp_path / "a", "metaworld-reach", returns=(9.0, 1.0))
    make_run(tmp_path / "b", "dmc-walker-run", returns=(100.0, 100.0), frames=1000)
    make_run(tmp_path / "c", "dmc-walker-run", returns=(900.0, 900.0), frames=4000)
    [line] = headline.both_suites(list(find_results(tmp_path).values()))
    assert line.ours == pytest.approx((0.5 + 0.1) / 2)


@pytest.fixture
def further(tmp_path):
    """Runs of walker-run (0.728 in the paper), and of a task that is not in the paper."""
    make_run(tmp_path, "dmc-walker-run", returns=(700.0, 760.0))
    make_run(tmp_path, "dmc-quadruped-escape", returns=(0.0, 0.0))
    make_run(tmp_path, "metaworld-reach", returns=(9.0, 1.0))  # 0.5
    return tmp_path


def test_the_papers_means_stand_beside_ours_over_the_same_tasks(further):
    [line] = headline.both_suites(list(find_results(further).values()))
    assert line.ours == pytest.approx((0.73 + 0.5) / 2)
    write_page(further, further / "index.html")
    page = (further / "index.html").read_text()
    table = re.search(r'<section id="table-5">.*?</section>', page, re.S)[0]
    mean = text(re.search(r'<tr class="aggregate"><td>mean</td>.*?</tr>', table, re.S)[0])
    assert mean.startswith(" mean 730 of 1 task ")  # the rows of the table
    assert "debug, 1,000 frames 1 of 22 and 1 not in the paper 2 0.36" in text(page)
    assert "0.73 of 1 task" in text(page)  # the paper's


def test_a_task_without_a_score_of_the_method_in_the_paper_is_left_out_of_both_means(tmp_path):
    make_run(tmp_path, "dmc-walker-run", method="drq-v2", returns=(143.0, 143.0))
    make_run(tmp_path, "metaworld-reach", method="drq-v2", returns=(1.0, 1.0))  # 0.43 in Table 4
    make_run(tmp_path, "metaworld-door-close", method="drq-v2", returns=(9.0, 9.0))  # a dash
    [line] = headline.both_suites(list(find_results(tmp_path).values()))
    assert line.ours == pytest.approx((0.143 + 0.0) / 2)
    assert line.paper == pytest.approx((0.143 + 0.43) / 2)


def test_a_table_whose_tasks_were_not_run_has_no_mean(tmp_path):
    make_run(tmp_path, "dmc-quadruped-escape")
    write_page(tmp_path, tmp_path / "index.html")
    page = (tmp_path / "index.html").read_text()
    table = re.search(r'<section id="table-5">.*?</section>', page, re.S)[0]
    assert text(re.search(r"<td>mean</td>.*?</tr>", table, re.S)[0]).startswith(" mean – ")


def test_evaluations_without_successes_are_not_drawn_as_success_rates(tmp_path):
    folder = make_run(tmp_path, "metaworld-reach", returns=(9.0, 1.0))
    [run] = find_finished(tmp_path)
    assert run.evaluations()[1].max() == 1
    with np.load(folder / "evaluations.npz") as stored:
        arrays = {name: stored[name] for name in stored if name != "successes"}
    np.savez(folder / "evaluations.npz", **arrays)
    [run] = find_finished(tmp_path)
    assert run.evaluations() is None


def test_figure_2_shows_its_six_tasks_and_names_what_is_missing(page, tmp_path):
    words = text(page)
    assert "Figure 2: six tasks, all methods" in words
    assert "dmc-cheetah-run-hard: no run" in words
    lacking = "no run of 6 methods, drq-v2, dreamer-v3, r3m, jsrl-bc, uds, explore"
    assert f"dmc-walker-run: {lacking}" in words
    figure = page[page.index('id="figure-2"') : page.index('id="table-')]
    assert figure.count("<svg") == 1 and "metaworld-reach" not in figure
    key = re.search(r'<div class="key">.*?</div>', figure, re.S)[0]
    assert text(key).split() == ["wpt", "scratch"]
    make_run(tmp_path / "other", "metaworld-reach", 0, "wpt", (9.0, 1.0))
    write_page(tmp_path / "other", tmp_path / "other.html")
    assert "Figure 2" not in text((tmp_path / "other.html").read_text())


def test_figure_2_names_runs_that_have_no_curve(tmp_path):
    for method in ("wpt", "scratch"):
        folder = make_run(tmp_path, "dmc-walker-run", 0, method)
        (folder / "evaluations.npz").unlink()
        write_page(tmp_path, tmp_path / "page.html")
        page = (tmp_path / "page.html").read_text()
        assert f"no evaluations of {method}" in text(page) and '<a href="#figure-2">' in page
        make_run(tmp_path, "dmc-walker-run", 1, method)  # one seed with a curve is enough
    write_page(tmp_path, tmp_path / "page.html")
    assert "no evaluations of" not in text((tmp_path / "page.html").read_text())
