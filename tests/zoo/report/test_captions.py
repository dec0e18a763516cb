"""The page explains itself: intervals, captions, methods, and tables that fit into the window."""

import re

import numpy as np
import pytest
from run_folders import make_run, write_page
from test_page import text

from wpt_agents.zoo import numbers
from wpt_agents.zoo.plan.methods import METHODS
from wpt_agents.zoo.report import sections
from wpt_agents.zoo.report.names import MEANINGS


@pytest.fixture
def success_rates(tmp_path):
    """Three seeds of wpt with the success rates 1, 0.5 and 0, two of scratch with 0.5 and 1."""
    for seed, returns in enumerate(((9.0, 9.0), (9.0, 1.0), (1.0, 1.0))):
        make_run(tmp_path, "metaworld-reach", seed, "wpt", returns)
    for seed, returns in enumerate(((9.0, 1.0), (9.0, 9.0))):
        make_run(tmp_path, "metaworld-reach", seed, "scratch", returns)
    write_page(tmp_path, tmp_path / "index.html")
    return (tmp_path / "index.html").read_text()


def test_three_seeds_have_an_interval_with_marked_ends_and_two_have_their_values(success_rates):
    section = re.search(r'<section id="table-4">.*?</section>', success_rates, re.S)[0]
    row = text(re.search(r"<tr><td>reach</td>.*?</tr>", section, re.S)[0])
    # wpt: sd 0.5, t 4.303 with two degrees of freedom: 0.5 -+ 4.303 * 0.5 / sqrt(3) = 1.24
    assert "0.50 0.00* to 1.00*" in row and "0.75 0.50 and 1.00" in row
    assert numbers.RULE in text(section).replace("&#39;", "'")
    # the mean of scratch has no interval, that of wpt a bootstrap's: all three the same 1 / 27
    assert "scratch debug, 1,000 frames 1 of 50 2 0.75 0.75" in text(success_rates)
    assert "wpt debug, 1,000 frames 1 of 50 3 0.50 0.00 to 1.00" in text(success_rates)


def test_a_caption_says_what_is_shown_before_each_table_and_picture(success_rates):
    parts = re.split(r"<h[23]>|<details class=\"run\"", success_rates)[1:]
    shown = [part for part in parts if re.search("<table|<svg", part)]
    captions = [re.search('<(?:p class="note"|table|svg)', part)[0] for part in shown]
    policies = sum('class="policies"' in part for part in shown)
    runs = success_rates.count('<details class="run"')
    # the captions of policies and runs stand once, above all of their tables
    assert captions.count("<table") == policies + runs and "<svg" not in captions
    assert len(shown) > policies + runs + 4
    words = text(success_rates)
    assert "2 to 3 seeds per task and method, 2 evaluation episodes per seed" in words
    assert "the mean over the seeds, with 2 episodes of each." in words


def test_many_methods_are_divided_among_tables_that_fit_and_are_explained(tmp_path):
    for method in list(METHODS)[:8]:
        make_run(tmp_path, "dmc-walker-run", 0, method)
    write_page(tmp_path, tmp_path / "index.html")
    page = (tmp_path / "index.html").read_text()
    section = re.search(r'<section id="table-5">.*?</section>', page, re.S)[0]
    heads = re.findall(r"<tr><th>task</th>.*?</tr>", section.split("<details")[0], re.S)
    assert [head.count("<th") for head in heads] == [1 + 6 + 4, 1 + 2 + 4]
    names = re.findall(r'<th class="ours">([^<]*)<', "".join(heads))
    assert names == list(METHODS)[:8]
    assert "WPT, 150k frames" in heads[1] and "500k" not in heads[0] + heads[1]
    how = page[page.index('id="how"') :]
    explained = [name for name in METHODS if f"<b>{name}</b>" in how]
    assert explained == list(METHODS)[:8] and set(MEANINGS) == set(METHODS)


def test_the_band_of_a_curve_reaches_from_the_lowest_to_the_highest_seed():
    frames = np.array([10.0, 20.0])
    seeds = [(frames, np.array([[0.0, 2.0], [4.0, 4.0]])), (frames[:1], np.array([[3.0, 3.0]]))]
    middle, low, high = sections.curve("wpt", seeds).band  # one evaluation of both
    assert (middle.tolist(), low.tolist(), high.tolist()) == ([2.0], [1.0], [3.0])
    middle, low, high = sections.curve("wpt", seeds[:1]).band
    assert middle.tolist() == low.tolist() == high.tolist() == [1.0, 4.0]
