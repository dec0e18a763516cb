"""Budgets that belong to a size: small sizes do not get the paper's."""

import json
import zipfile
from pathlib import Path

import pytest
from debug_agent import SETTINGS, recorded
from toy_env import DotEnv

from wpt_agents.agents.jsrl import JSRL
from wpt_agents.agents.wpt import WPT
from wpt_agents.files.model_file import read_model
from wpt_agents.model.sizes import SIZES, Size
from wpt_agents.training.hyperparameters import Hyperparameters
from wpt_agents.zoo.plan.presets import load_preset, preset_names, suite_names
from wpt_agents.zoo.plan.runs import Run
from wpt_agents.zoo.tasks import find_tasks

TABLE_2 = {
    "learning_starts": 5_000,
    "warmup_steps": 7_500,
    "guidance": "linear(1,0,50000)",
    "num_retrieve": 500,
    "bc_steps": 150_000,
    "bc_batch_size": 256,
}
LEAST = {"size": "debug", "max_action_dim": 4, "device": "cpu", "seed": 0}
SCRATCH = LEAST | {"offline_ratio": 0, "guidance": 0, "train_ratio": 0}


@pytest.fixture
def data():
    return [recorded(seed=seed) for seed in range(4)]


def budgets(model):
    return {name: getattr(model, name) for name in TABLE_2}


@pytest.mark.parametrize("size", ["paper", "medium", {**vars(SIZES["debug"]), **TABLE_2}])
def test_table_2_is_the_default_of_paper_medium_and_of_new_widths(size):
    settings = Hyperparameters(size=size)
    assert {name: settings.value(name) for name in TABLE_2} == TABLE_2
    assert settings.value("imagine_starts") == 0  # dreams start from all states, as in Algorithm 1
    assert {name: getattr(Size(64, 32, 8, 8, 4, 32), name) for name in TABLE_2} == TABLE_2


def test_budgets_do_not_fall_as_sizes_grow():
    order = [SIZES[name] for name in ("debug", "tiny", "mid", "small", "medium", "paper")]
    for name in (*TABLE_2, "pretrain_steps"):
        if name != "guidance":
            values = [getattr(size, name) for size in order]
            assert values == sorted(values), (name, values)


@pytest.mark.slow
def test_a_debug_model_of_the_defaults_clones_and_learns_within_a_thousand_steps(data):
    model = WPT.pretrain(data, steps=1, batch_size=2, batch_length=4, train_ratio=0.5, **LEAST)
    assert budgets(model) == {
        "learning_starts": 200,
        "warmup_steps": 200,
        "guidance": "linear(1,0,1000)",
        "num_retrieve": 5,
        "bc_steps": 200,
        "bc_batch_size": 32,
    }
    model.set_env(DotEnv())
    model.learn(225)
    assert model.cloned and model.updates == 14  # 225 steps, each pays for 0.5 / (2 * 4) updates


def test_what_the_size_decided_is_saved_shown_and_printed(data, tmp_path, capsys):
    model = WPT("WPTPolicy", DotEnv(), verbose=1, bc_steps=7, **SCRATCH)
    model.save(tmp_path / "model.zip")
    saved = read_model(tmp_path / "model.zip")[0]["hyperparameters"]
    assert saved["bc_steps"] == 7 and saved["bc_batch_size"] == 32 and saved["warmup_steps"] == 200
    shown = repr(model)
    for text in (
        "WPT(",
        "size='debug'",
        "bc_steps=7",
        "learning_starts=200",
        "learning_rate=0.001",
    ):
        assert text in shown, shown
    assert "gamma" not in shown  # a default
    capsys.readouterr()
    model.learn(1)
    assert "bc_steps=7" in capsys.readouterr().out


def test_a_model_file_of_version_0_1_keeps_the_values_that_it_was_saved_with(tmp_path):
    model = WPT("WPTPolicy", DotEnv(), **LEAST)
    model.save(tmp_path / "model.zip")
    earlier = tmp_path / "earlier.zip"
    with zipfile.ZipFile(tmp_path / "model.zip") as new, zipfile.ZipFile(earlier, "w") as old:
        for name in new.namelist():
            content = new.read(name)
            if name == "about.json":
                header = json.loads(content)
                header["hyperparameters"] |= TABLE_2  # which version 0.1 saved at every size
                content = json.dumps(header)
            old.writestr(name, content)
    assert budgets(WPT.load(earlier)) == TABLE_2
    assert budgets(WPT.load(earlier, bc_steps=9)) == TABLE_2 | {"bc_steps": 9}


