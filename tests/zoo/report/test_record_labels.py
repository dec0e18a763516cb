"""The label of a record's line says what ran: its settings are those of the line's own commit.

When a preset changes, earlier lines need the former settings in their labels. The defaults of the
library are the present ones for both.
"""

import shlex
import subprocess
from collections import defaultdict
from functools import cache
from itertools import pairwise
from pathlib import Path

import pytest

from wpt_agents.zoo.plan import presets
from wpt_agents.zoo.plan.methods import METHODS, defaults
from wpt_agents.zoo.record_lines import read
from wpt_agents.zoo.report import record_curves

ROOT = Path(__file__).parents[3]
RESULTS = ROOT / "zoo" / "results"
NAMES = ["baselines", "mid", "small-benchmark", "tried"]
ELSEWHERE = "commit"  # a word of labels that separates runs of two commits; no setting


@cache
def presets_at(commit, suite):
    """Return the text of a suite's presets at a commit."""
    words = ["git", "-C", str(ROOT), "show", f"{commit}:zoo/{suite}.yaml"]
    shown = subprocess.run(words, capture_output=True, text=True)
    if shown.returncode:
        pytest.skip(f"the history does not have commit {commit}")
    return shown.stdout


def settings(suite, preset, changes, method):
    """Return the keywords of the agent, and the settings of environment and evaluation."""
    loaded = presets.load_preset(suite, preset, changes)
    one = METHODS[method]
    plus = loaded.plus if one.plus else {}
    keywords = one.settings({**loaded.wpt, **plus}, loaded.of_agent(one.agent))
    values = {**defaults(one.agent), **keywords, "env": loaded.env, "evaluate": loaded.evaluate}
    return {k: v for k, v in values.items() if one.needs_data or not k.startswith("bc_")}


@cache
def settings_now(suite, preset, changes, method):
    return settings(suite, preset, changes, method)


@cache
def settings_at(commit, suite, preset, changes, method, folder):
    (folder / f"{suite}.yaml").write_text(presets_at(commit, suite))
    with pytest.MonkeyPatch.context() as then:
        then.setattr(presets, "preset_folder", lambda: folder)
        return settings(suite, preset, changes, method)


@pytest.mark.parametrize("name", NAMES)
def test_labels_say_what_ran_at_the_commits_of_their_lines(name, tmp_path):
    lines = [line for line in read(RESULTS / f"{name}.csv") if line.frames]
    assert lines
    for line in lines:
        words = shlex.split(line.command)
        option = dict(pairwise(words))
        method, suite, preset = (option[f"--{x}"] for x in ("method", "suite", "preset"))
        ran = tuple(b for a, b in pairwise(words) if a == "--set")
        label = line.preset
        said = tuple(str(change) for change in label.changes if change.key != ELSEWHERE)
        first = line.commit.split(",")[0]
        then = settings_at(first, suite, preset, ran, method, tmp_path)
        now = settings_now(suite, label.preset, said, method)
        assert then == now, (line.task, line.method, line.seed, str(label), line.commit)


@pytest.mark.parametrize("name", NAMES)
def test_all_policies_of_a_run_have_the_same_label(name):
    labels = defaultdict(set)
    for line in read(RESULTS / f"{name}.csv"):
        if line.frames:
            labels[line.command, line.commit].add(str(line.preset))
    assert [names for names in labels.values() if len(names) > 1] == []


def test_the_learning_curves_have_the_labels_of_their_runs():
    record = RESULTS / "mid.csv"
    curves = {point.run for point in record_curves.read(record)}
    assert curves and curves <= {line.run for line in read(record)}
