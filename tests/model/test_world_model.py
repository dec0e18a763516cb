import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch

from wpt_agents.data.replay import ReplayBuffer
from wpt_agents.data.trajectory import MarkedBatch, Trajectory, led_to, stack_windows
from wpt_agents.model.actor_critic import Actor, Critic
from wpt_agents.model.behavior_cloning import PriorActor
from wpt_agents.model.distributions import symexp
from wpt_agents.model.images import to_unit
from wpt_agents.model.ops import definitions
from wpt_agents.model.rssm import Latent
from wpt_agents.model.sizes import SIZES
from wpt_agents.model.world_model import (
    WorldModel,
    pixel_weights,
    reward_loss,
    squared_error,
    world_model_loss,
    world_model_update_loss,
)

DEBUG, WIDTH = SIZES["debug"], 6
SURE, EVEN = [math.log(0.9), math.log(0.1)], [math.log(0.5)] * 2
# KL(SURE || EVEN) = .9 ln 1.8 + .1 ln .2
KL = 0.9 * math.log(1.8) + 0.1 * math.log(0.2)


def count(*modules):
    return sum(p.numel() for module in modules for p in module.parameters())


def seeded(seed=0):
    return torch.Generator().manual_seed(seed)


def loss_of(post, prior, **options):
    """Eq. (1) with a perfect reconstruction: only the KL terms are left."""
    return world_model_loss(torch.zeros(post.shape[:2]), post, prior, **options)


def logits(*steps, groups=1):
    """(1, T, S, 2) log-probabilities that take a gradient."""
    return torch.tensor([[[step] * groups for step in steps]]).requires_grad_()


# ------------------------------------------------------------------------------ Eq. (1)


def test_the_dynamics_term_teaches_only_the_prior():
    post, prior = logits(SURE), logits(EVEN)
    loss_of(post, prior, rep_scale=0, free_nats=0).total.backward()
    assert not post.grad.any()
    # d/dp_k sum_k q_k (ln q_k - ln p_k) by ln p_k is -q_k
    torch.testing.assert_close(prior.grad.flatten(), -torch.tensor([0.9, 0.1]))


def test_the_representation_term_teaches_only_the_posterior():
    post, prior = logits(SURE), logits(EVEN)
    loss_of(post, prior, dyn_scale=0, free_nats=0).total.backward()
    assert not prior.grad.any()
    # by ln q_k: q_k (ln q_k - ln p_k + 1), a tenth of it
    expected = [0.09 * (math.log(1.8) + 1), 0.01 * (math.log(0.2) + 1)]
    torch.testing.assert_close(post.grad.flatten(), torch.tensor(expected))


def test_free_nats_of_the_mean_count_the_batch_as_one():
    # KLs of the two steps: KL and 0, their mean KL / 2 = 0.184
    post, prior = logits(SURE, EVEN), logits(EVEN, EVEN)
    assert loss_of(post, prior, free_nats=0.1).total.item() == pytest.approx(1.1 * KL / 2)
    below = loss_of(post, prior, free_nats=0.3)
    assert below.total.item() == pytest.approx(1.1 * 0.3)
    assert below.kl.item() == pytest.approx(KL / 2)
    below.total.backward()
    assert not post.grad.any() and not prior.grad.any()


def test_free_nats_of_the_element_count_each_step():
    post, prior = logits(SURE, EVEN), logits(EVEN, EVEN)
    loss = loss_of(post, prior, free_nats=0.3, free_nats_mode="element")
    assert loss.total.item() == pytest.approx(1.1 * (KL + 0.3) / 2)
    assert loss.kl.item() == pytest.approx(KL / 2)
    loss.total.backward()
    assert prior.grad[0, 0].any() and not prior.grad[0, 1].any()


def test_the_kl_is_summed_over_the_groups_before_free_nats():
    # three groups of KL = .368 make 1.104, above one nat
    loss = loss_of(logits(SURE, groups=3), logits(EVEN, groups=3), free_nats_mode="element")
    assert loss.total.item() == pytest.approx(1.1 * 3 * KL)


