"""n-step transitions, by hand on episodes of five steps."""

import numpy as np
import pytest
import torch
import torch.nn.functional as F

from wpt_agents.data.trajectory import Trajectory
from wpt_agents.data.transitions import (
    concatenate,
    draw_steps,
    draw_transitions,
    n_step_return,
    random_shift,
)


def episode(length=5, terminated=False, actions=2, rewards=True):
    """Image t is t everywhere, action t is t / 10, reward t is t + 1."""
    image = np.repeat(np.arange(length + 1, dtype=np.uint8), 64 * 64 * 3)
    action = np.tile(np.arange(length)[:, None] / 10, actions)
    reward = np.arange(1.0, length + 1)
    return Trajectory(image.reshape(-1, 64, 64, 3), action, reward if rewards else None, terminated)


def drawn(trajectories, n_steps, size=200, gamma=0.5, action_dim=2):
    rng = np.random.default_rng(0)
    return draw_transitions(trajectories, size, n_steps, gamma, action_dim, rng)


def by_start(batch):
    """{s: (frames, R, D, next frames)}."""
    rows = {}
    for i in range(len(batch)):
        seen, then = (x[i, :, 0, 0, 0].tolist() for x in (batch.image, batch.next_image))
        rows[seen[-1]] = (seen, batch.reward[i].item(), batch.discount[i].item(), then)
    return rows


def test_n_step_return_by_hand():
    # R = 1 + 0.5 * 2 + 0.25 * 3 = 2.75 and D = 0.5^3
    assert n_step_return(np.array([1.0, 2.0, 3.0]), 0.5, False) == (2.75, 0.125)
    assert n_step_return(np.array([1.0, 2.0, 3.0]), 0.5, True) == (2.75, 0.0)
    assert n_step_return(np.array([4.0]), 0.5, False) == (4.0, 0.5)


def test_no_start_lies_within_the_last_steps_and_a_time_limit_is_bootstrapped_from():
    rows = by_start(drawn([episode()], 3))
    assert rows == {
        0: ([0, 0, 0], 1 + 1 + 0.75, 0.125, [1, 2, 3]),
        1: ([0, 0, 1], 2 + 1.5 + 1, 0.125, [2, 3, 4]),
        2: ([0, 1, 2], 3 + 2 + 1.25, 0.125, [3, 4, 5]),
    }


def test_nothing_is_bootstrapped_from_behind_a_terminal_state():
    rows = by_start(drawn([episode(terminated=True)], 3))
    assert {s: row[2] for s, row in rows.items()} == {0: 0.125, 1: 0.125, 2: 0.0}
    assert rows[2][1] == 6.25  # the last reward counts all the same


def test_the_last_steps_are_starts_where_the_episode_terminated_and_they_are_asked_for():
    rng = np.random.default_rng(0)
    both = [
        {s: row[1:3] for s, row in by_start(draw_transitions(*shape, rng, tails=True)).items()}
        for shape in (([episode(terminated=end)], 200, 3, 0.5, 2) for end in (True, False))
    ]
    full = {0: (2.75, 0.125), 1: (4.5, 0.125)}
    # r_3 + .5 r_4 = 4 + 2.5 and r_4 = 5, behind which there is nothing
    assert both[0] == full | {2: (6.25, 0.0), 3: (6.5, 0.0), 4: (5.0, 0.0)}
    assert both[1] == full | {2: (6.25, 0.125)}


def test_an_episode_shorter_than_n_steps_is_drawn_whole():
    assert by_start(drawn([episode(2)], 3)) == {0: ([0, 0, 0], 2.0, 0.25, [0, 1, 2])}


def test_starts_are_equally_likely_across_episodes_of_unequal_length():
    batch = drawn([episode(1), episode(9)], 1, size=5000)
    times = batch.image[:, -1, 0, 0, 0].numpy()
    counts = np.bincount(times, minlength=9)
    assert len(counts) == 9  # start 0 twice, of either episode, the other eight once
    np.testing.assert_allclose(counts / 5000, [0.2] + [0.1] * 8, atol=0.02)


def test_unknown_rewards_are_zero_and_narrow_actions_are_padded():
    batch = drawn([episode(actions=1, rewards=False)], 1, action_dim=3)
    assert (batch.reward == 0).all() and (batch.discount == 0.5).all()
    assert (batch.action[:, 1:] == 0).all()
    np.testing.assert_allclose(batch.action[:, 0] * 10, batch.image[:, -1, 0, 0, 0], rtol=1e-6)


def test_parts_are_concatenated_in_order():
    one, other = drawn([episode(5)], 1, size=3), drawn([episode(2)], 1, size=2)
    both = concatenate([one, other])
    assert len(both) == 5
    assert (both.reward[:3] == one.reward).all() and (both.image[3:] == other.image).all()


