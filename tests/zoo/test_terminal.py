"""What the runner prints about its stages."""

from pathlib import Path

import pytest
from debug_agent import recorded
from dot_runs import dot, job  # noqa: F401  (dot registers the task for each test)

from wpt_agents.data.dataset import TrajectoryDataset
from wpt_agents.zoo.commands.options import print_table
from wpt_agents.zoo.pictures.datasets import data_table
from wpt_agents.zoo.plan.overview import show_plan
from wpt_agents.zoo.terminal import console, say


def test_brackets_in_a_path_are_printed(capsys):
    say("collect", "making", Path("runs [old]") / "data")
    assert capsys.readouterr().out == "collect   making  runs [old]/data\n"


def test_brackets_in_the_folders_of_a_plan_are_printed(tmp_path, capsys):
    show_plan([job(Path("[old]"))], force=False)
    printed = capsys.readouterr().out
    assert printed.count("[old]/") == 3  # the run, the dataset and the model


def test_brackets_in_the_name_of_a_robot_are_printed(tmp_path, capsys):
    with TrajectoryDataset.create(tmp_path / "data") as dataset:
        dataset.append(recorded(embodiment="arm [left]"))
    console.print(data_table(dataset))
    print_table("errors", [{"robot": "arm [left]", "error": 1.0}])
    assert capsys.readouterr().out.count("arm [left]") == 2


@pytest.mark.parametrize("text", ["[red]warm[/red]"])
def test_the_text_itself_may_have_colours(text, capsys):
    say("stage", text)
    assert capsys.readouterr().out == "stage     warm\n"
