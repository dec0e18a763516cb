"""README and docs say what is so: the example runs, and every name, keyword and value exists."""

import ast
import inspect
import re
from importlib import import_module
from pathlib import Path
from pkgutil import resolve_name

import gymnasium as gym
import numpy as np
import pytest
import toy_env
from debug_agent import SETTINGS, agent
from stable_baselines3.common.logger import Logger
from wpt_envs import dmc
from wpt_envs.tasks import TASKS

import wpt_agents

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()
PAGES = {
    str(path.relative_to(ROOT / "docs")): path.read_text()
    for path in sorted((ROOT / "docs").rglob("*.md"))
    if "_build" not in path.parts
}
TINY = {  # what the example says -> what runs here
    "wpt/metaworld-drawer-close-v0": "Dot-v0",
    "wpt/metaworld-door-close-v0": "OtherDot-v0",
    "wpt/dmc-walker-stand-v0": "ThirdDot-v0",
    'behaviour="scripted"': 'behaviour="noise"',
    "episodes=20": "episodes=2",
    "**settings": "**SETTINGS",
    "steps=1500": "steps=2",
    "learn(4000": "learn(75",
}


def blocks(text, language="python"):
    return re.findall(rf"```{language}\n(.*?)```", text, re.S)


def section(title, page=README):
    return re.search(rf"## {title}\n(.*?)(?=\n## |\Z)", page, re.S)[1]


EXAMPLE = blocks(section("Example"))[0]
NAMES = re.findall(r"`((?:\w+\.)+\w+)`", section("The paper, by name", PAGES["paper.md"]))


def make_dot(rendering="near", render_mode=None):
    return toy_env.DotEnv()


@pytest.fixture
def dots():
    names = [name for name in TINY.values() if name.endswith("-v0")]
    for name in names:
        gym.register(name, make_dot)
    yield
    for name in names:
        del gym.registry[name]


@pytest.mark.filterwarnings("ignore:rich is experimental")  # says tqdm of the bar that SB3 takes
def test_the_example_runs_as_it_stands(dots, tmp_path, monkeypatch, capsys):
    code = EXAMPLE
    for full, tiny in TINY.items():
        assert full in code, full
        code = code.replace(full, tiny)
    monkeypatch.chdir(tmp_path)
    settings = {name: value for name, value in SETTINGS.items() if name != "seed"}
    exec(code, left := {"SETTINGS": settings})
    assert re.search(r"return: mean -?\d+", capsys.readouterr().out)
    assert left["model"].updates == 75 * 0.5 // (2 * 4)  # train_ratio / (B x T)
    assert len(left["model"].retrieved_ids) == 3 and (tmp_path / "drawer.zip").exists()


def test_the_readme_is_short():
    assert len(README.split()) <= 900
    assert len([line for line in EXAMPLE.splitlines() if line.strip()]) <= 18


def test_the_readme_uses_public_names_only():
    modules = [
        (node.module, [alias.name for alias in node.names])
        for code in blocks(README)
        for node in ast.walk(ast.parse(code))
        if isinstance(node, ast.ImportFrom)
    ]
    assert modules
    for module, names in modules:
        if not module.startswith("stable_baselines3."):
            assert module == "wpt_agents" and set(names) <= set(wpt_agents.__all__)


def test_ones_own_data_are_stored_as_the_page_says(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    image, action = np.zeros((4, 64, 64, 3), np.uint8), np.zeros((3, 7), np.float32)
    exec(blocks(PAGES["importing.md"])[0], left := {"image": image, "action": action})
    assert left["dataset"].embodiments == ["arm"]


def test_the_table_of_the_paper_names_what_exists():
    assert len(NAMES) >= 25
    for name in NAMES:
        assert callable(resolve_name(f"wpt_agents.{name}")), name


def test_every_task_and_keyword_that_is_named_exists():
    for page in (README, *PAGES.values()):
        assert set(re.findall(r"wpt/[a-z-]+-v0", page)) <= TASKS.keys()
    assert f"registers {len(TASKS)} tasks" in PAGES["envs.md"]
    assert f"{len(TASKS)} from pixels" in README
    keywords = set(re.findall(r"^\| `(\w+)` \|", section("Keywords", PAGES["envs.md"]), re.M))
    assert keywords == inspect.signature(dmc.make).parameters.keys() - {"task", "render_mode"}


@pytest.mark.parametrize("name", ["../README.md", *PAGES])
def test_no_table_is_broken_by_an_empty_line(name):
    text = re.sub(r"```.*?```", "", (ROOT / "docs" / name).read_text(), flags=re.S)
    for table in re.findall(r"(?:^\|.*\n)+", text, re.M):
        rows = table.splitlines()
        assert len(rows) > 2 and re.fullmatch(r"\|( ?-+ ?\|)+", rows[1]), table


def test_the_versions_on_the_page_of_experiments_lie_within_the_bounds():
    packaging = import_module("packaging.specifiers")
    project = (ROOT / "pyproject.toml").read_text()
    tested = section("Versions that work together", PAGES["experiments.md"])
    versions = re.findall(r"([a-z0-9_-]+)\s(\d+\.\d+\.\d+)", tested)
    assert len(versions) >= 9
    for name, version in versions:
        bound = re.search(rf'"{name.replace("dm_control", "dm-control")}([<>=][^";]*)', project)
        assert name == "mujoco" or packaging.SpecifierSet(bound[1]).contains(version), name


def test_every_logged_value_is_explained_and_no_other(monkeypatch):
    seen = set()
    monkeypatch.setattr(Logger, "dump", lambda self, step=0: seen.update(self.name_to_value))
    agent(toy_env.DotEnv()).learn(75, log_interval=1)
    page = PAGES["when-it-does-not-learn.md"]
    explained = set(re.findall(r"`((?:train|rollout|time)/\w+)`", page))
    # A dot reports no success, its episodes are short and do not terminate, and the others are off
    # by default.
    unseen = {"rollout/success_rate", "rollout/reward_per_step", "train/continue_loss"}
    unseen |= {"train/kickstart_loss", "train/kickstart_weight", "train/reward_disagreement"}
    unseen |= {"train/correction", "train/imitator_loss"}
    assert explained == seen | unseen


def test_a_dataset_is_made_and_used_as_its_page_says(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    exec(blocks(PAGES["data.md"])[0], left := {})
    assert capsys.readouterr().out.endswith(" []\n")
    assert left["batch"].image.shape == (16, 64, 64, 64, 3)
    assert left["both"].lengths.tolist() == [100, 100]
    left["dataset"].close()


def test_the_model_file_opens_with_other_peoples_readers(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    agent().save("walker.zip")
    exec(blocks(PAGES["model-file.md"])[0], left := {})
    assert left["about"]["hyperparameters"]["size"] == "debug"
    assert any(name.startswith("world_model.") for name in left["weights"])