def test_a_file_whose_size_lacks_the_budgets_loads_and_goes_on(data, tmp_path):
    widths = {name: value for name, value in vars(Size(64, 32, 4, 8, 4, 32)).items()}
    earlier = {k: v for k, v in widths.items() if k not in {*TABLE_2, "pretrain_steps"}}
    WPT.pretrain(data, steps=1, run_dir=tmp_path, **SETTINGS | {"size": earlier})
    model = tmp_path / "model.zip"
    with zipfile.ZipFile(model) as archive:
        contents = {name: archive.read(name) for name in archive.namelist()}
    header = json.loads(contents["about.json"])
    header["hyperparameters"]["size"] = earlier
    contents["about.json"] = json.dumps(header)
    with zipfile.ZipFile(model, "w") as archive:
        for name, content in contents.items():
            archive.writestr(name, content)
    assert WPT.load(model).pretrain_steps == 1
    again = WPT.pretrain(data, steps=2, run_dir=tmp_path, **SETTINGS | {"size": earlier})
    assert again.pretrain_steps == 2


def test_pretraining_makes_the_sizes_own_number_of_updates(data):
    steps = []
    few = {**vars(SIZES["debug"]), "pretrain_steps": 3}
    WPT.pretrain(data, callback=lambda step, _: steps.append(step), **SETTINGS | {"size": few})
    assert steps == [1, 2, 3]
    assert SIZES["paper"].pretrain_steps == 200_000  # Table 2


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("bc_steps", 0, "bc_steps must be a whole number of at least 1, got 0"),
        ("guidance", "linear", "guidance='linear' is not understood"),
        ("pretrain_steps", 1.5, "Size.pretrain_steps must be a whole number of at least 1"),
    ],
)
def test_a_size_with_an_impossible_budget_is_refused(field, value, message):
    with pytest.raises(ValueError, match=message):
        WPT("WPTPolicy", **LEAST | {"size": {**vars(SIZES["debug"]), field: value}})


@pytest.mark.parametrize(
    ("size", "steps", "batch", "number"),
    [("medium", 150_000, 256, 500), ("debug", 200, 32, 5)],
)
def test_the_clone_of_jsrl_has_the_budgets_of_its_size(size, steps, batch, number):
    agent = JSRL("CnnPolicy", DotEnv(), channels=2, hidden_dim=8, bc_size=size, device="cpu")
    assert (agent.bc_steps, agent.bc_batch_size, agent.num_retrieve) == (steps, batch, number)


@pytest.mark.parametrize("suite", suite_names())
def test_every_preset_has_the_budgets_that_it_had_before_sizes_had_any(suite, tmp_path):
    task = find_tasks(suite, [])[0]
    for name in preset_names(suite):
        preset = load_preset(suite, name)
        for method in ("wpt", "scratch", "no-guidance"):
            run = Run(task, 0, method, name, preset, tmp_path)
            written = {key: value for key, value in run.keywords.items() if key in TABLE_2}
            now = {key: run.full_keywords[key] for key in TABLE_2}
            assert now == TABLE_2 | written, (name, method)


def test_the_table_of_the_docs_holds_the_values_of_the_sizes():
    page = (Path(__file__).parents[2] / "docs" / "your-environment.md").read_text()
    names = ["debug", "tiny", "mid", "small", "medium"]
    rows = {**{name: name for name in TABLE_2 if name != "guidance"}, "pretrain_steps": "steps"}
    for field, title in rows.items():
        [line] = [line for line in page.splitlines() if line.startswith(f"| `{title}`")]
        shown = [cell.strip() for cell in line.strip("|").split("|")][2:]  # after name and unit
        expected = [f"{getattr(SIZES[name], field):,}" for name in names]
        assert [cell.split(", ")[0].split("; ")[0] for cell in shown] == expected, line
