"""Episodes that end: the continue head, and returns, weights and dreams that end with it."""

from collections import defaultdict
from itertools import pairwise

import numpy as np
import pytest
import torch
from debug_agent import ClockEnv, agent, recorded, same, weights

from wpt_agents.agents.curious import Plan2Explore
from wpt_agents.agents.wpt import WPT
from wpt_agents.model.actor_critic import (
    actor_loss,
    actor_weight,
    critic_loss,
    lambda_return,
    survival,
)
from wpt_agents.model.distributions import two_hot_loss
from wpt_agents.model.rssm import Latent

HEAD = "world_model.continue_head"


def ending(**changes):
    """An agent whose every episode of 7 steps terminates, with three of them."""
    return agent(ClockEnv(terminates=True), **changes).learn(21)


# ----------------------------------------------------------------- the equations


def test_a_return_ends_where_the_episode_ends_by_hand():
    reward, value = torch.tensor([[1.0, 2.0]]), torch.tensor([[9.0, 3.0, 4.0]])
    # V_2 = 4;  V_1 = 2 + .5 * 1 * 4 = 4;  V_0 = 1 + .5 * .5 (.5 * 3 + .5 * 4) = 1.875
    goes_on = torch.tensor([[0.5, 1.0]])
    expected = torch.tensor([[1.875, 4.0]])
    torch.testing.assert_close(lambda_return(reward, value, 0.5, 0.5, goes_on), expected)
    # where step 0 is certainly the end, only its reward is left
    assert lambda_return(reward, value, 0.5, 0.5, torch.tensor([[0.0, 1.0]]))[0, 0] == 1
    certain = lambda_return(reward, value, 0.5, 0.5, torch.ones(1, 2))
    assert torch.equal(certain, lambda_return(reward, value, 0.5, 0.5))


def test_survival_by_hand():
    goes_on = torch.tensor([[0.5, 0.0, 1.0]], requires_grad=True)
    assert survival(goes_on).tolist() == [[1.0, 0.5, 0.0]]
    assert not survival(goes_on).requires_grad
    # an action counts if its own step and all before go on: .5, then .5 * .5 * 0
    assert actor_weight(0.5, goes_on, goes_on).tolist() == [[0.5, 0.0]]
    assert actor_weight(0.5, goes_on).tolist() == [1.0, 0.5]


def test_the_critic_does_not_learn_behind_an_end():
    logits = torch.randn(1, 3, 255, generator=torch.Generator().manual_seed(0)).requires_grad_()
    returns = torch.tensor([[1.0, 2.0, 3.0]])
    loss = critic_loss(logits, returns, 0.9, torch.tensor([[1.0, 0.0, 1.0]]))
    single = two_hot_loss(logits, returns)[0]  # step 1 is the end, and step 2 is never reached
    torch.testing.assert_close(loss, (single[0] + 0.9 * single[1]) / 3)
    loss.backward()
    assert logits.grad[0, :2].any(1).all() and not logits.grad[0, 2].any()


def test_the_actor_is_not_judged_behind_an_end():
    returns, entropy = torch.tensor([[9.0, 2.0, 3.0]]), torch.tensor([[1.0, 4.0, 9.0]])
    # weights 1 * .5 and .5 * .5 * .5: -(.5 (2 + .1 * 1) + .125 (3 + .1 * 4)) / 2
    loss = actor_loss(returns, entropy, 0.1, 0.5, goes_on=torch.tensor([[0.5, 0.5, 1.0]]))
    assert loss.item() == pytest.approx(-(0.5 * 2.1 + 0.125 * 3.4) / 2)


def test_on_a_chain_the_best_path_avoids_the_end():
    """States 0 .. 4 in a row; each step to the right pays 1, to the left 0.5, and 4 is the end.

    Without the end, walking right pays most. With it, right pays 1 + 1 + 1 at most, and pacing
    between 0 and 1 pays .75 a step for ever.
    """
    steps = 12

    def judged(path, known):
        arrived = [1.0 if b > a else 0.5 for a, b in pairwise(path)]
        reward = torch.tensor([[0.0, *arrived]])[:, :steps]
        goes_on = torch.tensor([[float(state < 4) for state in path]])[:, :steps]
        value = torch.zeros(1, steps + 1)
        return lambda_return(reward, value, 1.0, 1.0, goes_on if known else None)[0, 0].item()

    right = [1, 2, 3, *[4] * (steps - 2)]
    right_on = [1, *range(2, steps + 2)]  # what a model dreams that knows of no end
    pacing = [1 - t % 2 for t in range(steps + 1)]
    assert judged(right, known=True) == 3.0 < judged(pacing, known=True) == 8.0
    assert judged(right_on, known=False) == 11.0 > judged(pacing, known=False)


def test_the_actor_learns_to_stay_away_from_an_end_that_costs_no_reward():
    """All steps pay 1, so the gradient through c alone tells the actor which way to go."""
    step = torch.tensor(0.0, requires_grad=True)
    place = torch.stack([t * step for t in range(5)])[None]
    goes_on = torch.sigmoid(3 - 4 * place)  # the end lies at places above .75
    returns = lambda_return(torch.ones(1, 5), torch.ones(1, 6), 0.9, 0.95, goes_on)
    actor_loss(returns, torch.zeros(1, 5), 0.0, 0.9, goes_on=goes_on).backward()
    assert step.grad > 0  # descent makes the step negative, away from the end


