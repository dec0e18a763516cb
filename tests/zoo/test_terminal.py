"""What the runner prints about its stages."""

from pathlib import Path

import pytest
from dot_runs import dot, job  # noqa: F401  (dot registers the task for each test)

from wpt_agents.zoo.plan.overview import show_plan
from wpt_agents.zoo.terminal import say


def test_brackets_in_a_path_are_printed(capsys):
    say("collect", "making", Path("runs [old]") / "data")
    assert capsys.readouterr().out == "collect   making  runs [old]/data\n"


def test_brackets_in_the_folders_of_a_plan_are_printed(tmp_path, capsys):
    show_plan([job(Path("[old]"))], force=False)
    printed = capsys.readouterr().out
    assert printed.count("[old]/") == 3  # the run, the dataset and the model


@pytest.mark.parametrize("text", ["[red]warm[/red]"])
def test_the_text_itself_may_have_colours(text, capsys):
    say("stage", text)
    assert capsys.readouterr().out == "stage     warm\n"