def test_the_reconstruction_error_in_pieces_is_that_of_all_images(monkeypatch):
    model, batch = WorldModel(DEBUG, WIDTH), windows(turn(6))
    post, _, _ = model.observe(batch, seeded())
    expected = squared_error(to_unit(batch.image), model.decode(post))
    assert expected.shape == batch.image.shape[:2]
    monkeypatch.setattr("wpt_agents.fast.pieces.PIECE", 2 * model.decoder.row_size)  # 2 + 2 + 2 + 1
    torch.testing.assert_close(model.reconstruction_error(post, batch.image), expected)


def test_a_pixel_that_weighs_more_has_a_smaller_variance_by_hand():
    image, reconstruction = torch.zeros(1, 2, 1, 3), torch.zeros(1, 2, 1, 3).requires_grad_()
    with torch.no_grad():
        reconstruction += torch.tensor([0.1, 0.2]).view(1, 2, 1, 1)
    weight = pixel_weights(torch.tensor([[[False], [True]]]), 5.0)
    # three colours each: 3 * .01 + 5 * 3 * .04
    error = squared_error(image, reconstruction, weight[..., None])
    assert error.item() == pytest.approx(0.63)
    error.backward()
    # d/dx w (x - 0)^2 = 2 w x: .2 and 2 * 5 * .2
    slopes = reconstruction.grad[0, :, 0, 0]
    torch.testing.assert_close(slopes, torch.tensor([0.2, 2.0]))
    plain = squared_error(image, reconstruction)
    assert torch.equal(squared_error(image, reconstruction, torch.ones(1)), plain)


@pytest.mark.parametrize("piece", [None, 2])
def test_marked_pixels_weigh_more_in_the_fast_twin_as_in_the_definition(monkeypatch, piece):
    model, batch = WorldModel(DEBUG, WIDTH), windows(turn(6))
    if piece:
        monkeypatch.setattr("wpt_agents.fast.pieces.PIECE", piece * model.decoder.row_size)
    moving = torch.rand(batch.image.shape[:-1], generator=seeded()) < 0.3
    marked = MarkedBatch(**vars(batch), moving=moving)
    post, _, _ = model.observe(batch, seeded())
    weight = 1 + 7 * moving[..., None]
    expected = (weight * (to_unit(batch.image) - model.decode(post)).square()).sum((-3, -2, -1))
    with definitions():
        defined = model.batch_error(post, marked, 8.0)
    torch.testing.assert_close(defined, expected)
    fast = model.batch_error(post, marked, 8.0)
    torch.testing.assert_close(fast, expected)
    # gradients, of all weights of the decoder
    slopes = [
        torch.autograd.grad(e.sum(), list(model.decoder.parameters()), retain_graph=True)
        for e in (fast, expected)
    ]
    for ours, theirs in zip(*slopes, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-3, atol=1e-3 * theirs.abs().max().item())
    # a batch without marks is the paper's, whatever the weight
    assert torch.equal(model.batch_error(post, batch, 8.0), model.batch_error(post, batch))


def test_only_the_reconstruction_reaches_the_decoder():
    model, batch = WorldModel(DEBUG, WIDTH), windows(turn(6))
    loss, _ = world_model_update_loss(model, batch, seeded())
    (loss.total - loss.reconstruction).backward()
    assert all(p.grad is None or not p.grad.any() for p in model.decoder.parameters())
    assert model.encoder.layers[0].weight.grad is not None


def test_eq_1_trains_all_of_the_world_model_and_not_the_reward_head():
    model, batch = WorldModel(DEBUG, WIDTH), windows(turn(6))
    world_model_update_loss(model, batch, seeded(), free_nats=0.0)[0].total.backward()
    assert all(p.grad.any() for p in model.dynamics_parameters())
    assert all(p.grad is None for p in model.reward_head.parameters())


# ------------------------------------------------------------------------- the reward head


def test_rewards_that_are_unknown_count_nothing():
    logits = torch.randn(2, 3, 255, generator=seeded(), requires_grad=True)
    known = torch.tensor([[True, False, True], [False, False, False]])
    reward = torch.tensor([[1.0, math.nan, 2.0], [9e9, 3.0, 4.0]]).nan_to_num(7.0)
    loss = reward_loss(logits, reward, known)
    alone = reward_loss(logits[:1, ::2], reward[:1, ::2], known[:1, ::2])
    assert loss.item() == pytest.approx(alone.item())
    loss.backward()
    assert logits.grad[known].any() and not logits.grad[~known].any()


