"""What every agent has: shown on one that learns a single number."""

import copy
import pickle
from dataclasses import dataclass

import numpy as np
import pytest
import torch
from debug_agent import ClockEnv, on_time, same, weights
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.vec_env import DummyVecEnv
from torch.optim import SGD

from wpt_agents.agents.base import PixelAgent
from wpt_agents.model.observations import to_images
from wpt_agents.training.keywords import Keywords, Stage, amount, count, share
from wpt_agents.training.randomness import Purpose


@dataclass(frozen=True, kw_only=True)
class MeanKeywords(Keywords):
    learning_starts: int = count(8, "steps before the first update", least=0)
    warmup_steps: int = count(7, "random steps", least=0)
    width: int = count(3, "something of the networks", Stage.SIZE)
    learning_rate: float = amount(0.1, "of the optimiser")
    tau: float = share(0.5, "a share")


class MeanPolicy(BasePolicy):
    """Acts by one number for each action."""

    def __init__(self, observation_space, action_space):
        super().__init__(observation_space, action_space, squash_output=True)
        self.reset_behavior()

    def reset_behavior(self):
        self.mean = torch.nn.Parameter(torch.zeros(self.action_space.shape[0]))
        self.register_buffer("action_mask", torch.ones_like(self.mean, dtype=bool), False)

    def set_action_space(self, action_space):
        self.action_space = action_space

    def initial_state(self, n):
        return ()

    def act(self, image, state, episode_start, deterministic=False, generator=None):
        mean = self.mean.detach().expand(len(image), -1)
        noise = 0 if deterministic else torch.randn(mean.shape, generator=generator) / 4
        return (mean + noise).clamp(-1, 1).numpy(), state

    def executed(self, state, action):
        return state

    def to_env(self, action):
        return action

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        images, batched = to_images(observation)
        action, state = self.act(images, state, episode_start, deterministic)
        return (action if batched else action[0]), state

    def _predict(self, observation, deterministic=False):
        raise NotImplementedError


class MeanLearner:
    def __init__(self, policy, rate):
        self.optimizer = SGD(policy.parameters(), rate, momentum=0.9)


class Mean(PixelAgent, keywords=MeanKeywords):
    """Moves to the mean of a random episode's actions.

    :param policy: "MeanPolicy"
    """

    policy_aliases = {"MeanPolicy": MeanPolicy}  # noqa: RUF012
    updates_per_step = 0.5
    shape_keywords = ("width",)

    def make_policy(self):
        return MeanPolicy(self.observation_space, self.action_space)

    def make_learner(self):
        return MeanLearner(self.policy, self.hyperparameters.learning_rate)

    def hyperparameters_changed(self):
        for group in self.learner.optimizer.param_groups:
            group["lr"] = self.hyperparameters.learning_rate

    def update(self, metrics):
        rng = self.streams.numpy(Purpose.UPDATE, self.updates)
        episodes = self.replay_buffer.trajectories
        action = torch.from_numpy(episodes[rng.integers(len(episodes))].action)
        loss = (self.policy.mean - action.mean(0)).square().sum()
        self.learner.optimizer.zero_grad()
        loss.backward()
        self.learner.optimizer.step()
        metrics["train/loss"].append(loss.detach())
        self.updates += 1


def mean(env=None, **changes):
    return Mean("MeanPolicy", env or ClockEnv(), **{"seed": 0, "device": "cpu"} | changes)


def test_an_agent_of_few_lines_collects_whole_episodes_and_learns():
    agent = mean(DummyVecEnv([ClockEnv] * 2)).learn(42)
    assert agent.num_timesteps == 42 and agent.episodes == 6
    assert all(on_time(trajectory) for trajectory in agent.replay_buffer.trajectories)
    assert agent.updates == (42 - 8) // 2  # one for every two steps after the first 8
    assert agent.policy.mean.abs().sum() > 0
    warm, later = agent.replay_buffer.trajectories[0], agent.replay_buffer.trajectories[-1]
    assert (np.abs(warm.action) > 0.5).mean() > 0.3 > (np.abs(later.action) > 0.5).mean()


