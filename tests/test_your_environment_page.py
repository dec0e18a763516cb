"""The code and the tables of docs/your-environment.md agree with the agents."""

import inspect
import re
import sys
from pathlib import Path
from types import SimpleNamespace

from debug_agent import pretrained, recorded
from toy_env import DotEnv

from wpt_agents import WPT, TrajectoryDataset
from wpt_agents.agents.sb3_keywords import SB3_KEYWORDS

PAGE = (Path(__file__).parents[1] / "docs" / "your-environment.md").read_text()
FROM_SB3, SEARCH = PAGE.split("## Coming from Stable-Baselines3")[1].split("## Search for hyper")


class Trial:
    """Proposes the first or lowest value, and records what is reported."""

    number = 3

    def __init__(self):
        self.reported = []

    def suggest_categorical(self, name, choices):
        return choices[0]

    def suggest_float(self, name, low, high, log):
        return low

    def report(self, value, step):
        self.reported.append(step)

    def should_prune(self):
        return False


def optuna(trial):
    """A stand-in with the names of Optuna that the page uses."""

    def create_study(direction, storage, study_name, load_if_exists):
        def optimize(objective, n_trials):
            trial.mean = objective(trial)

        return SimpleNamespace(optimize=optimize)

    return SimpleNamespace(create_study=create_study, TrialPruned=RuntimeError)


def test_the_search_learns_in_blocks_and_reports_each(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with TrajectoryDataset.create("data/arm") as dataset:
        dataset.extend([recorded(seed=seed) for seed in range(3)])
    pretrained("data/arm", train_ratio=1).save("world-model.zip")
    trial = Trial()
    monkeypatch.setitem(sys.modules, "optuna", optuna(trial))
    [code] = re.findall(r"```python\n(.*?)```", SEARCH, re.S)
    for long, short in (
        ("learn(1_000", "learn(20"),
        ("episodes=10", "episodes=1"),
        ("[32,", "[1,"),
    ):
        assert long in code
        code = code.replace(long, short)
    exec(code, {"make_env": DotEnv})
    assert trial.reported == [20, 40, 60, 80]


def test_the_replacements_of_sb3s_keywords_are_keywords():
    keywords = inspect.signature(WPT).parameters
    assert {new for new, _ in SB3_KEYWORDS.values()} - {None} <= keywords.keys()
    for old in ("gradient_steps", "buffer_size", "tau", "max_grad_norm", "action_noise"):
        assert old in SB3_KEYWORDS and old in FROM_SB3
