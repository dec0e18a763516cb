"""The paper's equations, one test each, the expected values worked out by hand.

A.2: Eq. (1). A.3: Eq. (2) to (5), the reward likelihood, behaviour cloning, execution guidance.
"""

import math

import numpy as np
import pytest
import torch

from wpt_agents.data.retrieval import Retriever
from wpt_agents.model.actor_critic import actor_loss, critic_loss, lambda_return
from wpt_agents.model.behavior_cloning import bc_loss
from wpt_agents.model.world_model import reward_loss, squared_error, world_model_loss
from wpt_agents.training.guidance import draw_window, parse_schedule


def probabilities(*rows):
    return torch.tensor(rows).log()


def test_eq_1_world_model_loss():
    # Two steps, one group of two classes. Frames: every one of 64 * 64 * 3 = 12288 bytes is off by
    # 0.1 at step 0 and by 0.2 at step 1: mean error 12288 (0.01 + 0.04) / 2 = 307.2
    image = torch.zeros(1, 2, 64, 64, 3)
    reconstruction = image + torch.tensor([0.1, -0.2]).view(1, 2, 1, 1, 1)
    # KL(q || p): step 0: .8 ln(.8 / .5) + .2 ln(.2 / .5) = .19274; step 1: 0. The mean is .09637
    post = probabilities([0.8, 0.2], [0.3, 0.7]).view(1, 2, 1, 2)
    prior = probabilities([0.5, 0.5], [0.3, 0.7]).view(1, 2, 1, 2)
    error = squared_error(image, reconstruction)
    loss = world_model_loss(error, post, prior, 1.0, 0.1, free_nats=0.0)
    kl = (0.8 * math.log(1.6) + 0.2 * math.log(0.4)) / 2
    assert loss.reconstruction.item() == pytest.approx(307.2, rel=1e-5)
    assert loss.kl.item() == pytest.approx(kl, rel=1e-5)
    assert loss.total.item() == pytest.approx(307.2 + 1.1 * kl, rel=1e-5)
    # Below a nat both terms stand at one nat: 1.0 * 1 + 0.1 * 1
    free = world_model_loss(error, post, prior)
    assert free.total.item() == pytest.approx(307.2 + 1.1, rel=1e-5)


def test_eq_2_lambda_return():
    reward, value = torch.tensor([[1.0, 2.0, 3.0]]), torch.tensor([[99.0, 4.0, 8.0, 6.0]])
    # γ = 0.5, λ = 0.25. V_3 = v_3 = 6
    # V_2 = 3 + .5 (.75 * 6 + .25 * 6) = 6
    # V_1 = 2 + .5 (.75 * 8 + .25 * 6) = 5.75
    # V_0 = 1 + .5 (.75 * 4 + .25 * 5.75) = 3.21875
    expected = torch.tensor([[3.21875, 5.75, 6.0]])
    torch.testing.assert_close(lambda_return(reward, value, 0.5, 0.25), expected)


def test_eq_3_critic_loss():
    # 3 bins -20, 0, 20 of symlog space; γ = 0.5.
    # Step 0: V = 0 is bin 1; uniform logits: -ln 1/3 = ln 3
    # Step 1: V = e^10 - 1, symlog 10: half bin 1, half bin 2; p = 1/4, 1/4, 1/2:
    #         -(ln 1/4 + ln 1/2) / 2 = 1.5 ln 2
    logits = torch.stack([torch.zeros(3), torch.tensor([0.25, 0.25, 0.5]).log()])[None]
    returns = torch.tensor([[0.0, math.exp(10) - 1]])
    expected = (math.log(3) + 0.5 * 1.5 * math.log(2)) / 2
    assert critic_loss(logits, returns, gamma=0.5).item() == pytest.approx(expected, rel=1e-5)


def test_eq_4_actor_loss():
    # η = 0.1, γ = 0.5. Action 0 is judged by V_1, action 1 by V_2:
    # -(1 (5 + .1 * 2) + .5 (7 + .1 * 4)) / 2 = -(5.2 + 3.7) / 2 = -4.45
    returns, entropy = torch.tensor([[99.0, 5.0, 7.0]]), torch.tensor([[2.0, 4.0, 99.0]])
    assert actor_loss(returns, entropy, 0.1, 0.5).item() == pytest.approx(-4.45)


def test_eq_5_retrieval():
    # e(o_on) = (1, 1). D: (4, 5): sqrt(9 + 16) = 5; (1, 3): 2; (1, 0): 1
    features = np.array([[4, 5], [1, 3], [1, 0]], np.float32)
    retriever = Retriever(features, np.full(3, 2), [None] * 3, "encoder")
    indices, distances = retriever.search(np.ones(2, np.float32), k=2)
    assert indices.tolist() == [2, 1]
    np.testing.assert_allclose(distances, [1, 2])


def test_the_reward_likelihood():
    # 3 bins -20, 0, 20. Known: r = 0 under p = 1/2 on bin 1, r = e^5 - 1 (symlog 5: 3/4 on bin 1,
    # 1/4 on bin 2) under p = 1/4, 1/2, 1/4: ln 2 and 3/4 ln 2 + 1/4 ln 4 = 5/4 ln 2.
    # The third reward is not known and counts nothing.
    logits = probabilities([0.25, 0.5, 0.25])[None].expand(1, 3, 3)
    reward, known = torch.tensor([[0.0, math.exp(5) - 1, 9.0]]), torch.tensor([[True, True, False]])
    loss = reward_loss(logits, reward, known)
    assert loss.item() == pytest.approx(9 / 8 * math.log(2), rel=1e-5)


def test_the_behaviour_cloning_loss():
    # Errors of the true entries: .5, 1; 0, .5. (.25 + 1 + 0 + .25) / (2 * 2) = .375
    prediction = torch.tensor([[0.5, 1.0, 9.0], [0.0, -0.5, 9.0]])
    action, mask = torch.zeros(2, 3), torch.tensor([True, True, False])
    assert bc_loss(prediction, action, mask).item() == pytest.approx(0.375)


def test_execution_guidance():
    # linear(1,0,50000) at a fifth: 1 - 10000 / 50000 = 0.8
    schedule = parse_schedule("linear(1,0,50000)")
    assert [schedule(s) for s in (0, 10_000, 50_000, 99_999)] == pytest.approx([1, 0.8, 0, 0])
    rng = np.random.default_rng(0)
    windows = [draw_window(schedule(10_000), 500, rng) for _ in range(2000)]
    guided = [(k, stop) for k, stop in windows if stop]
    # 0.8 of 2000, of standard deviation sqrt(.8 * .2 / 2000) = .009
    assert len(guided) / 2000 == pytest.approx(0.8, abs=0.035)
    # lengths 50, 100, ... 500, each inside the episode
    assert {stop - k for k, stop in guided} == set(range(50, 501, 50))
    assert all(0 <= k and stop <= 500 for k, stop in guided)
