"""Linear probes of a world model's latents."""

import numpy as np
import pytest
from debug_agent import agent, recorded
from zoo_command import call

from wpt_agents.zoo.judge import probes
from wpt_agents.zoo.judge.probes import QUANTITIES, latents, probe, ridge_r2, watch
from wpt_agents.zoo.terminal import console

rng = np.random.default_rng(0)


def test_what_is_linear_in_the_features_is_read_off_and_noise_is_not():
    features, heldout = rng.normal(size=(400, 6)), rng.normal(size=(200, 6))
    weights = rng.normal(size=6)

    def targets(x):
        return np.stack([x @ weights + 3, rng.normal(size=len(x)), np.full(len(x), 2.0)], 1)

    linear, noise, constant = ridge_r2(features, targets(features), heldout, targets(heldout))
    assert linear > 0.99 and abs(noise) < 0.1 and np.isnan(constant)


def test_the_ridge_by_hand():
    # standardised features are -1 and 1, targets -2 and 2 around 1: x'x = 2, x't = 4, weight 4 / 3
    features, targets = np.array([[4.0], [6.0]]), np.array([[-1.0], [3.0]])
    (r2,) = ridge_r2(features, targets, features, targets, penalty=1.0)
    # predictions 1 -+ 4/3, errors 2/3 each: 1 - 2 (2/3)^2 / (2 * 2^2)
    assert r2 == pytest.approx(1 - (4 / 9) / 4, abs=1e-4)


@pytest.mark.parametrize(
    "task",
    ["dmc-cartpole-swingup", "dmc-walker-stand", "dmc-quadruped-walk", "metaworld-drawer-open"],
)
def test_the_states_are_those_of_the_images_and_vary(task):
    (episode,) = watch(f"wpt/{task}-v0", 1, seed=3)
    assert len(episode.state) == len(episode.trajectory.image)
    robot = {"dmc": task.split("-")[1], "metaworld": "sawyer"}[task.split("-")[0]]
    for name, of in QUANTITIES[robot].items():
        values = of(episode.state)
        assert np.isfinite(values).all(), name
        if not name.startswith("object"):
            assert values.std() > 1e-4, name
        if name.endswith(("cos", "sin", "upright")):
            assert np.abs(values).max() <= 1 + 1e-6, name


def test_a_model_is_probed_on_episodes_that_it_was_not_fitted_on():
    model = agent(max_action_dim=6)
    (episode,) = watch("wpt/dmc-walker-stand-v0", 1, seed=3)
    width = model.policy.size.deter + model.policy.size.stoch * model.policy.size.classes
    assert latents(model, episode.trajectory).shape == (501, width)
    probed = list(probe(model, ["wpt/dmc-walker-stand-v0"], episodes=2))
    assert [row["quantity"] for row in probed] == list(QUANTITIES["walker"])
    assert all(row["r2"] <= 1 for row in probed)


def test_the_command_probes_a_file_beside_an_untrained_model(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(console, "_width", 160)
    asked = []

    def short(task, episodes, seed, rendering):
        asked.append((task, episodes, seed, rendering))
        for episode in range(episodes):
            yield probes.Watched(recorded(8, seed=episode), rng.normal(size=(9, 24)))

    monkeypatch.setattr(probes, "watch", short)
    model = agent(max_action_dim=6)
    model.save(tmp_path / "model.zip")
    words = ["probe", tmp_path, "--tasks", "walker-run", "walker-stand"]  # the file's folder
    assert call(monkeypatch, *words, "--episodes", "2", "--device", "cpu") == 0
    tasks = ["wpt/dmc-walker-run-v0", "wpt/dmc-walker-stand-v0"]
    assert sorted(asked) == sorted((task, 2, 1000, "fast") for task in 2 * tasks)
    printed = capsys.readouterr().out
    assert "untrained" in printed and printed.count("torso height") == 2


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--suite", "robotics", "--tasks", "fetch-reach"], "no quantities to probe"),
        (["--tasks", "quadruped-walk"], "has 12 actions, the model takes at most 6"),
        (["--tasks", "walker-run", "--episodes", "1"], "--episodes"),
    ],
)
def test_what_cannot_be_probed_is_refused(words, message, tmp_path, monkeypatch, capsys):
    agent(max_action_dim=6).save(tmp_path / "model.zip")
    assert call(monkeypatch, "probe", tmp_path / "model.zip", *words) == 2
    assert message in capsys.readouterr().err
