"""Trajectories of a known chain, so that a wrong shift of actions or rewards is always seen."""

import numpy as np

from wpt_agents.data.trajectory import Batch, Trajectory


def follows(state, action):
    """The chain: x' = 3 x + 100 a, modulo 251; x is every byte of the image."""
    return (3 * state + np.rint(100 * action).astype(int)) % 251


def chain(length, seed=0, action_dim=2, size=8, **labels):
    """A trajectory of the chain, driven by action entry 0; the reward is the next x / 251."""
    rng = np.random.default_rng(seed)
    action = rng.integers(-100, 101, (length, action_dim)).astype(np.float32) / 100
    states = [int(rng.integers(251))]
    for t in range(length):
        states.append(int(follows(states[-1], action[t, 0])))
    image = np.broadcast_to(
        np.array(states, np.uint8)[:, None, None, None], (length + 1, size, size, 3)
    )
    reward = np.array(states[1:], np.float32) / 251
    labels.setdefault("reward", reward)
    return Trajectory(image=image.copy(), action=action, **labels)


def check_chain(batch: Batch):
    """Every image of a batch follows from the one before by the action and reward beside it."""
    state, action = batch.image[..., 0, 0, 0].numpy().astype(int), batch.action[..., 0].numpy()
    goes_on = ~batch.is_first[:, 1:].numpy()
    assert goes_on.any()
    assert (follows(state[:, :-1], action[:, 1:]) == state[:, 1:])[goes_on].all()
    known = batch.reward_known[:, 1:].numpy() & goes_on
    np.testing.assert_allclose(batch.reward[:, 1:].numpy()[known], state[:, 1:][known] / 251, 1e-5)
    assert not batch.action.numpy()[batch.is_first.numpy()].any()
    assert batch.is_first[:, 0].all()


def tensors(batch: Batch):
    """The batch's streams as numpy arrays, by name."""
    return {name: tensor.numpy() for name, tensor in vars(batch).items()}
