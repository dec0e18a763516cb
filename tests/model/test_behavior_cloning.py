import numpy as np
import pytest
import torch

from wpt_agents.data.trajectory import Trajectory
from wpt_agents.model.behavior_cloning import (
    FRAMES,
    PriorActor,
    TrajectoryVariances,
    bc_loss,
    draw_pairs,
    random_shift,
    recent_frames,
)
from wpt_agents.model.sizes import SIZES

OWN = torch.tensor([True, True, False])


def seeded(seed=0):
    return torch.Generator().manual_seed(seed)


def frames(n=2):
    return torch.randint(256, (n, FRAMES, 64, 64, 3), generator=seeded(), dtype=torch.uint8)


@pytest.fixture
def prior_actor():
    torch.manual_seed(0)
    return PriorActor(SIZES["debug"], 3)


def test_the_gradient_of_the_loss_is_that_of_a_gaussians_likelihood():
    # -ln N(a; m, 1/2) = (a - m)^2 + constant: the same slope, averaged over 2 x 2 true entries
    prediction = torch.tensor([[0.5, 1.0, 9.0], [0.2, -0.5, 9.0]], requires_grad=True)
    action = torch.tensor([[0.1, 0.2, 0.0], [0.3, 0.4, 0.0]])
    bc_loss(prediction, action, OWN).backward()
    normal = torch.distributions.Normal(prediction, 0.5**0.5)
    likelihood = -normal.log_prob(action)[:, :2].mean()
    torch.testing.assert_close(prediction.grad, torch.autograd.grad(likelihood, prediction)[0])


def test_nothing_in_the_padding_changes_the_loss_or_its_gradient(prior_actor):
    action, garbage = torch.zeros(2, 3), torch.tensor([[0.0, 0.0, 7.0]]).expand(2, 3)
    grads = []
    for target in (action, action + garbage):
        loss = bc_loss(prior_actor(frames()), target, OWN)
        grads.append(torch.autograd.grad(loss, list(prior_actor.parameters())))
    assert all(torch.equal(*pair) for pair in zip(*grads, strict=True))
    assert not grads[0][-1][2]  # the bias of the padded entry
    assert grads[0][-1][:2].all()


def test_the_loss_does_not_depend_on_how_much_padding_there_is():
    prediction, action = torch.rand(4, 2, generator=seeded()), torch.rand(4, 2)
    wide = [torch.cat([x, torch.ones(4, 6)], 1) for x in (prediction, action)]
    narrow = bc_loss(prediction, action, torch.tensor([True, True]))
    torch.testing.assert_close(bc_loss(*wide, torch.arange(8) < 2), narrow)


def test_the_clone_acts_inside_the_bounds_and_not_in_the_padding(prior_actor):
    with torch.no_grad():
        prior_actor.layers[-1].weight.mul_(100)
        action = prior_actor.act(frames(8), OWN)
        raw = prior_actor(frames(8))
    assert raw.abs().max() > 1
    assert action.abs().max() <= 1
    assert not action[:, 2].any() and action[:, :2].all()


def test_the_clone_tells_the_order_of_its_frames(prior_actor):
    with torch.no_grad():
        assert not torch.allclose(prior_actor(frames()), prior_actor(frames().flip(1)))


def test_each_row_is_seen_alone(prior_actor):
    with torch.no_grad():
        torch.testing.assert_close(prior_actor(frames(3))[1:2], prior_actor(frames(3)[1:2]))


def test_a_shift_moves_all_frames_of_a_row_alike_and_repeats_the_border():
    image = frames(50)
    moved = random_shift(image, 3, seeded())
    padded = (
        torch.nn.functional.pad(
            image.flatten(0, 1).permute(0, 3, 1, 2).float(), (3, 3, 3, 3), mode="replicate"
        )
        .permute(0, 2, 3, 1)
        .unflatten(0, (50, FRAMES))
    )
    places = [(i, j) for i in range(7) for j in range(7)]
    matches = [
        [p for p in places if torch.equal(moved[n].float(), crop(padded[n], *p))] for n in range(50)
    ]
    assert all(len(match) == 1 for match in matches)
    assert len({match[0] for match in matches}) > 20  # of 49


def crop(padded, i, j):
    return padded[:, i : i + 64, j : j + 64]


def test_no_shift_leaves_the_image_alone():
    assert torch.equal(random_shift(frames(), 0), frames())


