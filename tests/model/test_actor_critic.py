from collections import defaultdict
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from chain import chain
from debug_agent import same, weights

from wpt_agents.agents.wpt import WPT
from wpt_agents.data.replay import mix
from wpt_agents.fast import pieces
from wpt_agents.model.actor_critic import (
    Actor,
    Critic,
    actor_loss,
    critic_loss,
    debiased_fraction,
    discounts,
    draw_starts,
    ema_update,
    lambda_return,
    return_range,
)
from wpt_agents.model.distributions import two_hot_loss, two_hot_mean
from wpt_agents.model.layers import frozen
from wpt_agents.model.observations import IMAGE_SPACE
from wpt_agents.model.policy import WPTPolicy
from wpt_agents.model.rssm import Latent, over_steps
from wpt_agents.model.sizes import SIZES
from wpt_agents.training.model_files import optimizers
from wpt_agents.training.randomness import Purpose

DEBUG, WIDTH, H = SIZES["debug"], 5, 4
OWN = torch.tensor([True, True, False, False, False])


def noise(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def agent(**changes):
    settings = {"size": "debug", "max_action_dim": WIDTH, "batch_size": 2, "batch_length": 4}
    settings |= {"imagine_horizon": H, "seed": 0, "device": "cpu"}
    return WPT(**settings | changes)


def filled(**changes):
    """An agent with something to learn from."""
    model = agent(**changes)
    model.replay_buffer.add(chain(20, size=64))
    return model


@pytest.fixture
def policy():
    torch.manual_seed(0)
    space = WPT(size="debug", max_action_dim=2, device="cpu").action_space
    return WPTPolicy(IMAGE_SPACE, space, DEBUG, WIDTH)


@pytest.fixture
def start():
    stoch = torch.eye(8)[noise(6, 8, 8).argmax(-1)]
    return Latent(noise(6, DEBUG.deter).tanh(), stoch)


def judged(policy, start, ent_coef=0.0):
    """The actor's loss on a dream."""
    dream = policy.dream(start, H, torch.Generator().manual_seed(0))
    feat = dream.states.feat
    with frozen(policy.world_model):
        reward = policy.world_model.reward(feat[:, :-1])
    returns = lambda_return(reward, policy.target_critic.value(feat))
    return actor_loss(returns, dream.entropy, ent_coef)


def gradients(module):
    return [p.grad for p in module.parameters() if p.grad is not None and p.grad.any()]


# -------------------------------------------------------------------------- the equations' limits


def test_without_lambda_the_return_looks_one_step_ahead():
    reward, value = noise(2, H), noise(2, H + 1, seed=1)
    expected = reward + 0.9 * value[:, 1:]
    torch.testing.assert_close(lambda_return(reward, value, 0.9, 0.0), expected)


def test_with_lambda_one_the_return_is_the_discounted_sum():
    reward, value = noise(2, H), noise(2, H + 1, seed=1)
    for t in range(H):
        expected = 0.9 ** (H - t) * value[:, H]
        expected = expected + sum(0.9 ** (k - t) * reward[:, k] for k in range(t, H))
        torch.testing.assert_close(lambda_return(reward, value, 0.9, 1.0)[:, t], expected)


def test_the_value_of_the_starting_state_is_not_in_the_return():
    reward, value = noise(1, H), noise(1, H + 1, seed=1).requires_grad_()
    lambda_return(reward, value).sum().backward()
    assert value.grad[0, 0] == 0 and value.grad[0, 1:].all()


def test_discounts_by_hand():
    assert discounts(4, 0.5, noise(1)).tolist() == [1, 0.5, 0.25, 0.125]
    assert discounts(3, 0.0, noise(1)).tolist() == [1, 0, 0]


def test_the_critics_target_gets_no_gradient():
    logits, target = noise(2, 3, 255).requires_grad_(), noise(2, 3).requires_grad_()
    critic_loss(logits, target).backward()
    assert logits.grad.any() and target.grad is None


def test_the_actor_is_not_judged_by_what_its_actions_did_not_cause():
    returns, entropy = noise(2, H).requires_grad_(), noise(2, H).requires_grad_()
    actor_loss(returns, entropy, ent_coef=0.1).backward()
    # the reward of the start, and the entropy of the action whose outcome lies past the horizon
    assert not returns.grad[:, 0].any() and returns.grad[:, 1:].all()
    assert not entropy.grad[:, -1].any() and entropy.grad[:, :-1].all()


def starts(*arguments, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return draw_starts(*arguments, generator, torch.device("cpu"))


def test_without_a_number_dreams_start_from_every_state():
    assert starts(3, 5, 0).tolist() == list(range(15))


def test_dreams_start_from_states_with_three_images_and_from_every_row_alike():
    drawn = starts(4, 6, 10)  # 10 of 4 x 4
    assert len(set(drawn.tolist())) == 10
    assert (drawn % 6 >= 2).all()
    # 10 states in 4 rows: 10 k // 4 is 0, 2, 5, 7, 10 for k = 0 .. 4
    assert torch.bincount(drawn // 6).tolist() == [2, 3, 2, 3]


def test_more_starts_than_there_are_become_all_that_have_seen_three_images():
    assert starts(2, 4, 100).tolist() == [2, 3, 6, 7]
    assert starts(2, 2, 100).tolist() == [0, 1, 2, 3]  # no state has: all of them


def test_each_state_is_drawn_equally_often_and_by_the_generator_alone():
    assert starts(2, 6, 4).tolist() == starts(2, 6, 4).tolist()
    counts = sum(torch.bincount(starts(2, 6, 4, seed=s), minlength=12) for s in range(400))
    expected = 400 * 4 / 8  # of 8 states with three images; sd of a count is 10
    assert ((counts.view(2, 6)[:, 2:] - expected).abs() < 50).all()


def test_the_return_scale_divides_returns_and_not_the_entropy():
    # -(6 / 3 + .5 * 4) = -4
    returns, entropy = torch.tensor([[0.0, 6.0]]), torch.tensor([[4.0, 0.0]])
    assert actor_loss(returns, entropy, 0.5, return_scale=3.0).item() == pytest.approx(-4)


def test_return_range_by_hand():
    # 0 .. 100: the 5 % quantile is 5, the 95 % one 95
    assert return_range(torch.arange(101.0).view(1, -1)).item() == pytest.approx(90)


# ------------------------------------------------------------------------- the gradients' ways


def test_the_actor_loss_reaches_only_the_actor(policy, start):
    judged(policy, start, ent_coef=1e-4).backward()
    others = policy.world_model, policy.critic, policy.target_critic, policy.prior_actor
    assert len(gradients(policy.actor)) == len(list(policy.actor.parameters()))
    assert not any(gradients(module) for module in others)
    assert all(p.requires_grad for p in policy.world_model.parameters())


def test_the_actor_learns_through_the_dynamics_alone(policy, start):
    with torch.no_grad():  # a world in which actions do nothing
        policy.world_model.rssm.gru.from_action[0].weight.zero_()
    judged(policy, start).backward()
    assert not gradients(policy.actor)


def test_the_starting_states_get_no_gradient(policy, start):
    start = Latent(*(x.requires_grad_() for x in start))
    judged(policy, start, ent_coef=1e-4).backward()
    assert start.deter.grad is None and start.stoch.grad is None


def test_a_dreams_entropy_is_the_actors_at_each_state(policy, start):
    dream = policy.dream(start, H)
    dist = policy.actor.dist(dream.states.feat[:, :-1], policy.action_mask)
    torch.testing.assert_close(dream.entropy, dist.entropy())
    assert torch.equal(dream.states.feat[:, 0], start.feat)


# --------------------------------------------------------------------------------- the actor


def test_standard_deviations_go_from_a_tenth_to_one():
    actor = Actor(DEBUG, WIDTH)
    with torch.no_grad():
        actor.layers[-1].weight.zero_()
        for bias, std in ((-100.0, 0.1), (-2.0, 0.55), (100.0, 1.0)):  # 0.9 sigmoid(0) + 0.1
            actor.layers[-1].bias.fill_(bias)
            assert torch.allclose(actor.dist(noise(1, 128), OWN).std, torch.tensor(std))


def test_nothing_in_the_padding_of_the_actor_changes_its_actions(policy, start):
    results = []
    for garbage in (0.0, 3.0):
        with torch.no_grad():
            policy.actor.layers[-1].bias[[2, 3, 4, 7, 8, 9]] += garbage
        dream = policy.dream(start, H, torch.Generator().manual_seed(0))
        results.append((dream.action, dream.entropy, dream.states.feat, dream.saturated))
        assert not dream.action[..., 2:].any() and dream.action[..., :2].all()
    torch.testing.assert_close(*results, rtol=0, atol=0)


def test_the_share_of_saturated_means_is_of_the_robots_own_actions(policy, start):
    with torch.no_grad():
        last = policy.actor.layers[-1]
        last.weight.zero_()
        last.bias[:WIDTH] = torch.tensor([100.0, 0, 100, 100, 100])  # two entries are its own
    assert policy.dream(start, H, torch.Generator().manual_seed(0)).saturated == 0.5


def test_the_padding_of_the_actor_is_not_trained(policy, start):
    judged(policy, start, ent_coef=0.1).backward()
    bias = policy.actor.layers[-1].bias.grad
    assert bias[[0, 1, 5, 6]].all() and not bias[[2, 3, 4, 7, 8, 9]].any()


def test_an_acting_states_padding_stays_zero(policy):
    image = np.zeros((3, 64, 64, 3), np.uint8)
    action, state = policy.act(image, None, None)
    assert action[:, :2].all() and not action[:, 2:].any()
    np.testing.assert_array_equal(state[2], action)


def test_outscale_scales_the_last_layer():
    torch.manual_seed(0)
    plain = Actor(DEBUG, WIDTH)
    torch.manual_seed(0)
    small = Actor(DEBUG, WIDTH, outscale=0.01)
    feat = noise(4, 128)
    torch.testing.assert_close(small(feat), 0.01 * plain(feat))


# ------------------------------------------------------------------------------- the critic


def test_ema_by_hand():
    target, source = torch.nn.Linear(1, 1), torch.nn.Linear(1, 1)
    for module, value in ((target, 1.0), (source, 3.0)):
        torch.nn.init.constant_(module.weight, value)
        torch.nn.init.constant_(module.bias, -value)
    ema_update(target, source, 0.02)
    # 0.98 * 1 + 0.02 * 3 = 1.04
    assert target.weight.item() == pytest.approx(1.04)
    assert target.bias.item() == pytest.approx(-1.04)
    assert source.weight.item() == 3.0


def test_a_debiased_average_weighs_the_last_values_by_powers_of_1_minus_f():
    values = [3.0, -1.0, 4.0, 10.0]
    average = 100.0  # where it began does not matter
    for n, value in enumerate(values, 1):
        average += debiased_fraction(0.25, n) * (value - average)
    # weights 0.75^3, 0.75^2, 0.75, 1: (27 * 3 - 36 + 48 * 4 + 64 * 10) / (27 + 36 + 48 + 64)
    assert average == pytest.approx(877 / 175)
    assert debiased_fraction(1.0, 3) == 1


def test_the_target_critic_starts_as_the_critic_and_moves_by_ema_alone():
    model = filled(target_fraction=0.3)
    critic, target = model.policy.critic, model.policy.target_critic
    assert not any(p.requires_grad for p in target.parameters())
    for pair in zip(target.parameters(), critic.parameters(), strict=True):
        assert torch.equal(*pair)
    expected = [p.clone() for p in critic.parameters()]
    for _ in range(3):
        model.update(defaultdict(list))
        expected = [0.7 * e + 0.3 * p for e, p in zip(expected, critic.parameters(), strict=True)]
    torch.testing.assert_close(list(target.parameters()), expected)
    assert not all(torch.equal(*p) for p in zip(expected, critic.parameters(), strict=True))


def test_a_critic_started_at_zero_values_everything_at_zero():
    value = Critic(DEBUG, zero_init=True).value(noise(5, 128))
    torch.testing.assert_close(value, torch.zeros(5), atol=1e-5, rtol=0)


# --------------------------------------------------------------------------- the whole update


@pytest.mark.parametrize("precision", ["fp32", "bf16"])
def test_an_update_trains_every_network_but_the_clone(precision):
    model = filled(precision=precision)
    parts = {name: getattr(model.policy, name) for name in ("world_model", "actor", "critic")}
    before = {n: [p.clone() for p in part.parameters()] for n, part in parts.items()}
    clone = [p.clone() for p in model.policy.prior_actor.parameters()]
    for _ in range(2):  # a head started at zero lets nothing through at first
        model.update(defaultdict(list))
    for name, part in parts.items():
        assert not any(map(torch.equal, before[name], part.parameters())), name
    assert all(map(torch.equal, clone, model.policy.prior_actor.parameters()))


def test_reinforce_casts_weights_anew_after_its_dreams_without_gradient(monkeypatch):
    """In one context, torch before 2.11 would reuse casts that have no gradient."""
    model = filled(actor_grad="reinforce", precision="bf16")
    learner = model.learner
    called = []

    def noted(name, plain, *args):
        called.append(name)
        return plain(*args)

    for name in ("autocast", "worth", "actor_loss"):
        plain = getattr(learner, name)
        monkeypatch.setattr(learner, name, partial(noted, name, plain))
    model.update(defaultdict(list))
    dreams = called.index("worth")
    assert called[dreams : dreams + 3] == ["worth", "autocast", "actor_loss"]


def test_rewards_teach_the_reward_head_and_leave_the_world_model_alone():
    weights = []
    for reward in (0.0, 5.0):
        model = agent(grad_clip=1e9, zero_init_heads=False)
        model.replay_buffer.add(replace(chain(20, size=64), reward=np.full(20, reward)))
        model.update(defaultdict(list))
        weights.append(model.policy.world_model)
    one, other = (model.dynamics_parameters() for model in weights)
    assert all(map(torch.equal, one, other))
    heads = (list(model.reward_head.parameters()) for model in weights)
    assert not all(map(torch.equal, *heads))


@pytest.mark.parametrize("rate", [1e-2, 1e-5])
def test_weight_decay_takes_the_same_share_whatever_the_learning_rate(rate):
    model = agent(learning_rate=rate, actor_critic_learning_rate=rate / 2, weight_decay=0.25)
    for name in ("model_optimizer", "actor_optimizer", "critic_optimizer"):
        optimizer = getattr(model.learner, name)
        weights = optimizer.param_groups[0]["params"]
        before = [p.detach().clone() for p in weights]
        for parameter in weights:
            parameter.grad = torch.zeros_like(parameter)
        optimizer.step()
        torch.testing.assert_close([p.detach() for p in weights], [0.75 * p for p in before])


def test_the_default_decay_is_a_millionth():
    model = agent()
    for optimizer in optimizers(model.learner).values():
        group = optimizer.param_groups[-1]
        assert group["lr"] * group["weight_decay"] == pytest.approx(1e-6)
        assert group["eps"] == 1e-5


def test_reward_head_and_critic_have_the_bins_of_their_keyword(tmp_path):
    models = {width: filled(bin_range=width, zero_init_heads=False) for width in (20.0, 7.0)}
    feat = noise(3, DEBUG.deter + 64)
    for width, model in models.items():
        policy = model.policy
        for logits, number in (
            (policy.world_model.reward_head(feat), policy.world_model.reward(feat)),
            (policy.critic(feat), policy.critic.value(feat)),
            (policy.target_critic(feat), policy.target_critic.value(feat)),
        ):
            torch.testing.assert_close(number, two_hot_mean(logits, width))
    assert same(*(weights(model) for model in models.values()))  # equal, and equally drawn
    metrics = {width: defaultdict(list) for width in models}
    for width, model in models.items():
        model.update(metrics[width])
    for name in ("train/reward_loss", "train/critic_loss"):
        assert metrics[20.0][name] != metrics[7.0][name]
    models[7.0].save(tmp_path / "model")
    assert WPT.load(tmp_path / "model").policy.critic.bin_range == 7.0
    with pytest.raises(ValueError, match=r"trained with bin_range=7\.0, now it is 20"):
        WPT.load(tmp_path / "model", bin_range=20.0)
    with pytest.raises(ValueError, match=r"trained with bin_range=7\.0, now it is 20"):
        agent().set_parameters(tmp_path / "model")
    with pytest.raises(ValueError, match="bin_range must be a number above 0"):
        agent(bin_range=0)


@pytest.mark.parametrize("actor_grad", ["dynamics", "reinforce"])
def test_the_entropys_weight_goes_by_its_schedule(actor_grad):
    losses = {}
    for ent_coef in ("linear(0.8,0.2,100)", 0.5):
        model = filled(ent_coef=ent_coef, actor_grad=actor_grad)
        model.num_timesteps = 50  # half way: .5
        metrics = defaultdict(list)
        model.update(metrics)
        losses[ent_coef] = metrics["train/actor_loss"][0]
        assert model.hyperparameters.ent_coef_at(1000) == (
            0.5 if ent_coef == 0.5 else pytest.approx(0.2)
        )
    assert losses["linear(0.8,0.2,100)"] == losses[0.5]
    with pytest.raises(ValueError, match=r"ent_coef='linear\(1\)' is not understood"):
        agent(ent_coef="linear(1)")


def test_the_return_scale_is_a_running_range_not_below_one(monkeypatch):
    model, metrics = filled(return_norm=True), defaultdict(list)
    # the first range, 3, counts in full; to 90: 3 + .01 * 87 = 3.87;
    # to a range of 0, of 3.87: 3.87 * .99 ** 200 = 0.52, which counts as 1
    for width, times, scale in ((3.0, 1, 3.0), (90.0, 1, 3.87), (0.0, 200, 1.0)):
        monkeypatch.setattr(
            "wpt_agents.training.learner.return_range", lambda _, w=width: torch.tensor(w)
        )
        model.policy.return_scale.mul_(0.99 ** (times - 1))
        model.update(metrics)
        assert metrics["train/return_scale"][-1].item() == pytest.approx(scale)
    assert model.policy.return_scale.item() == pytest.approx(3.87 * 0.99**200)


def test_a_return_scale_that_is_switched_on_later_starts_from_the_first_returns(monkeypatch):
    model, metrics = filled(return_norm=False), defaultdict(list)
    monkeypatch.setattr("wpt_agents.training.learner.return_range", lambda _: torch.tensor(3.0))
    model.update(metrics)
    model.return_norm = True
    model.update(metrics)
    assert [scale.item() for scale in metrics["train/return_scale"]] == [1.0, 3.0]


# ----------------------------------------------------------------- what DreamerV3 does otherwise


@pytest.mark.parametrize("ends", [False, True])
def test_reinforce_teaches_the_actor_alone_and_by_its_own_formula(ends):
    model = filled(actor_grad="reinforce", ent_coef=0.1, gamma=0.9)
    learner, policy = model.learner, model.policy
    start = policy.world_model.rssm.initial(6)
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        dream = policy.dream(start, model.imagine_horizon, generator)
        worth = learner.worth(dream, torch.zeros(6))
    reward, value, returns, _ = worth
    goes_on = torch.rand(returns.shape, generator=generator) if ends else None
    loss = learner.actor_loss(dream, worth._replace(goes_on=goes_on), torch.tensor(2.0))
    going = torch.ones_like(returns) if goes_on is None else goes_on
    expected = 0.0
    for n in range(6):
        for t in range(dream.action.shape[1] - 1):
            feat = torch.cat([dream.states.deter[n, t], dream.states.stoch[n, t].flatten()])
            dist = policy.actor.dist(feat, policy.action_mask)
            better = reward[n, t] + 0.9 * going[n, t] * returns[n, t + 1] - value[n, t]
            gain = dist.log_prob(dream.action[n, t]) * better / 2 + 0.1 * dist.entropy()
            reached = going[n, :t].prod()  # the probability that step t is reached
            expected -= 0.9**t * reached * gain / (6 * (dream.action.shape[1] - 1))
    torch.testing.assert_close(loss, expected)
    loss.backward()
    assert all(p.grad is None for p in policy.world_model.parameters())
    assert any(p.grad.abs().sum() > 0 for p in policy.actor.parameters())


@pytest.mark.parametrize("scale", [0.0, 0.7])
def test_the_slow_critic_regulariser_pulls_the_critic_to_the_target_critic(scale, monkeypatch):
    model = filled(slow_critic_scale=scale, gamma=0.9)
    learner, policy = model.learner, model.policy
    for weight in policy.target_critic.parameters():  # or it would be the critic
        weight.data.add_(0.05 * torch.randn_like(weight))
    start, losses, descend = policy.world_model.rssm.initial(6), {}, learner.descend

    def recorded(optimizer, loss, name):
        losses[name] = loss.detach()
        return descend(optimizer, loss, name)

    monkeypatch.setattr(learner, "descend", recorded)
    with torch.no_grad():
        dream = policy.dream(start, model.imagine_horizon, torch.Generator().manual_seed(0))
        worth = learner.worth(dream, torch.zeros(6))
        logits = policy.critic(dream.states.but_last().feat)
        weight = 0.9 ** torch.arange(logits.shape[1])
        expected = (weight * two_hot_loss(logits, worth.returns)).mean()
        pull = (weight * two_hot_loss(logits, worth.value[:, :-1])).mean()
    learner.update_critic(dream, worth)
    torch.testing.assert_close(losses["critic"], expected + scale * pull)


@pytest.mark.parametrize("scale", [0.0, 0.3])
def test_the_replay_value_loss_teaches_the_critic_alone(scale):
    updated = []
    for repval_scale in (0.0, scale):
        model, metrics = filled(repval_scale=repval_scale), defaultdict(list)
        model.update(metrics)
        updated.append((metrics, model.policy))
    (_, without), (metrics, policy) = updated
    assert ("train/replay_value_loss" in metrics) is (scale > 0)
    same = all(map(torch.equal, without.critic.parameters(), policy.critic.parameters()))
    assert same is (scale == 0)
    for part in ("world_model", "actor"):
        weights = (getattr(item, part).parameters() for item in (without, policy))
        assert all(map(torch.equal, *weights))


def test_the_replay_value_loss_takes_sequences_of_one_image():
    model, metrics = filled(repval_scale=0.3, batch_length=1), defaultdict(list)
    model.update(metrics)
    assert metrics["train/replay_value_loss"][0].isfinite()


def test_the_replay_value_loss_is_that_of_the_replayed_rewards():
    model = filled(repval_scale=0.3, gamma=0.5, lam=1.0)
    batch = mix(model.replay_buffer, None, 0, 2, 4, model.max_action_dim, np.random.default_rng(0))
    post, *_ = model.learner.update_world_model(batch, torch.Generator().manual_seed(0))
    loss = model.learner.replay_value_loss(post, batch)
    policy = model.policy
    with torch.no_grad():
        value = policy.target_critic.value(post.feat)
    # with λ = 1 the return is the discounted sum of rewards and the value of the last state
    returns = value.clone()
    for t in (2, 1, 0):
        later = batch.reward[:, t] + 0.5 * returns[:, t + 1]
        returns[:, t] = torch.where(batch.is_first[:, t + 1], value[:, t], later)
    losses = two_hot_loss(policy.critic(post.feat), returns)
    expected = (losses * batch.reward_known).sum() / batch.reward_known.sum()
    torch.testing.assert_close(loss, expected)


# ------------------------------------------------------------------------------- head start


def test_in_the_head_start_the_actor_imitates_and_reads_no_dream(monkeypatch):
    model = filled(actor_delay=1, kickstart=0.0)
    model.cloned = True
    before = [p.detach().clone() for p in model.policy.actor.parameters()]
    critic = [p.detach().clone() for p in model.policy.critic.parameters()]
    advice = torch.full((model.max_action_dim,), 0.5)
    act = "wpt_agents.model.behavior_cloning.PriorActor.act"
    monkeypatch.setattr(act, lambda self, image, mask: advice.expand(len(image), -1) * mask)
    metrics = defaultdict(list)
    model.update(metrics)
    assert metrics["train/kickstart_loss"][0] > 0
    assert not all(map(torch.equal, before, model.policy.actor.parameters()))
    assert not all(map(torch.equal, critic, model.policy.critic.parameters()))
    model.update(metrics)  # the head start is over: no imitation any more
    assert len(metrics["train/kickstart_loss"]) == 1


def test_without_a_prior_actor_the_actor_rests_during_the_head_start():
    model = filled(actor_delay=2)
    actor = [p.detach().clone() for p in model.policy.actor.parameters()]
    critic = [p.detach().clone() for p in model.policy.critic.parameters()]
    for moved in (False, False, True):
        model.update(defaultdict(list))
        same = all(map(torch.equal, actor, model.policy.actor.parameters()))
        assert same is not moved
    assert not all(map(torch.equal, critic, model.policy.critic.parameters()))


# ------------------------------------------------------------------------------- randomness


def test_the_same_seed_purpose_and_counter_give_the_same_numbers_and_no_other():
    model, twin, other = agent(), agent(), agent(seed=1)

    def draw(model, purpose, counter):
        return model.streams.numpy(purpose, counter).integers(2**62)

    assert draw(model, 1, 7) == draw(model, 1, 7) == draw(twin, 1, 7)
    drawn = [draw(model, p, c) for p in Purpose for c in range(50)] + [draw(other, 1, 7)]
    assert len(set(drawn)) == len(drawn)


def test_the_same_seed_learns_the_same_numbers():
    losses = []
    for _ in range(2):
        model, metrics = filled(), defaultdict(list)
        for _ in range(2):
            model.update(metrics)
        losses.append({name: torch.stack(values).tolist() for name, values in metrics.items()})
    assert losses[0] == losses[1]


def test_a_head_sees_the_steps_of_a_dream_alike_at_once_and_one_by_one(monkeypatch):
    states = Latent(noise(4, 3, 5).requires_grad_(), noise(4, 3, 2, 2, seed=1).requires_grad_())
    torch.manual_seed(0)
    net, seen = torch.nn.Linear(9, 2), []

    def head(feat):
        seen.append(feat.shape)
        return net(feat)

    def outcome():
        out = over_steps(head, states)
        return out, torch.autograd.grad(out, [*states, net.weight], noise(4, 3, 2, seed=2))

    at_once = outcome()
    monkeypatch.setattr(pieces, "PIECE", 4 * 3 * 9 - 1)  # one less than there are
    torch.testing.assert_close(outcome(), at_once)
    assert seen == [(4, 3, 9), *3 * [(4, 9)]]