def test_no_episodes_are_refused():
    with pytest.raises(ValueError, match="no episodes"):
        drawn([], 1)


def grid_shift(image, shift, pad):
    """DrQ-v2's own form of the shift: pad by the border, then sample a grid bilinearly."""
    n, _, size, _ = image.shape
    padded = F.pad(image, (pad,) * 4, "replicate")
    eps = 1 / (size + 2 * pad)
    line = torch.linspace(-1 + eps, 1 - eps, size + 2 * pad)[:size]
    grid = torch.stack(torch.meshgrid(line, line, indexing="ij")[::-1], -1)[None]
    move = (shift.flip(-1) + pad).view(n, 1, 1, 2) * 2 / (size + 2 * pad)
    return F.grid_sample(padded, grid + move, padding_mode="zeros", align_corners=False)


def test_the_shift_is_that_of_drqv2_and_the_same_for_all_frames_of_a_stack():
    n, pad = 6, 4
    image = np.random.default_rng(0).integers(0, 256, (n, 3, 64, 64, 3)).astype(np.uint8)
    shift = torch.from_numpy(np.random.default_rng(3).integers(0, 2 * pad + 1, (n, 2)) - pad)
    assert len({tuple(s.tolist()) for s in shift}) > 1  # each stack has a shift of its own
    moved = torch.from_numpy(random_shift(image, pad, np.random.default_rng(3)))
    planes = torch.from_numpy(image).permute(0, 1, 4, 2, 3).flatten(1, 2).float()
    expected = grid_shift(planes, shift, pad).unflatten(1, (3, 3)).permute(0, 1, 3, 4, 2)
    torch.testing.assert_close(moved.float(), expected, atol=0.01, rtol=0)


def test_both_observations_are_shifted_and_by_different_offsets():
    rng = np.random.default_rng(0)
    image = np.repeat(rng.integers(0, 256, (1, 64, 64, 3)).astype(np.uint8), 6, 0)
    still = Trajectory(image, np.zeros((5, 2)), np.zeros(5))  # o and o' show the same
    batch = draw_transitions([still], 20, 1, 0.9, 2, rng, pad=4)
    shown = torch.from_numpy(image[:3])
    moved = [[bool((x != shown).any()) for x in side] for side in (batch.image, batch.next_image)]
    assert np.mean(moved) > 0.9  # one shift of 81 is none
    assert (batch.image != batch.next_image).flatten(1).any(1).float().mean() > 0.9


def test_steps_in_a_row_by_hand():
    rng = np.random.default_rng(0)
    batch = draw_steps([episode(5, terminated=True)], 200, 3, 2, rng)
    firsts = batch.image[:, -1, 0, 0, 0]
    assert set(firsts.tolist()) == {0, 1, 2, 3, 4}  # every step may be the first one
    for row, first in enumerate(firsts.tolist()):
        steps = [min(first + i, 4) for i in range(3)]
        assert batch.image[row, :, 0, 0, 0].tolist() == [max(first + i, 0) for i in (-2, -1, 0)]
        assert batch.next_image[row, :, -1, 0, 0, 0].tolist() == [
            min(first + i, 5) for i in (1, 2, 3)
        ]
        np.testing.assert_allclose(batch.action[row, :, 0], np.array(steps) / 10, rtol=1e-6)
        assert batch.reward[row].tolist() == [t + 1 for t in steps]
        assert batch.inside[row].tolist() == [float(first + i < 5) for i in range(3)]
        assert batch.end[row].tolist() == [float(t == 4) for t in steps]


def test_a_time_limit_is_no_end_and_episodes_shorter_than_the_horizon_are_drawn():
    batch = draw_steps([episode(2)], 50, 5, 3, np.random.default_rng(0), pad=4)
    assert (batch.end == 0).all() and (batch.action[..., 2] == 0).all()
    assert set(batch.inside.sum(1).tolist()) == {1.0, 2.0}


def test_the_frames_of_each_stack_are_shifted_alike_and_the_stacks_independently():
    rng = np.random.default_rng(0)
    image = np.repeat(rng.integers(0, 256, (1, 64, 64, 3)).astype(np.uint8), 6, 0)
    still = Trajectory(image, np.zeros((5, 2)), np.zeros(5))
    batch = draw_steps([still], 20, 2, 2, rng, pad=4)
    assert (batch.next_image[:, :, 0] == batch.next_image[:, :, 2]).all()
    assert (batch.next_image[:, 0] != batch.next_image[:, 1]).flatten(1).any(1).float().mean() > 0.9