def test_a_pair_is_what_was_seen_up_to_a_step_and_the_action_taken_at_it():
    # image t of episode i is all 10 i + t, and the action taken at it 0.1 i + 0.01 t
    def episode(i, steps):
        times = np.arange(steps + 1)
        image = np.broadcast_to((10 * i + times)[:, None, None, None], (steps + 1, 64, 64, 3))
        action = np.full((steps, 2), 0.1 * i) + 0.01 * times[:-1, None]
        return Trajectory(image.astype(np.uint8), action.astype(np.float32))

    pairs = draw_pairs([episode(1, 4), episode(2, 1)], 400, 3, np.random.default_rng(0))
    image, action, chosen = pairs
    assert torch.equal(chosen == 0, image[:, -1, 0, 0, 0] < 20)
    assert image.shape == (400, FRAMES, 64, 64, 3) and action.shape == (400, 3)
    shown, taken = image[:, :, 0, 0, 0].tolist(), action[:, 0].tolist()
    pairs = {(*frames, round(a, 2)) for frames, a in zip(shown, taken, strict=True)}
    first = {(10, 10, 10, 0.1), (10, 10, 11, 0.11), (10, 11, 12, 0.12), (11, 12, 13, 0.13)}
    assert pairs == first | {(20, 20, 20, 0.2)}
    assert (action[:, 2] == 0).all()
    share = sum(frames[-1] == 20 for frames in shown) / 400  # one step of five
    assert share == pytest.approx(0.2, abs=0.06)


def test_padding_of_another_width_is_left_out_of_the_pairs():
    action = np.full((3, 5), 0.9, np.float32)  # of two entries and a padding that is not even zero
    trajectory = Trajectory(np.zeros((4, 64, 64, 3), np.uint8), action, action_dim=2)
    _, action, _ = draw_pairs([trajectory], 2, 4, np.random.default_rng(0))
    torch.testing.assert_close(action, torch.tensor([[0.9, 0.9, 0.0, 0.0]] * 2))


def test_weights_make_the_loss_that_of_gaussians_with_variances_of_their_own():
    prediction = torch.tensor([[0.5, 1.0, 9.0], [0.2, -0.5, 9.0]], requires_grad=True)
    action = torch.tensor([[0.1, 0.2, 0.0], [0.3, 0.4, 0.0]])
    variance = torch.tensor([0.5, 2.0])
    bc_loss(prediction, action, OWN, weight=0.5 / variance).backward()
    normal = torch.distributions.Normal(prediction, variance[:, None].sqrt())
    likelihood = -normal.log_prob(action)[:, :2].mean()
    torch.testing.assert_close(prediction.grad, torch.autograd.grad(likelihood, prediction)[0])


def test_the_variance_of_a_trajectory_follows_its_own_errors():
    variances = TrajectoryVariances(3)
    prediction = torch.zeros(3, 3, requires_grad=True)
    # squared errors of 0.04 and 0.16, both of trajectory 2, and of 0.81, of trajectory 0
    action = torch.tensor([[0.2, 0.2, 5.0], [0.4, 0.4, 5.0], [0.9, 0.9, 5.0]])
    chosen = torch.tensor([2, 2, 0])
    variances.update(prediction, action, OWN, chosen)
    expected = torch.tensor([0.95 + 0.05 * 0.81, 1.0, 0.95 + 0.05 * 0.10])
    torch.testing.assert_close(variances.values, expected)
    for _ in range(400):
        variances.update(prediction, action, OWN, chosen)
    torch.testing.assert_close(variances.values, torch.tensor([0.81, 1.0, 0.10]))
    weights = variances.weights()
    torch.testing.assert_close(weights / weights[1], torch.tensor([1 / 0.81, 1.0, 10.0]))
    assert weights.mean().item() == pytest.approx(1.0)
    assert not variances.values.requires_grad


def test_no_trajectory_outweighs_all_others():
    variances = TrajectoryVariances(2)
    still = torch.zeros(1, 3)
    for _ in range(400):
        variances.update(still, still, OWN, torch.tensor([0]))
    assert (variances.weights()[0] / variances.weights()[1]).item() == pytest.approx(100)


def test_what_is_imitated_sees_the_last_three_images_of_its_own_episode():
    # two windows: one out of an episode's middle; one where another begins at the fourth image
    image = torch.tensor([[10, 11, 12, 13, 14], [5, 6, 7, 0, 1]], dtype=torch.uint8)
    is_first = torch.tensor([[0, 0, 0, 0, 0], [0, 0, 0, 1, 0]]).bool()
    seen = recent_frames(image[..., None, None, None].expand(2, 5, 64, 64, 3), is_first)
    assert seen.shape == (2, 3, FRAMES, 64, 64, 3)
    assert seen[..., 0, 0, 0].tolist() == [
        [[10, 11, 12], [11, 12, 13], [12, 13, 14]],
        [[5, 6, 7], [0, 0, 0], [0, 0, 1]],
    ]
