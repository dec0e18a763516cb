import json

import gymnasium as gym
import numpy as np
import pytest

from wpt_agents.dataset import TrajectoryDataset
from wpt_agents.zoo import collect as module
from wpt_agents.zoo.collect import COLOURS, collect, coloured_noise, noise_actions, record

gym.register("PlainDot-v0", entry_point="toy_env:DotEnv")
gym.register("WideDot-v0", entry_point="toy_env:DotEnv", kwargs={"actions": 3})
DOT, WIDE = f"{__name__}:PlainDot-v0", f"{__name__}:WideDot-v0"  # importable from a fresh process


def same(ours, theirs):
    return all(
        np.array_equal(a.image, b.image) and np.array_equal(a.action, b.action)
        for a, b in zip(ours, theirs, strict=True)
    )


def autocorrelation(noise, lag):
    return np.mean(noise[lag:] * noise[:-lag]) / np.mean(noise**2)


@pytest.mark.parametrize("colour", COLOURS)
def test_every_colour_of_noise_has_unit_variance(colour):
    rng = np.random.default_rng(0)
    noise = np.stack([coloured_noise(rng, colour, 1000, 4) for _ in range(50)])
    assert noise.shape == (50, 1000, 4)
    assert noise.var() == pytest.approx(1, abs=0.1)


@pytest.mark.parametrize(
    ("colour", "expected"), [("white", 0), ("ou-4", np.exp(-1)), ("ou-16", np.exp(-1 / 4))]
)
def test_noise_is_correlated_over_as_many_steps_as_its_name_says(colour, expected):
    noise = coloured_noise(np.random.default_rng(0), colour, 100_000, 1)
    assert autocorrelation(noise, 4) == pytest.approx(expected, abs=0.03)


def test_the_power_of_pink_noise_falls_as_one_over_frequency():
    noise = coloured_noise(np.random.default_rng(0), "pink", 2**16, 1)[:, 0]
    power = np.abs(np.fft.rfft(noise)) ** 2
    octaves = [power[2**k : 2 ** (k + 1)].mean() for k in range(6, 15)]
    slope = np.polyfit(np.arange(6, 15), np.log2(octaves), 1)[0]
    assert slope == pytest.approx(-1, abs=0.1)


def test_actions_differ_between_episodes_and_stay_in_the_box():
    rng = np.random.default_rng(0)
    acts, names = zip(*(noise_actions(rng, 3, 100) for _ in range(40)), strict=True)
    actions = np.array([[act(None, {}, t) for t in range(100)] for act in acts])
    assert np.abs(actions).max() == 1
    assert {name.split(" noise")[0] for name in names} == set(COLOURS)


def test_data_are_a_function_of_the_seed_whatever_the_workers(tmp_path):
    one = collect(tmp_path / "one", [DOT, WIDE], 6, seed=3, workers=1, progress_bar=False)
    two = collect(tmp_path / "two", [DOT, WIDE], 6, seed=3, workers=2, progress_bar=False)
    assert len(one) == 12
    assert same(one, two)


def test_another_seed_gives_other_data(tmp_path):
    one = collect(tmp_path / "one", [DOT], 2, seed=0, workers=1, progress_bar=False)
    two = collect(tmp_path / "two", [DOT], 2, seed=1, workers=1, progress_bar=False)
    assert not np.array_equal(one[0].image[0], two[0].image[0])
    assert not np.array_equal(one[0].image[0], one[1].image[0])


def test_an_episode_does_not_depend_on_the_other_tasks(tmp_path):
    alone = collect(tmp_path / "alone", [WIDE], 2, workers=1, progress_bar=False)
    second = collect(tmp_path / "second", [DOT, WIDE], 2, workers=1, progress_bar=False)
    assert same(alone, second.subset([2, 3]))


def test_trajectories_have_no_rewards_and_their_own_width(tmp_path):
    data = collect(tmp_path / "data", [DOT, WIDE], 1, workers=1, progress_bar=False)
    assert [t.reward for t in data] == [None, None]
    assert [t.action_dim for t in data] == [2, 3]
    assert [t.task for t in data] == [DOT, WIDE]
    assert all("noise" in t.source for t in data)


