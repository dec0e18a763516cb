import numpy as np
import torch

from wpt_agents.data.trajectory import Trajectory
from wpt_agents.model.behavior_cloning import FRAMES, PriorActor
from wpt_agents.model.sizes import SIZES
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
    settings = Cloning(100, 16, 1e-2, variance)
    actor = clone(PriorActor(SIZES["debug"], 2), demonstrations(), MASK, settings, Streams(0))
    with torch.no_grad():
        return actor(torch.zeros(1, FRAMES, 64, 64, 3, dtype=torch.uint8)).mean().item()


def test_with_variances_of_their_own_the_steady_trajectory_is_imitated():
    # with a fixed variance the mean of all actions is: a quarter of 0.5
    assert abs(cloned_action("fixed")) < 0.25
    assert abs(cloned_action("trajectory") - 0.5) < 0.1
