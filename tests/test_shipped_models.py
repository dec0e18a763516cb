"""The world models that come with the library: their cards, and the recorded runs that use them."""

import hashlib
import re
from pathlib import Path

import pytest

from wpt_agents.training.model_files import shipped
from wpt_agents.zoo.plan.methods import METHODS
from wpt_agents.zoo.plan.presets import load_preset
from wpt_agents.zoo.plan.shared import given_for
from wpt_agents.zoo.record_lines import read

ZOO = Path(__file__).parents[1] / "zoo"
CARDS = (ZOO / "models" / "README.md").read_text(encoding="utf-8")
NAMES = sorted(path.stem for path in (ZOO / "models").glob("*.zip"))


def digest(name):
    return hashlib.sha256(shipped()[name].read_bytes()).hexdigest()


@pytest.mark.parametrize("name", NAMES)
def test_each_model_is_small_and_has_a_card_with_its_hash(name):
    assert {"metaworld-mid", "dmc-mid"} <= set(NAMES)
    assert shipped()[name].stat().st_size <= 6_000_000
    card = re.search(rf"\n## {name}\n(.*?)(?=\n## |\Z)", CARDS, re.S)[1]
    rows = dict(re.findall(r"^\| ([\w-]+) \| (.*) \|$", card, re.M))
    assert digest(name) in rows["SHA-256"]
    assert {"Size", "Data", "Training", "Licence"} <= set(rows)
    assert "updates" in rows["Training"]
    assert "mean of 1 to 40" in card  # errors on held-out episodes
    assert "R²" in card  # probes


def test_recorded_runs_of_the_unchanged_preset_began_with_the_shipped_file():
    lines = [
        line
        for line in read(ZOO / "results" / "mid.csv")
        if line.frames and str(line.preset) == "mid"
    ]
    assert lines
    for line in lines:
        word = line.method.removeprefix("prior actor, ").split(",")[0]
        method = METHODS["wpt" if word == "prior actor" else word]
        name = given_for(load_preset(line.suite, "mid"), method.agent)
        expected = digest(name)[:12] if method.pretrained and name else ""
        assert line.model_hash == expected, (line.task, line.method, line.seed)