def test_the_stored_actions_lead_to_the_stored_images(tmp_path):
    (stored,) = collect(tmp_path / "data", [DOT], 1, seed=5, workers=1, progress_bar=False)
    entropy = [5, module.zlib.crc32(DOT.encode()), 0]
    seed = int(np.random.SeedSequence(entropy).generate_state(1)[0])
    replayed = record(gym.make(DOT), lambda obs, info, t: stored.action[t], seed)
    assert np.array_equal(replayed.image, stored.image)


def test_half_a_dataset_is_continued_to_the_same_data(tmp_path, monkeypatch):
    whole = collect(tmp_path / "whole", [DOT, WIDE], 6, workers=1, progress_bar=False)
    jobs, play = [], module.play

    def dying(job):
        jobs.append(job)
        if len(jobs) == 3:
            raise KeyboardInterrupt
        return play(job)

    monkeypatch.setattr(module, "play", dying)
    with pytest.raises(KeyboardInterrupt):
        collect(tmp_path / "half", [DOT, WIDE], 6, workers=1, progress_bar=False)
    assert 0 < len(TrajectoryDataset.open(tmp_path / "half")) < 12
    half = collect(tmp_path / "half", [DOT, WIDE], 6, workers=1, progress_bar=False)
    assert same(whole, half)


def test_a_finished_dataset_is_returned_without_playing(tmp_path, monkeypatch):
    collect(tmp_path / "data", [DOT], 2, workers=1, progress_bar=False)
    monkeypatch.setattr(module, "play", lambda job: pytest.fail("played again"))
    assert len(collect(tmp_path / "data", [DOT], 2, workers=1, progress_bar=False)) == 2


def test_a_folder_with_other_settings_is_refused(tmp_path):
    collect(tmp_path / "data", [DOT], 1, workers=1, progress_bar=False)
    with pytest.raises(ValueError, match=r"different: episodes, seed.*another path"):
        collect(tmp_path / "data", [DOT], 2, seed=1, workers=1, progress_bar=False)


def test_a_dataset_that_collect_did_not_make_is_left_alone(tmp_path):
    collect(tmp_path / "data", [DOT], 1, workers=1, progress_bar=False)
    (tmp_path / "data" / "collect.json").unlink()
    with pytest.raises(ValueError, match="holds something else"):
        collect(tmp_path / "data", [DOT], 2, workers=1, progress_bar=False)


def test_the_label_tells_how_to_make_the_data_again(tmp_path):
    collect(tmp_path / "data", [DOT], 1, seed=7, workers=1, progress_bar=False)
    told = json.loads((tmp_path / "data" / "collect.json").read_text())
    assert (told["tasks"], told["episodes"], told["seed"]) == ([DOT], 1, 7)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"tasks": []}, "different tasks"),
        ({"tasks": [DOT, DOT]}, "different tasks"),
        ({"episodes": 0}, "at least 1 episode"),
        ({"behaviour": "expert"}, "There are: noise, scripted"),
        ({"behaviour": "scripted"}, "Meta-World's tasks only"),
    ],
)
def test_what_cannot_be_collected_is_refused_before_anything_is_written(tmp_path, given, message):
    with pytest.raises(ValueError, match=message):
        collect(tmp_path / "data", **({"tasks": [DOT], "episodes": 1} | given))
    assert not (tmp_path / "data").exists()


def test_scripts_are_noised_from_episode_to_episode(tmp_path):
    task, env = "wpt/metaworld-reach-v0", {"rendering": "fast"}
    data = collect(tmp_path, [task], 2, 0, 1, "scripted", env, progress_bar=False)
    assert [t.source for t in data] == [f"scripted policy, sigma {s}" for s in (0.1, 0.3)]
    assert [len(t) for t in data] == [100, 100]
    roughness = [np.abs(np.diff(t.action[:, 3])).mean() for t in data]  # the gripper's
    assert roughness[0] < roughness[1]
