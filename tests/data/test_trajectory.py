from pathlib import Path

import numpy as np
import pytest
import torch
from chain import chain, check_chain

from wpt_agents.data.trajectory import Trajectory, led_to, stack_windows

IMAGE = np.zeros((4, 8, 8, 3), np.uint8)
ACTION = np.zeros((3, 2), np.float32)


def test_led_to_by_hand():
    image = np.arange(4, dtype=np.uint8)[:, None, None, None] * np.ones((1, 8, 8, 3), np.uint8)
    action, reward = np.array([[0.1], [0.2], [0.3]]), np.array([1.0, 2.0, 3.0])
    streams = led_to(Trajectory(image, action, reward, terminated=True), 0, 4, width=2)
    # image    o_0  o_1  o_2  o_3
    # action    0   a_0  a_1  a_2, the second entry is padding
    assert streams["image"][:, 0, 0, 0].tolist() == [0, 1, 2, 3]
    np.testing.assert_allclose(streams["action"], [[0, 0], [0.1, 0], [0.2, 0], [0.3, 0]])
    assert streams["reward"].tolist() == [0, 1, 2, 3]
    assert streams["is_first"].tolist() == [True, False, False, False]
    assert streams["is_terminal"].tolist() == [False, False, False, True]


def test_lists_and_tensors_are_taken_as_arrays():
    old = chain(3)
    new = Trajectory(torch.from_numpy(old.image), old.action.tolist(), old.reward.tolist())
    np.testing.assert_array_equal(new.image, old.image)
    np.testing.assert_array_equal(new.action, old.action)
    assert isinstance(new.image, np.ndarray)


@pytest.mark.parametrize(
    "make",
    [
        lambda image: image.transpose(0, 3, 1, 2),
        lambda image: image / np.float32(255),
        lambda image: image.astype(np.float32),
    ],
    ids=["channels first", "floats", "bytes as floats"],
)
def test_the_remedy_for_images_of_another_form_works(make):
    old = chain(3)
    image = make(old.image)
    with pytest.raises(ValueError, match=r"must be \(T \+ 1, H, W, 3\) uint8, got .*; ") as refused:
        Trajectory(image, old.action)
    code = str(refused.value).split("; ")[1].split(" if ")[0]
    new = Trajectory(eval(code), old.action)
    np.testing.assert_array_equal(new.image, old.image)


def test_states_are_not_to_be_scaled_as_images_are():
    with pytest.raises(ValueError, match=r"got \(4, 3\) float32$"):
        Trajectory(np.zeros((4, 3), np.float32), ACTION)


def test_a_reward_too_large_for_float32_is_refused():
    with pytest.raises(ValueError, match=r"reward must be finite .* with 1 of inf; pass None"):
        Trajectory(IMAGE, ACTION, np.array([0, 1e300, 0]))


def test_a_window_inside_a_trajectory_starts_afresh_but_keeps_its_reward():
    trajectory = chain(10)
    streams = led_to(trajectory, 4, 7, width=2)
    assert not streams["action"][0].any()
    np.testing.assert_array_equal(streams["action"][1:], trajectory.action[4:6])
    np.testing.assert_array_equal(streams["reward"], trajectory.reward[3:6])
    assert streams["is_first"].tolist() == [True, False, False]


@pytest.mark.parametrize("terminated", [True, False])
def test_only_the_last_image_of_a_terminated_trajectory_is_terminal(terminated):
    trajectory = chain(5, terminated=terminated)
    assert led_to(trajectory, 0, 6, 2)["is_terminal"].tolist() == [False] * 5 + [terminated]
    assert not led_to(trajectory, 0, 5, 2)["is_terminal"].any()


def test_without_rewards_none_is_known_and_all_are_zero():
    streams = led_to(chain(5, reward=None), 1, 5, 2)
    assert not streams["reward_known"].any()
    assert not streams["reward"].any()


def test_whatever_the_padding_holds_becomes_zero():
    trajectory = Trajectory(IMAGE, np.full((3, 4), 0.5), action_dim=2)
    action = led_to(trajectory, 0, 4, width=6)["action"]
    assert (action[1:, :2] == 0.5).all()
    assert not action[:, 2:].any()


def test_stacked_windows_keep_to_the_chain():
    check_chain(stack_windows([led_to(chain(9, seed), seed, seed + 5, 3) for seed in range(4)]))


@pytest.mark.parametrize(
    ("arguments", "culprit"),
    [
        ({"image": IMAGE[..., :1]}, r"image must be \(T \+ 1, H, W, 3\) uint8"),
        ({"image": IMAGE.astype(np.float32)}, "float32"),
        ({"image": IMAGE[:3]}, "T = 2 >= 1 for 3 images"),
        ({"image": IMAGE[:1], "action": ACTION[:0]}, "T = 0 >= 1"),
        ({"action": ACTION[:, :0]}, r"must be \(T, A\) .* got \(3, 0\)"),
        ({"action": np.full((3, 2), np.nan)}, r"finite and in \[-1, 1\]"),
        ({"action": np.full((3, 2), 2.0)}, "rescale"),
        ({"action": np.full((3, 2), -128, np.int8)}, "runs from -128 to -128: rescale"),
        ({"action": np.full((3, 2), -(2**63))}, "rescale"),
        ({"reward": np.zeros((3, 1))}, "reward must be finite and of shape"),
        ({"reward": np.array([0, np.inf, 0])}, "pass None when rewards are unknown"),
        ({"action_dim": 3}, "exceeds the width 2"),
    ],
)
def test_a_wrong_trajectory_is_refused(arguments, culprit):
    with pytest.raises(ValueError, match=culprit):
        Trajectory(**{"image": IMAGE, "action": ACTION, **arguments})


def test_labels_become_text():
    path = Path("a", "b.h5")
    labelled = Trajectory(IMAGE, ACTION, embodiment=b"arm", task=np.int64(3), source=path)
    assert (labelled.embodiment, labelled.task, labelled.source) == ("arm", "3", str(path))
    assert Trajectory(IMAGE, ACTION).task is None


def test_it_is_shown_without_its_pixels():
    shown = "Trajectory(T=3, embodiment='arm', task=None, action_dim=2, reward=None)"
    assert repr(Trajectory(IMAGE, ACTION, embodiment="arm")) == shown
    assert "reward=known" in repr(Trajectory(IMAGE, ACTION, np.zeros(3)))
