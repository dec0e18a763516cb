"""R3M's loss by hand, and the clips that it is made of."""

import math

import numpy as np
import torch
from debug_agent import recorded

from wpt_agents.model.time_contrastive import (
    aligned,
    derangements,
    draw_clips,
    r3m_loss,
    random_crop,
    similarity,
    time_contrastive_loss,
)


def test_similarity_is_the_negative_distance():
    # sqrt(3² + 4²) = 5
    assert similarity(torch.tensor([3.0, 0.0]), torch.tensor([0.0, 4.0])).item() == -5


def test_time_contrastive_loss_by_hand():
    # one-dimensional features; clip 0 at 0, 1, 3 and clip 1 at 10, 10, 10
    z = torch.tensor([[[0.0], [1.0], [3.0]], [[10.0], [10.0], [10.0]]])
    others = torch.tensor([[1, 0]])
    # clip 0: S(1,2) = -2, S(0,1) = -1, S(0,2) = -3, S(s2,s2') = -7, S(s0,s0') = -10
    first = -math.log(math.exp(-2) / (math.exp(-2) + math.exp(-3) + math.exp(-7)))
    second = -math.log(math.exp(-1) / (math.exp(-1) + math.exp(-3) + math.exp(-10)))
    # clip 1: all near ones are 0, the other clip is as far as before
    third = -math.log(1 / (2 + math.exp(-7)))
    fourth = -math.log(1 / (2 + math.exp(-10)))
    loss = time_contrastive_loss(z, others)
    torch.testing.assert_close(
        loss.item(), (first + second + third + fourth) / 4, rtol=1e-4, atol=0
    )
    assert aligned(z).item() == 0.5  # clip 1 has no order


def test_the_size_of_the_features_is_penalised_by_1e_5():
    z, others = torch.tensor([[[3.0, -4.0]] * 3] * 2), torch.tensor([[1, 0]])
    # ||z||_1 = 7 and ||z||_2 = 5
    extra = r3m_loss(z, others) - time_contrastive_loss(z, others)
    assert abs(extra.item() - 12e-5) < 1e-6


def test_identical_features_have_a_finite_gradient():
    z = torch.ones(2, 3, 4, requires_grad=True)
    r3m_loss(z, torch.tensor([[1, 0]])).backward()
    assert z.grad.isfinite().all()


def test_clips_are_in_order_and_reach_all_images():
    image = np.repeat(np.arange(6, dtype=np.uint8), 64 * 64 * 3).reshape(6, 64, 64, 3)
    rng = np.random.default_rng(0)
    clips = draw_clips(np.array([5]), lambda i, times: image[times], 2000, rng)
    s0, s1, s2 = clips[:, :, 0, 0, 0].int().T
    assert (s0 < s1).all() and (s1 <= s2).all() and (s1 == s2).any()
    assert set(s0.tolist()) == set(range(5)) and set(s2.tolist()) == set(range(1, 6))


def test_the_middle_image_of_a_clip_is_equally_likely_anywhere():
    draws = draw_clips(
        np.array([4]), lambda _, times: np.array(times), 8000, np.random.default_rng(0)
    )
    s0, s1, s2 = draws.T.numpy()
    np.testing.assert_allclose(np.bincount(s1)[1:] / 8000, [1 / 4] * 4, atol=0.02)
    # of the images before and from 3 on
    np.testing.assert_allclose(np.bincount(s0[s1 == 3]) / (s1 == 3).sum(), [1 / 3] * 3, atol=0.04)
    np.testing.assert_allclose(np.bincount(s2[s1 == 3])[3:] / (s1 == 3).sum(), [0.5] * 2, atol=0.04)


def test_no_clip_is_contrasted_with_itself():
    others = derangements(4, 500, np.random.default_rng(0))
    assert others.shape == (500, 4) and (others != torch.arange(4)).all()
    assert set(others[:, 0].tolist()) == {1, 2, 3}


def test_the_images_of_a_clip_are_cropped_alike_and_clips_differently():
    image = recorded().image[:1]
    clips = torch.from_numpy(np.repeat(image[None], 8, 0)).expand(8, 3, -1, -1, -1).contiguous()
    cut = random_crop(clips, np.random.default_rng(0))
    assert cut.shape == clips.shape and cut.min() >= 0 and cut.max() <= 255
    assert (cut[:, 0] == cut[:, 1]).all() and (cut[0] != cut[1]).any()


def test_a_crop_of_a_plain_image_is_plain():
    clips = torch.full((4, 3, 64, 64, 3), 77, dtype=torch.uint8)
    torch.testing.assert_close(random_crop(clips, np.random.default_rng(0)), clips.float())
