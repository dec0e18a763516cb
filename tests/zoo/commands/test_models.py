"""`import-model`: the authors' files to ours and back, by the command line."""

from pathlib import Path

import pytest
import torch
from debug_agent import agent
from zoo_command import call

from wpt_agents.agents.wpt import WPT

TINY = Path(__file__).parents[2] / "fixtures" / "official_tiny.pt"


def test_a_file_of_the_authors_is_imported_and_exported(tmp_path, monkeypatch, capsys):
    ours, theirs = tmp_path / "new" / "tiny.zip", tmp_path / "tiny.pt"
    assert call(monkeypatch, "import-model", "official", TINY, ours, "--stoch", 4) == 0
    assert "deter 64, hidden 32, stoch 4, classes 6" in capsys.readouterr().out
    assert WPT.load(ours).policy.size.gates == "across"
    assert call(monkeypatch, "import-model", "--export", "official", ours, theirs) == 0
    shown = "agent.rssm.deter=64 agent.rssm.hidden=32 agent.rssm.stoch=4 agent.rssm.classes=6"
    assert shown in capsys.readouterr().out
    before, after = (torch.load(path, weights_only=True) for path in (TINY, theirs))
    for part in ("encoder", "rssm", "decoder"):
        pairs = [(before["wm"][part][k], after["wm"][part][k]) for k in before["wm"][part]]
        assert pairs and all(torch.equal(*pair) for pair in pairs)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("official", "model.zip", "a.zip"), "is for WPT.load"),
        (("official", "--export", "model.zip", "a.pt"), "whose size has gates='across'"),
        (("offical", "model.zip", "a.zip"), "No format 'offical'. Did you mean 'official'?"),
        (("official", "nothing.pt", "a.zip"), "There is no model file nothing.pt"),
    ],
)
def test_what_cannot_be_converted_ends_in_one_line(words, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    agent().save("model.zip")
    assert call(monkeypatch, "import-model", *words) == 2
    [line] = capsys.readouterr().err.splitlines()
    assert line.startswith("Error: ") and message in line
    assert not Path("a.zip").exists() and not Path("a.pt").exists()
