"""Curiosity on the simulator's state: novelty, its policies, and the data that they leave."""

import numpy as np
import pytest
import torch
from stable_baselines3 import SAC
from zoo_command import call

from wpt_agents.data.dataset import TrajectoryDataset
from wpt_agents.zoo.collect import state_curiosity
from wpt_agents.zoo.collect.collection import collect
from wpt_agents.zoo.collect.state_curiosity import Novelty, explore_states, state_policy

TASK = "wpt/dmc-cartpole-swingup-v0"
ENV = {"rendering": "fast"}


def test_novelty_falls_where_it_looks_often_and_stays_where_it_does_not():
    torch.manual_seed(0)
    novelty, rng = Novelty(3), torch.Generator().manual_seed(1)
    seen = torch.randn(64, 3, generator=rng)
    novelty._see(4 * torch.randn(4096, 3, generator=rng))  # the scale of all states
    far = seen + 8
    before = novelty.error(seen).mean(), novelty.error(far).mean()
    for _ in range(300):
        novelty.reward(seen + 0.01 * torch.randn(64, 3, generator=rng))
    after = novelty.error(seen).mean(), novelty.error(far).mean()
    assert after[0] < 0.2 * before[0]
    assert after[1] > 2 * after[0]


def test_the_running_mean_and_variance_are_those_of_all_states():
    novelty = Novelty(2)
    states = torch.randn(50, 2, generator=torch.Generator().manual_seed(0)) * 3 + 5
    for part in states.split([10, 25, 15]):
        novelty._see(part)
    torch.testing.assert_close(novelty.mean, states.mean(0))
    torch.testing.assert_close(novelty.var, states.var(0, correction=0))


@pytest.mark.parametrize(
    ("task", "env", "repeat"),
    [(TASK, ENV, 2), (TASK, {"action_repeat": 4}, 4), ("wpt/robotics-fetch-reach-v0", ENV, 1)],
)
def test_actions_are_repeated_as_often_as_where_the_data_are_played(task, env, repeat, monkeypatch):
    made = []

    class Seen(Exception):
        pass

    def note(_, times):
        made.append(times)
        raise Seen

    monkeypatch.setattr(state_curiosity.gym, "make", lambda *_, **__: None)
    monkeypatch.setattr(state_curiosity, "StateTask", note)
    with pytest.raises(Seen):
        explore_states(task, env)
    assert made == [repeat]


def test_a_stage_acts_as_soft_actor_critic_does():
    (weights,) = explore_states(TASK, ENV, steps=20, stages=1)
    state, act = np.linspace(-1, 1, 5), state_policy(weights)
    actions = [act(state, np.random.default_rng(seed)) for seed in range(4000)]
    import gymnasium as gym

    box = gym.spaces.Box(-np.inf, np.inf, (5,), np.float32)
    env = type("States", (gym.Env,), {"observation_space": box})()
    env.action_space = gym.spaces.Box(-1, 1, (1,), np.float32)
    actor = SAC("MlpPolicy", env, buffer_size=1, device="cpu").actor
    import io

    actor.load_state_dict(torch.load(io.BytesIO(weights), weights_only=True))
    many = torch.as_tensor(state, dtype=torch.float32).expand(4000, -1)
    with torch.no_grad():
        expected = actor(many).numpy()
    quantiles = [0.1, 0.3, 0.5, 0.7, 0.9]
    drawn = np.quantile(np.array(actions), quantiles)
    np.testing.assert_allclose(drawn, np.quantile(expected, quantiles), atol=0.08)


@pytest.mark.slow
def test_five_stages_are_recorded_in_turn_and_depend_on_the_seed_alone(tmp_path):
    def recorded(name, workers):
        return collect(
            *(tmp_path / name, [TASK], 6),
            behaviour="explore-state",
            env=ENV,
            workers=workers,
            progress_bar=False,
            settings={"steps": 40},
        )

    one, other = recorded("one", 1), recorded("other", 2)
    assert [source[-12:] for source in one.sources[:2]] == ["stage 1 of 5", "stage 2 of 5"]
    assert one.sources[5] == one.sources[0]
    for i in range(6):
        assert (one[i].action == other[i].action).all() and (one[i].image == other[i].image).all()
        assert one[i].reward is None
    assert not list((tmp_path / "one").glob("exploring-*"))


def test_a_killed_exploration_uses_the_stages_that_it_has(tmp_path, monkeypatch):
    settings = {"behaviour": "explore-state", "env": ENV, "workers": 1, "progress_bar": False}
    settings["settings"] = {"steps": 40}
    played = "wpt_agents.zoo.collect.collection.play"

    def killed(job):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(played, killed)
        with pytest.raises(KeyboardInterrupt):
            collect(tmp_path / "data", [TASK], 2, **settings)
    explored = "wpt_agents.zoo.collect.state_curiosity.explore_states"
    monkeypatch.setattr(explored, lambda *_, **__: pytest.fail("explored again"))
    assert len(collect(tmp_path / "data", [TASK], 2, **settings)) == 2


def test_the_command_line_knows_it_and_refuses_other_settings(tmp_path, monkeypatch, capsys):
    words = ["collect", "--tasks", "cartpole-swingup", "--behaviour", "explore-state"]
    words += ["--episodes", "1", "--rendering", "fast", "--out", tmp_path / "data"]
    assert call(monkeypatch, *words, "--set", "gamma=0.9") == 2
    assert "steps" in capsys.readouterr().err
    assert call(monkeypatch, *words, "--set", "steps=40", "--workers", "1") == 0
    assert len(TrajectoryDataset.open(tmp_path / "data")) == 1
