"""The table of tasks, and what importing the package does."""

import inspect
import re
import subprocess
import sys
from pathlib import Path

import gymnasium as gym
import pytest
import wpt_envs
from wpt_envs import dmc, metaworld, robotics, tasks
from wpt_envs.simulated import Simulated

from wpt_agents.zoo.commands import app as command_line

IMPORT = """
import sys, wpt_envs
loaded = {"mujoco", "dm_control", "metaworld", "gymnasium_robotics", "torch"} & set(sys.modules)
assert not loaded, loaded
assert not [name for name in sys.modules if name.split(".")[0] == "wpt_agents"]
"""


@pytest.mark.parametrize("module", [dmc, metaworld, robotics])
def test_the_table_knows_how_often_an_action_is_repeated_by_default(module):
    default = inspect.signature(module.make).parameters["action_repeat"].default
    rows = tasks.suite(module.__name__.split(".")[-1], paper_only=False)
    assert {task.action_repeat for task in rows} == {default}


def test_the_paper_has_22_dmcontrol_and_50_metaworld_tasks():
    assert len(tasks.suite("dmc")) == 22
    assert len(tasks.suite("metaworld")) == 50
    assert not any(task.in_paper for task in tasks.suite("robotics", paper_only=False))


def test_cheetah_run_hard_is_there_but_not_counted():
    assert not wpt_envs.TASKS["wpt/dmc-cheetah-run-hard-v0"].in_paper


def test_every_task_is_registered():
    assert set(wpt_envs.TASKS) == {name for name in gym.registry if name.startswith("wpt/")}


def test_importing_loads_no_simulator_no_torch_and_no_agent():
    subprocess.run([sys.executable, "-c", IMPORT], check=True)


def test_the_ant_sequence_is_six_quadruped_tasks_in_the_papers_order():
    names = [wpt_envs.TASKS[name].name for name in wpt_envs.ANT_SEQUENCE]
    order = ["stand", "walk", "run", "jump", "roll", "roll-fast"]
    assert names == [f"quadruped-{name}" for name in order]


def test_a_suites_width_is_that_of_its_widest_embodiment():
    assert [tasks.suite_width(name) for name in ("dmc", "metaworld", "robotics")] == [12, 4, 30]


def test_an_unknown_task_is_answered_with_the_nearest_names():
    with pytest.raises(ValueError, match="walker-run"):
        tasks.find("dmc", "walker-rum")


def test_an_unknown_id_is_answered_with_the_nearest():
    with pytest.raises(gym.error.NameNotFound, match="dmc-walker-run"):
        gym.make("wpt/dmc-walker-rum-v0")


def test_the_zoo_prints_the_table(monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "120")
    monkeypatch.setattr(sys, "argv", ["zoo", "list"])
    with pytest.raises(SystemExit):
        command_line.main()
    printed = {tuple(re.findall(r"[\w-]+", line)) for line in capsys.readouterr().out.splitlines()}
    for row in wpt_envs.TASKS.values():
        numbers = str(row.action_dim), str(row.frames)
        paper = "yes" if row.in_paper else "no"
        name = f"{row.suite}-{row.name}"
        assert (name, row.embodiment, *numbers, row.metric, paper) in printed


FAMILIES = {dmc: dmc.DMControl, metaworld: metaworld.MetaWorld, robotics: robotics.Robotics}
HEADINGS = (
    "Description, Action Space, Observation Space, Rewards, Starting State, Episode End, "
    "Arguments, Version History"
)


@pytest.mark.parametrize("family", FAMILIES.values())
def test_a_family_is_described_in_gymnasiums_form(family):
    assert re.findall("## (.*)", family.__doc__) == HEADINGS.split(", ")


@pytest.mark.parametrize(("module", "family"), FAMILIES.items())
def test_every_keyword_of_a_family_is_described_and_no_other(module, family):
    of_family = family.__doc__.split("## Arguments")[1].split("## Version")[0]
    described = re.findall(
        r"`(\w+)(?:=[^`]*)?`", Simulated.__doc__.split("## Arguments")[1] + of_family
    )
    keywords = inspect.signature(module.make).parameters.keys() - {"task"}
    assert keywords <= set(described)
    assert set(re.findall(r"- `(\w+)", Simulated.__doc__ + of_family)) <= keywords


def test_an_unknown_suite_is_answered_with_all_suites():
    with pytest.raises(ValueError, match="dmc, metaworld, robotics"):
        tasks.suite("dcm")


def test_a_padding_which_is_no_number_is_refused():
    with pytest.raises(ValueError, match="'suite'"):
        tasks.pad_width("dmc", "widest")


def test_the_pages_example_runs():
    page = (Path(__file__).parents[2] / "docs" / "envs.md").read_text()
    code = re.search(r"```python\n(.*?)```", page, re.S)[1]
    several = 'num_envs=4, vectorization_mode="async"'
    assert several in code
    exec(code.replace(several, "num_envs=1"), left := {})
    assert left["env"].action_space.shape == (12,)
    assert left["envs"].single_action_space.shape == (4,)
    assert left["pole"].reset(seed=0)[0].shape == (64, 64, 3)
