"""Files that other programs read during a run are whole at every moment."""

from itertools import count

import numpy as np
import pytest
from debug_agent import ClockEnv, agent
from faults import kill_at_change, killed
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv

from wpt_agents.zoo.result import Result, Score, Variant, read_result, write_result
from wpt_agents.zoo.run.logs import EvaluationCallback
from wpt_agents.zoo.vec_envs import EpisodeSeeds

pytestmark = pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")


def evaluating(folder, steps):
    """Learns for some steps, with an evaluation of one episode after every seventh."""
    return agent(ClockEnv()).learn(steps, callback=evaluations_in(folder))


def evaluations_in(folder):
    venv = DummyVecEnv([lambda: EpisodeSeeds(Monitor(ClockEnv()))])
    return EvaluationCallback(venv, n_eval_episodes=1, eval_freq=7, log_path=str(folder), verbose=0)


def evaluations(folder):
    with np.load(folder / "evaluations.npz") as arrays:
        assert len(arrays["results"]) == len(arrays["timesteps"])
        return arrays["timesteps"].tolist()


def test_the_evaluations_are_whole_while_new_ones_are_written(tmp_path, monkeypatch):
    seen, savez = [], np.savez

    def write_and_look(path, **arrays):
        savez(path, **arrays)
        there = (tmp_path / "evaluations.npz").exists()
        seen.append(evaluations(tmp_path) if there else None)

    monkeypatch.setattr(np, "savez", write_and_look)
    evaluating(tmp_path, 21)
    assert seen == [None, [7], [7, 14]]  # a reader finds the earlier ones until the new are whole
    assert evaluations(tmp_path) == [7, 14, 21]
    assert [path.name for path in tmp_path.iterdir()] == ["evaluations.npz"]


def evaluate_until_killed(callback, number):
    kill_at_change(number)
    callback._on_step()


def test_killed_at_any_write_the_evaluations_are_those_before_or_after(tmp_path):
    path = tmp_path / "evaluations.npz"
    model = evaluating(tmp_path, 7)
    before = path.read_bytes()
    model.learn(7, reset_num_timesteps=False)
    callback = evaluations_in(tmp_path)
    callback.init_callback(model)
    callback.num_timesteps = model.num_timesteps
    states = []
    for number in count():
        path.write_bytes(before)
        over = not killed(evaluate_until_killed, callback, number)
        states.append(evaluations(tmp_path))
        if over:
            break
    assert states[0] == [7] and states[-1] == [7, 14]
    assert all(times in ([7], [7, 14]) for times in states) and len(states) > 3


def write_results_until_killed(folder, number):
    kill_at_change(number)
    write_result(folder, result(2.0))


def result(value):
    scores = {"last": Score((value, value), ())}
    return Result("dmc", "dot", "wpt", Variant.parse("toy"), 0, 75, 75, "return", scores)


def test_killed_at_any_write_a_result_is_that_before_or_after(tmp_path):
    states = set()
    for number in count():
        write_result(tmp_path, result(1.0))
        over = not killed(write_results_until_killed, tmp_path, number)
        states.add(read_result(tmp_path).scores["last"].returns)
        if over:
            break
    assert states == {(1.0, 1.0), (2.0, 2.0)} and number > 2
