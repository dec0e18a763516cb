import numpy as np
import pytest
import torch

from wpt_agents.data.trajectory import Trajectory
from wpt_agents.model.behavior_cloning import FRAMES, PriorActor
from wpt_agents.model.sizes import SIZES
from wpt_agents.training import cloning
from wpt_agents.training.cloning import Cloning, clone
from wpt_agents.training.randomness import Streams

MASK = torch.tensor([True, True])


def demonstrations():
    """One steady demonstrator, whose action is 0.5, and three noisy ones, 0 on average."""
    rng = np.random.default_rng(0)
    image = np.zeros((21, 64, 64, 3), np.uint8)
    steady = np.full((20, 2), 0.5, np.float32)
    noisy = [rng.choice([-1.0, 1.0], (20, 2)).astype(np.float32) for _ in range(3)]
    return [Trajectory(image, action) for action in (steady, *noisy)]


def cloned_action(variance):
    torch.manual_seed(0)
    settings = Cloning(100, 16, 1e-2, 1, variance)
    actor = clone(PriorActor(SIZES["debug"], 2), demonstrations(), MASK, settings, Streams(0))
    with torch.no_grad():
        return actor(torch.zeros(1, FRAMES, 64, 64, 3, dtype=torch.uint8)).mean().item()


def test_with_variances_of_their_own_the_steady_trajectory_is_imitated():
    # with a fixed variance the mean of all actions is: a quarter of 0.5
    assert abs(cloned_action("fixed")) < 0.25
    assert abs(cloned_action("trajectory") - 0.5) < 0.1


@pytest.mark.parametrize("shift", [0, 2])
def test_images_are_shifted_as_far_as_the_settings_say(shift, monkeypatch):
    moved = []

    def spy(image, pad, generator):
        shifted = cloning_shift(image, pad, generator)
        moved.append((shifted != image).any().item())
        return shifted

    cloning_shift = cloning.random_shift
    monkeypatch.setattr(cloning, "random_shift", spy)
    image = np.random.default_rng(0).integers(256, size=(21, 64, 64, 3), dtype=np.uint8)
    trajectory = Trajectory(image, np.zeros((20, 2), np.float32))
    settings = Cloning(3, 16, 1e-2, shift, "fixed")
    clone(PriorActor(SIZES["debug"], 2), [trajectory], MASK, settings, Streams(0))
    assert moved == [shift > 0] * 3