@pytest.mark.parametrize("envs", [1, 2])
def test_learning_after_load_equals_learning_in_one_go(tmp_path, envs):
    def fresh():
        return DummyVecEnv([ClockEnv] * envs)

    whole = mean(fresh()).learn(56)
    part = mean(fresh()).learn(28)
    part.save(tmp_path / "mean")
    part.save_replay_buffer(tmp_path / "replay")
    loaded = Mean.load(tmp_path / "mean", env=fresh(), device="cpu")
    loaded.load_replay_buffer(tmp_path / "replay")
    loaded.learn(28, reset_num_timesteps=False)
    assert same(weights(loaded), weights(whole)) and loaded.updates == whole.updates
    for one, other in zip(
        loaded.replay_buffer.trajectories, whole.replay_buffer.trajectories, strict=True
    ):
        np.testing.assert_array_equal(one.action, other.action)


def test_keywords_are_the_signature_the_documentation_and_the_attributes():
    import inspect

    parameters = inspect.signature(Mean).parameters
    assert list(parameters)[:2] == ["policy", "env"] and parameters["tau"].default == 0.5
    assert {"seed", "embodiment", "dataset", "device", "verbose"} <= parameters.keys()
    assert ":param tau: a share" in Mean.__doc__ and ":param embodiment: name" in Mean.__doc__
    assert mean(tau=0.25).tau == 0.25
    with pytest.raises(TypeError, match=r"No keyword 'tua'. Did you mean 'tau'"):
        mean(tua=1)
    with pytest.raises(ValueError, match=r"tau must be a number in \[0, 1\], got 2"):
        mean(tau=2)


def test_a_keyword_that_is_written_is_checked_takes_effect_and_is_saved(tmp_path):
    agent = mean()
    with pytest.raises(ValueError, match=r"tau must be a number in \[0, 1\], got 2"):
        agent.tau = 2
    with pytest.raises(ValueError, match="No train_freq 'nonsense'"):
        agent.train_freq = "nonsense"
    with pytest.raises(ValueError, match=r"width=4 can no longer take effect: .* a new Mean"):
        agent.width = 4
    assert (agent.tau, agent.train_freq, agent.width) == (0.5, "episode", 3)
    agent.learning_rate = 0.5
    assert agent.learner.optimizer.param_groups[0]["lr"] == 0.5
    agent.save(tmp_path / "mean")
    assert Mean.load(tmp_path / "mean").learning_rate == 0.5


def test_a_seed_that_is_written_is_that_of_everything_drawn():
    one, other = mean(seed=3), mean()
    other.seed = 3
    assert same(weights(one.learn(28)), weights(other.learn(28)))


def test_counters_are_attributes_and_saved_whole(tmp_path):
    agent = mean().learn(28)
    agent.save(tmp_path / "mean")
    assert Mean.load(tmp_path / "mean").progress == agent.progress
    assert agent.progress.num_timesteps == agent.num_timesteps == 28


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda agent: pickle.loads(pickle.dumps(agent))])
def test_a_copy_learns_on_its_own(copied):
    agent = mean().learn(28)
    before = weights(agent)
    other = copied(agent)
    assert same(weights(other), before) and other.env is None
    other.set_env(ClockEnv())
    other.learn(28, reset_num_timesteps=False)
    assert same(weights(agent), before) and not same(weights(other), before)


def test_another_width_of_actions_begins_a_new_task():
    agent = mean().learn(28)
    agent.set_env(ClockEnv(actions=3))
    assert len(agent.replay_buffer) == 0 and agent.policy.mean.shape == (3,)
    assert agent.learn(14).replay_buffer.trajectories[0].action_dim == 3


def test_parameters_are_loaded_in_place_from_a_file(tmp_path):
    one, other = mean().learn(28), mean()
    one.save(tmp_path / "mean")
    other.set_parameters(tmp_path / "mean")
    assert same(weights(one), weights(other))
    with pytest.raises(ValueError, match="width=3, now it is 4"):
        mean(width=4).set_parameters(str(tmp_path / "mean"))


def test_agents_that_begin_with_the_same_parameters_share_no_averages():
    one, other = mean().learn(28), mean()
    averages = one.learner.optimizer.state[one.policy.mean]["momentum_buffer"]
    before = averages.clone()
    other.set_parameters(one.get_parameters())
    other.learn(28)
    assert torch.equal(averages, before)


def test_an_agent_without_an_environment_says_that_it_needs_one():
    with pytest.raises(ValueError, match="Mean needs an environment: pass env="):
        Mean("MeanPolicy")
