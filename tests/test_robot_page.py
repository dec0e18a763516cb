"""The code of docs/on-a-robot.md runs from recording to acting, with a stand-in for the robot."""

import re
from pathlib import Path

import numpy as np
from debug_agent import SETTINGS, pretrained
from toy_env import DotEnv

PAGE = (Path(__file__).parents[1] / "docs" / "on-a-robot.md").read_text()
RECORD, LEARN, ACT = re.findall(r"```python\n(.*?)```", PAGE, re.S)


class Robot(DotEnv):
    """A dot as the driver of the page."""

    def __init__(self):
        super().__init__(actions=4)
        self.moves = 0
        self.home()

    def home(self):
        self.reset(seed=self.moves)

    def image(self):
        return self.render()

    def move(self, action):
        assert np.shape(action) == (4,) and np.abs(action).max() <= 1
        self.step(np.asarray(action))
        self.moves += 1

    def succeeded(self):
        return self.reward() > 0.95


class Operator:
    """Random actions in place of a person's."""

    rng = np.random.default_rng(0)

    def action(self):
        return self.rng.uniform(-1, 1, 4)


def test_the_code_of_the_page_records_learns_and_acts(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names = {"robot": Robot(), "operator": Operator()}
    exec(RECORD, names)
    assert names["robot"].moves == 100
    few = {"run_dir": "runs/arm", "num_retrieve": 1}
    pretrained("data/arm", **few)
    assert "learn(5_000)" in LEARN and SETTINGS["max_action_dim"] == 4
    exec(LEARN.replace("learn(5_000)", "learn(120)"), names)
    assert names["model"].updates > 0 and names["robot"].moves == 220
    exec(ACT, names)
    assert names["robot"].moves == 320 and names["model"].env is None