def test_no_known_reward_is_no_loss():
    assert reward_loss(torch.zeros(1, 2, 255), torch.ones(1, 2), torch.zeros(1, 2) > 0) == 0


def test_the_reward_is_the_mean_of_its_two_hot():
    # All mass on bin 160 of 255: symexp(-20 + 160 * 40 / 254) = symexp(5.197)
    model = WorldModel(DEBUG, WIDTH, zero_init_heads=True)
    with torch.no_grad():
        model.reward_head.layers[-1].bias[160] = 100.0
    expected = symexp(torch.tensor(-20 + 160 * 40 / 254))
    torch.testing.assert_close(model.reward(torch.randn(2, 128)), expected.expand(2))


# ----------------------------------------------------------------------- parameter counts


def paper_layout(a):
    """The paper's world model with action width `a`, counted by hand: parameters of each part."""

    def linear(i, o):
        return i * o + o

    def norm_linear(i, o):  # a weight and a bias of the norm besides
        return linear(i, o) + 2 * o

    def block(i, o):
        return i * o // 8 + o

    deter, hidden, code = 12288, 1536, 32 * 96
    channels = (3, 96, 192, 384, 768)
    encoder = sum(16 * i * o + 3 * o for i, o in pairwise(channels))
    gru = norm_linear(deter, hidden) + norm_linear(code, hidden) + norm_linear(a, hidden)
    gru += block(deter + 3 * hidden * 8, deter) + 2 * deter + block(deter, 3 * deter)
    prior = norm_linear(deter, hidden) + norm_linear(hidden, hidden) + linear(hidden, code)
    post = norm_linear(deter + 768 * 4, hidden) + linear(hidden, code)
    decoder = block(deter, 3072) + 2 * 3072 + linear(3072, 3072)
    decoder += norm_linear(code, 3072) + linear(3072, 3072)
    decoder += 25 * 3072 * 384 + 3 * 384 + 25 * 384 * 192 + 3 * 192
    decoder += 36 * 192 * 96 + 3 * 96 + 36 * 96 * 3 + 3
    return encoder, gru, prior, post, decoder


def test_the_paper_size_counts_281_million():
    with torch.device("meta"):
        model = WorldModel(SIZES["paper"], 21)
    rssm = model.rssm
    parts = [model.encoder], [rssm.gru], [rssm.prior_net], [rssm.post_in, rssm.post_out]
    assert tuple(count(*part) for part in (*parts, [model.decoder])) == paper_layout(21)
    total = sum(p.numel() for p in model.dynamics_parameters())
    assert total == sum(paper_layout(21)) == 281_384_259


def test_the_paper_sizes_heads():
    with torch.device("meta"):
        size = SIZES["paper"]
        heads = (
            WorldModel(size, 21).reward_head,
            Actor(size, 21),
            Critic(size),
            PriorActor(size, 21),
        )
    assert [round(count(head) / 1e6, 2) for head in heads] == [4.33, 4.49, 4.6, 2.62]


@pytest.mark.parametrize(
    ("size", "million"),
    [("debug", 0.1), ("tiny", 0.5), ("mid", 2.1), ("small", 2), ("medium", 14)],
)
def test_the_smaller_sizes_count_about_what_they_say(size, million):
    with torch.device("meta"):
        model = WorldModel(SIZES[size], 12)
    counted = sum(p.numel() for p in model.dynamics_parameters()) / 1e6
    assert counted == pytest.approx(million, rel=0.2)


# ------------------------------------------------------------------------------- padding


def test_nothing_that_the_padding_of_a_trajectory_holds_changes_any_output():
    clean = turn(8)
    wide = np.concatenate([clean.action, np.zeros((8, 3), np.float32)], 1)
    dirty = wide.copy()
    dirty[:, 1:] = np.random.default_rng(0).uniform(-1, 1, (8, 3))
    model = WorldModel(DEBUG, WIDTH)
    results = []
    for action in (wide, dirty):
        batch = windows(replace(clean, action=action, action_dim=1))
        loss, post = world_model_update_loss(model, batch, seeded())
        dream = model.open_loop(batch, 3, seeded())
        results.append((loss.total, post.feat, model.reward(post.feat), dream))
    torch.testing.assert_close(*results, rtol=0, atol=0)