# ----------------------------------------------------------------- the head


def test_only_an_agent_whose_episodes_terminated_has_the_head():
    limited = agent(ClockEnv()).learn(30)
    assert limited.policy.world_model.continue_head is None
    assert not [name for name in weights(limited) if name.startswith(HEAD)]
    assert ending().policy.world_model.continue_head is not None
    assert ending(continue_head=False).policy.world_model.continue_head is None


def test_the_head_changes_no_other_random_number():
    """Two episodes of the same steps, one terminated: the first updates differ only by the head."""
    losses = {}
    for terminated in (False, True):
        model, metrics = agent(zero_init_heads=False), defaultdict(list)
        reward = np.arange(8, dtype=np.float32)
        model.replay_buffer.add(recorded(reward=reward, terminated=terminated))
        model.update(metrics)
        losses[terminated] = metrics
    for name in ("train/reconstruction_loss", "train/reward_loss"):
        assert losses[False][name] == losses[True][name]
    assert losses[True]["train/continue_loss"][0] > 0
    assert losses[False].keys() == losses[True].keys() - {"train/continue_loss"}


def test_at_first_the_head_predicts_the_share_of_steps_that_go_on():
    model = agent()
    model.replay_buffer.add(recorded(length=8, reward=np.zeros(8), terminated=True))
    model.learn_ends()
    feat = torch.randn(3, model.policy.size.deter + 64)
    torch.testing.assert_close(model.policy.world_model.goes_on(feat), torch.full((3,), 8 / 9))


def test_the_head_learns_where_the_task_ends_and_not_where_others_do():
    model = agent(learning_rate=1e-2)
    model.replay_buffer.add(recorded(length=7, reward=np.zeros(7), terminated=True))
    model.learn_ends()
    batch = model.replay_buffer.sample(2, 8, 4, np.random.default_rng(0))
    batch.is_terminal[1] = ~batch.is_terminal[0]  # another task's row, which ends elsewhere
    batch.reward_known[1] = False
    generator = torch.Generator().manual_seed(0)
    latent = model.policy.world_model.rssm.initial(8)
    deter = torch.randn(latent.deter.shape, generator=generator)
    post = Latent(*(x.expand(2, *x.shape) for x in (deter, latent.stoch)))  # equal in both rows
    for _ in range(60):
        model.learner.update_continue_head(post, batch)
    goes_on = model.policy.world_model.goes_on(post.feat)[0]
    assert goes_on[-1] < 0.2 and goes_on[:-1].min() > 0.8


def test_a_model_that_was_saved_with_the_head_learns_on_exactly(tmp_path):
    model = ending()
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "replay")
    loaded = WPT.load(tmp_path / "model", env=ClockEnv(terminates=True))
    loaded.load_replay_buffer(tmp_path / "replay")
    assert same(weights(model), weights(loaded)) and any(k.startswith(HEAD) for k in weights(model))
    for one in (model, loaded):
        one.update(defaultdict(list))
    assert same(weights(model), weights(loaded))


def test_a_head_that_is_switched_off_is_neither_trained_nor_used(tmp_path):
    ending().save(tmp_path / "model")
    model = WPT.load(tmp_path / "model", continue_head=False)
    model.replay_buffer.add(recorded(length=7, reward=np.zeros(7), terminated=True))
    before, metrics = weights(model, HEAD), defaultdict(list)
    model.update(metrics)
    assert before and same(before, weights(model, HEAD)) and "train/continue_loss" not in metrics
    dream = model.policy.dream(model.policy.world_model.rssm.initial(2), 3, torch.Generator())
    assert model.learner.worth(dream, torch.zeros(2)).goes_on is None


def test_parameters_with_and_without_the_head_can_be_put_in(tmp_path):
    model, without = ending(), agent(ClockEnv()).learn(21)
    model.save(tmp_path / "model")
    parameters = model.get_parameters()
    for taken in (parameters, tmp_path / "model"):
        other = agent()
        other.set_parameters(taken)
        assert same(weights(model), weights(other))
    model.set_parameters(without.get_parameters())
    assert same(weights(model), weights(without))


def test_another_task_begins_without_the_head():
    model = ending()
    model.reset_task()
    assert model.policy.world_model.continue_head is None
    assert model.learner.continue_optimizer is None


def test_an_explorer_saves_the_head_too(tmp_path):
    settings = {"size": "debug", "max_action_dim": 2, "batch_size": 2, "batch_length": 4}
    settings |= {"learning_starts": 7, "warmup_steps": 7, "offline_ratio": 0.0, "guidance": 0.0}
    settings |= {"train_ratio": 4}
    env = ClockEnv(terminates=True)
    model = Plan2Explore("WPTPolicy", env, imagine_horizon=3, seed=0, device="cpu", **settings)
    list(model.explore(2))
    model.save(tmp_path / "explorer")
    assert same(weights(model), weights(Plan2Explore.load(tmp_path / "explorer")))
    assert model.policy.world_model.continue_head is not None
