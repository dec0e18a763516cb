"""The way a GPU takes, without one: nothing is left on the CPU by mistake, or waited for."""

from collections import defaultdict
from dataclasses import astuple, replace

import numpy as np
import other_device
import pytest
import torch
from debug_agent import ClockEnv, agent, noise, pretrained, recorded, weights
from test_exploration import explorer

from wpt_agents import WPT
from wpt_agents.agents.curious import ICMExplorer, Plan2Explore
from wpt_agents.model import distributions, policy
from wpt_agents.model.rssm import filter_sequence
from wpt_agents.training import randomness
from wpt_agents.zoo.judge import diagnosis


@pytest.fixture
def other(monkeypatch):
    for module in (
        policy,
        randomness,
        diagnosis,
    ):  # random numbers are the CPU's on both devices
        monkeypatch.setattr(module, "Generator", lambda device: torch.Generator())
    monkeypatch.setattr(
        distributions.Share, "__new__", lambda cls, *_: torch.Generator.__new__(cls)
    )
    monkeypatch.setattr(filter_sequence, "twins", [])  # the scan is for the CPU alone
    other_device.waits.clear()
    return "other"


def test_the_device_is_as_strict_as_a_gpu(other):
    x = torch.zeros(2, 3, device=other)
    assert x.device.type == other
    assert ((x + 1).cpu() == 1).all()
    with pytest.raises(RuntimeError, match="two devices"):
        x + torch.zeros(3)
    with pytest.raises(RuntimeError, match="not supported"):
        x.numpy()


def whole_method(device):
    data = [recorded(seed=seed) for seed in range(4)]
    model = pretrained(data, device=device, guidance=1.0, kickstart=1.0)
    model.set_env(ClockEnv())
    return model.learn(60)


def close(here, there):
    """Whether two models have learned the same, up to rounding."""
    moved = {name: tensor.cpu() for name, tensor in weights(there).items()}
    torch.testing.assert_close(moved, weights(here), rtol=1e-4, atol=1e-5)
    return here.updates == there.updates


def test_another_device_learns_what_the_cpu_learns(other, tmp_path):
    here, there = whole_method("cpu"), whole_method(other)
    assert there.policy.device.type == other
    assert close(here, there)
    assert there.updates
    assert there.cloned
    assert all(tensor.device.type == other for tensor in weights(there).values())

    images, episode = noise(2), recorded(seed=9)
    for ours, theirs in (here, there), (here.prior, there.prior):
        actions = [x.predict(images, deterministic=True)[0] for x in (ours, theirs)]
        np.testing.assert_allclose(*actions, rtol=1e-4, atol=1e-5)
    dreams = [x.open_loop(episode, horizon=3).astype(int) for x in (here, there)]
    np.testing.assert_allclose(*dreams, atol=1)  # of 255: rounding

    there.save(tmp_path / "model.zip")
    loaded = WPT.load(tmp_path / "model.zip", device="cpu")
    assert close(loaded, there)
    back = WPT.load(tmp_path / "model.zip", device=other)
    assert back.policy.device.type == other


@pytest.mark.slow
@pytest.mark.parametrize("kind", [Plan2Explore, ICMExplorer])
def test_another_device_explores_as_the_cpu_does(other, kind):
    here, there = (explorer(kind, device=device).learn(60) for device in ("cpu", other))
    assert close(here, there)
    assert there.updates


def test_another_device_adds_up_gradients_as_the_cpu_does(other):
    data = [recorded(seed=seed) for seed in range(4)]
    here, there = (pretrained(data, accumulate=2, device=device) for device in ("cpu", other))
    assert close(here, there)


def test_another_device_promises_what_the_cpu_promises(other):
    played = recorded(length=12)
    played = replace(played, reward=np.ones(12, np.float32))
    here, there = (
        diagnosis.promises(agent(device=device).policy, played, 0.9, [0, 4], 2)
        for device in ("cpu", other)
    )
    for ours, theirs in zip(here, there, strict=True):
        assert astuple(theirs) == pytest.approx(astuple(ours), rel=1e-4, abs=1e-5)


def test_an_update_waits_for_the_device_once_a_network(other):
    model = agent(device=other, kickstart=1.0, return_norm=False)
    model.cloned = True
    model.replay_buffer.add(recorded())
    model.update(defaultdict(list))
    other_device.waits.clear()
    model.update(defaultdict(list))
    # each optimiser step first looks whether loss and gradient are finite
    assert +other_device.waits == {"aten._local_scalar_dense.default": 3}
