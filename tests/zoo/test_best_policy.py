"""Which of a run's policies is kept as the best one, decided by what the task counts."""

from contextlib import closing

import numpy as np
import pytest
from debug_agent import ClockEnv, agent
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv
from wpt_envs import TASKS

from wpt_agents.agents.wpt import WPT
from wpt_agents.zoo.run.checkpoints import HEAD_START_MODEL, HeadStart
from wpt_agents.zoo.run.logs import EvaluationCallback
from wpt_agents.zoo.tasks import metric_of
from wpt_agents.zoo.vec_envs import EpisodeSeeds

# returns and successes of two episodes in each of five evaluations, after 7, 14, ... steps
RETURNS = [[5, 5], [9, 9], [4, 6], [8, 8], [8, 8]]
SUCCESSES = [[0, 1], [0, 0], [1, 1], [1, 1], [1, 1]]


@pytest.fixture
def played(monkeypatch):
    """Evaluations that find what is written above."""
    left = [list(zip(*pair, strict=True)) for pair in zip(RETURNS, SUCCESSES, strict=True)]

    def play(model, env, callback, **_):
        episodes = left.pop(0)
        for _, success in episodes:
            callback({"done": True, "info": {"is_success": bool(success)}}, {})
        return [float(value) for value, _ in episodes], [7] * len(episodes)

    monkeypatch.setattr("stable_baselines3.common.callbacks.evaluate_policy", play)


def kept(folder, metric, parts=(35,)):
    """The steps after which the model was made that is kept, learning in parts."""
    model = agent(ClockEnv())
    for steps in parts:
        with closing(DummyVecEnv([lambda: EpisodeSeeds(Monitor(ClockEnv()))])) as venv:
            keywords = {"n_eval_episodes": 2, "eval_freq": 7, "log_path": str(folder), "verbose": 0}
            callback = EvaluationCallback(venv, metric, folder / "best_model.zip", **keywords)
            model.learn(steps, callback=callback, reset_num_timesteps=False)
    return WPT.load(folder / "best_model.zip").num_timesteps


def test_by_return_the_highest_mean_is_kept(tmp_path, played):
    assert kept(tmp_path, "return") == 14


def test_by_success_the_return_decides_only_among_equals_and_the_first_of_them_stays(
    tmp_path, played
):
    assert kept(tmp_path, "success") == 28


@pytest.mark.parametrize(("metric", "step"), [("return", 14), ("success", 28)])
def test_a_run_that_resumes_keeps_the_best_of_all_its_parts(tmp_path, played, metric, step):
    assert kept(tmp_path, metric, (14, 14, 7)) == step


def test_without_a_file_to_keep_none_is_written(tmp_path, played):
    with closing(DummyVecEnv([lambda: EpisodeSeeds(Monitor(ClockEnv()))])) as venv:
        callback = EvaluationCallback(
            venv, n_eval_episodes=2, eval_freq=7, log_path=str(tmp_path), verbose=0
        )
        agent(ClockEnv()).learn(14, callback=callback)
        assert callback.scores == [(5.0,), (9.0,)]
    assert [path.name for path in tmp_path.iterdir()] == ["evaluations.npz"]
    with np.load(tmp_path / "evaluations.npz") as arrays:
        assert arrays["successes"].tolist() == SUCCESSES[:2]


def test_each_suite_has_its_rule():
    rules = {task.suite: metric_of(task) for task in TASKS.values()}
    assert rules["dmc"] == "return" and rules["metaworld"] == "success"


def test_a_later_task_saves_the_end_of_its_own_head_start(tmp_path):
    model = agent(ClockEnv(length=7), learning_starts=7, train_ratio=4, actor_delay=5)
    model.learn(14, callback=HeadStart(tmp_path / "first"))
    saved = [(tmp_path / "first" / HEAD_START_MODEL).exists()]
    model.next_task(ClockEnv(length=7))
    model.learning_starts = 14
    for steps in (7, 7):  # the updates are made after step 14
        model.learn(steps, callback=HeadStart(tmp_path / "second"), reset_num_timesteps=False)
        saved.append((tmp_path / "second" / HEAD_START_MODEL).exists())
    assert saved == [True, False, True]


def test_the_end_of_the_head_start_is_saved_before_the_first_update_of_imagination(tmp_path):
    model = agent(ClockEnv(length=7), learning_starts=14, train_ratio=4, actor_delay=3)
    model.learn(14, callback=HeadStart(tmp_path))
    assert model.task_updates == 7  # the head start, and at once all that were earned
    assert WPT.load(tmp_path / HEAD_START_MODEL).task_updates == 3
    assert model.after_update is None