# ----------------------------------------------------- actions, images and rewards are aligned


def turn(length, seed=0):
    """One of four quadrants is lit; action +1 lights the next one, -1 the one before.

    The reward is the number of the quadrant that the action led to.
    """
    rng = np.random.default_rng(seed)
    action = rng.choice([-1.0, 1.0], (length, 1)).astype(np.float32)
    place = (rng.integers(4) + np.concatenate([[0], action[:, 0].cumsum()])).astype(int) % 4
    return Trajectory(lit(place), action, place[1:].astype(np.float32))


def lit(place):
    image = np.zeros((len(place), 2, 32, 2, 32, 3), np.uint8)
    image[np.arange(len(place)), place // 2, :, place % 2] = 255
    return image.reshape(-1, 64, 64, 3)


def windows(*trajectories):
    return stack_windows([led_to(t, 0, len(t) + 1, WIDTH) for t in trajectories])


@pytest.fixture(scope="module")
def trained():
    """A debug-size world model, trained until the prior expects the quadrants: ~250 updates."""
    torch.manual_seed(0)
    model, replay, rng = WorldModel(DEBUG, WIDTH), ReplayBuffer(), np.random.default_rng(0)
    for seed in range(20):
        replay.add(turn(20, seed))
    optimizer, generator, kl = torch.optim.Adam(model.parameters(), 3e-3), seeded(), 9.0
    for _ in range(800):
        batch = replay.sample(4, 8, WIDTH, rng)
        loss, post = world_model_update_loss(model, batch, generator)
        logits = model.reward_head(post.feat.detach())
        optimizer.zero_grad()
        (loss.total + reward_loss(logits, batch.reward, batch.reward_known)).backward()
        torch.nn.utils.clip_grad_norm_(model.parameters(), 100)
        optimizer.step()
        kl = 0.9 * kl + 0.1 * loss.kl.item()
        if kl < 1.5:  # at most ln 4 = 1.39 of it is the first image, which nothing foretells
            break
    return model


def error(model, batch, context=5):
    """Of the frames predicted from actions alone; 0.25 for a grey frame."""
    frames = model.open_loop(batch, context, seeded())[:, context:].float()
    return ((frames - batch.image[:, context:]) / 255).square().mean().item()


@pytest.mark.slow
def test_frame_t_plus_1_follows_from_action_t_and_from_no_other(trained):
    batch = windows(*(turn(12, 100 + seed) for seed in range(16)))
    right = error(trained, batch)
    assert right < 0.02
    for shift in (-1, 1):
        assert error(trained, replace(batch, action=batch.action.roll(shift, 1))) > 5 * right + 0.1


@pytest.mark.slow
def test_an_imagined_action_turns_the_imagined_image(trained):
    batch = windows(*(turn(6, 200 + seed) for seed in range(8)))
    with torch.no_grad():
        post, *_ = trained.observe(batch, seeded())
        last = Latent(post.deter[:, -1], post.stoch[:, -1])
        place = batch.image[:, -1, ::32, ::32, 0].flatten(1).argmax(-1)
        for action in (-1.0, 1.0):
            taken = torch.zeros(8, WIDTH).index_fill(1, torch.tensor([0]), action)
            dream, _ = trained.rssm.imagine(last, lambda *_, a=taken: a, 2, seeded())
            seen = trained.decode(dream)[:, :, 16::32, 16::32, 0].flatten(2).argmax(-1)
            for step in range(3):
                assert torch.equal(seen[:, step], (place + int(action) * step) % 4)


@pytest.mark.slow
def test_a_reward_belongs_to_the_image_that_it_came_with(trained):
    batch = windows(*(turn(12, 300 + seed) for seed in range(8)))
    with torch.no_grad():
        post, *_ = trained.observe(batch, seeded())
        wrong = (trained.reward(post.feat) - batch.reward)[:, 1:].abs().mean()
    assert wrong < 0.2  # 1.25 if it were guessed
