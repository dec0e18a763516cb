import json
import zlib
from collections import Counter
from functools import partial

import gymnasium as gym
import numpy as np
import pytest
from debug_agent import SETTINGS, ClockEnv, agent
from stable_baselines3 import SAC
from zoo_command import call

from wpt_agents.agents.curious import EXPLORE, Plan2Explore
from wpt_agents.data.dataset import TrajectoryDataset
from wpt_agents.zoo.collect import collection as module
from wpt_agents.zoo.collect.behaviours import COLOURS, coloured_noise, noise_actions
from wpt_agents.zoo.collect.collection import collect
from wpt_agents.zoo.collect.curious import Expedition, explore
from wpt_agents.zoo.collect.episodes import Recipe, make_env, record
from wpt_agents.zoo.collect.policies import SavedPolicy, sees_states

pytestmark = pytest.mark.slow  # it runs simulators or whole runs

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
    entropy = [5, zlib.crc32(DOT.encode()), 0]
    seed = int(np.random.SeedSequence(entropy).generate_state(1)[0])
    replayed = record(gym.make(DOT), lambda obs, info, t: stored.action[t], seed)
    assert np.array_equal(replayed.image, stored.image)


def test_one_task_needs_no_list(tmp_path):
    data = collect(tmp_path / "data", DOT, 1, workers=1, progress_bar=False)
    assert data.tasks == [DOT]


@pytest.mark.parametrize(
    ("low", "high", "dtype"),
    [
        ([0, -5], [10, 5], np.int32),
        ([-0.3, 2.0], [0.7, 2.0], np.float32),  # the second is always 2
        ([-0.1, 0.0], [0.2, 0.1], np.float64),
    ],
)
def test_actions_stay_within_the_bounds_of_any_task(low, high, dtype):
    space = gym.spaces.Box(np.array(low, dtype), np.array(high, dtype), dtype=dtype)
    taken = []

    class Bounded(ClockEnv):
        def step(self, action):
            assert self.action_space.contains(action), action
            taken.append(action)
            return super().step(action)

    def make():
        env = Bounded()
        env.action_space = space
        return env

    gym.register("Bounded-v0", entry_point=make, disable_env_checker=True)
    try:
        env = make_env("Bounded-v0", Recipe())
    finally:
        del gym.registry["Bounded-v0"]
    assert env.action_space == gym.spaces.Box(-1, 1, (2,), np.float32)
    ends = np.array([[-1, 1], [1, -1], [0.1, 0.9]], np.float32)
    record(env, lambda obs, info, t: ends[t % 3], seed=0)
    assert np.array_equal(taken[0], [space.low[0], space.high[1]])
    assert np.array_equal(taken[1], [space.high[0], space.low[1]])


def test_tasks_of_discrete_actions_are_refused_with_the_line_that_converts_them(tmp_path):
    with pytest.raises(ValueError, match=r"takes Discrete\(2\): wrap it so that"):
        collect(tmp_path / "data", "CartPole-v1", 1, workers=1, progress_bar=False)


class Careless(gym.Wrapper):
    """Draws every image into the same array, and scales actions in place."""

    def reset(self, **kwargs):
        image, info = self.env.reset(**kwargs)
        self.image = image.copy()
        return self.image, info

    def step(self, action):
        self.image[:], *outcome = self.env.step(action)
        action *= 0.5
        return self.image, *outcome


def test_a_recording_keeps_what_an_environment_overwrites():
    def act(obs, info, t):
        return np.array([0.5, -0.5], np.float32)

    careless, careful = (record(env, act, 0) for env in (Careless(gym.make(DOT)), gym.make(DOT)))
    assert np.array_equal(careless.image, careful.image)
    assert np.array_equal(careless.action, careful.action)


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


def test_what_another_process_has_collected_meanwhile_is_not_collected_again(tmp_path, monkeypatch):
    opened = module._open

    def opened_long_before(path, description):
        dataset = opened(path, description)
        monkeypatch.setattr(module, "_open", opened)
        collect(tmp_path, [DOT], 3)  # the other process, from beginning to end
        return dataset

    monkeypatch.setattr(module, "_open", opened_long_before)
    assert len(collect(tmp_path, [DOT], 3)) == 3
    assert TrajectoryDataset.open(tmp_path).appended == 3


def test_more_episodes_than_were_to_be_collected_are_refused(tmp_path):
    with collect(tmp_path, [DOT], 2) as dataset:
        dataset.append(dataset[0])
    with pytest.raises(ValueError, match="holds 3 episodes, more than the 2"):
        collect(tmp_path, [DOT], 2)


def test_a_finished_dataset_is_returned_without_playing(tmp_path, monkeypatch):
    collect(tmp_path / "data", [DOT], 2, workers=1, progress_bar=False)
    monkeypatch.setattr(module, "play", lambda job: pytest.fail("played again"))
    assert len(collect(tmp_path / "data", [DOT], 2, workers=1, progress_bar=False)) == 2


def test_a_set_aside_episode_is_not_played_again(tmp_path, monkeypatch):
    dataset = collect(tmp_path / "data", [DOT], 3, workers=1, progress_bar=False)
    shard = next(dataset.path.glob("shard-*.bin"))
    shard.write_bytes(shard.read_bytes()[:-50])  # the last episode's end
    assert len(dataset.validate(set_aside=True)) == 1
    assert (len(dataset), dataset.appended) == (2, 3)
    monkeypatch.setattr(module, "play", lambda job: pytest.fail("played again"))
    assert len(collect(tmp_path / "data", [DOT], 3, workers=1, progress_bar=False)) == 2


def killed(*_):
    raise KeyboardInterrupt


@pytest.mark.parametrize("where", ["wpt_agents.data.index", "wpt_agents.zoo.collect.collection"])
def test_a_collection_killed_while_its_folder_is_made_goes_on(tmp_path, monkeypatch, where):
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(f"{where}.replacing", killed)  # no meta.json yet, or no collect.json yet
        collect(tmp_path / "half", [DOT], 1, workers=1, progress_bar=False)
    assert (tmp_path / "half" / "index.jsonl").exists()
    half = collect(tmp_path / "half", [DOT], 1, workers=1, progress_bar=False)
    assert same(half, collect(tmp_path / "whole", [DOT], 1, workers=1, progress_bar=False))


def test_a_label_killed_halfway_is_not_there(tmp_path, monkeypatch):
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr("wpt_agents.files.archive.os.fsync", killed)
        module._open(created(tmp_path / "half"), {"tasks": [DOT]})
    assert not (tmp_path / "half" / "collect.json").exists()
    assert len(module._open(tmp_path / "half", {"tasks": [DOT]})) == 0


def created(path):
    return TrajectoryDataset.create(path).path


def test_a_damaged_label_is_named(tmp_path):
    collect(tmp_path / "data", [DOT], 1, workers=1, progress_bar=False)
    (tmp_path / "data" / "collect.json").write_text('{"tasks": [')
    with pytest.raises(ValueError, match=r"collect\.json is damaged .*another path"):
        collect(tmp_path / "data", [DOT], 1, workers=1, progress_bar=False)


def test_a_folder_of_something_else_is_not_collected_into(tmp_path):
    (tmp_path / "thesis.txt").write_text("precious")
    with pytest.raises(ValueError, match="is not empty"):
        collect(tmp_path, [DOT], 1, workers=1, progress_bar=False)
    assert [p.name for p in tmp_path.iterdir()] == ["thesis.txt"]


def test_a_folder_with_other_settings_is_refused(tmp_path):
    collect(tmp_path / "data", [DOT], 1, workers=1, progress_bar=False)
    with pytest.raises(ValueError, match=r"different: episodes, seed.*another path"):
        collect(tmp_path / "data", [DOT], 2, seed=1, workers=1, progress_bar=False)


def test_a_collection_that_failed_without_an_episode_can_be_corrected(tmp_path):
    with pytest.raises(gym.error.Error, match="none"):
        collect(tmp_path / "data", ["wpt/none-v0"], 1, workers=1, progress_bar=False)
    dataset = collect(tmp_path / "data", [DOT], 1, workers=1, progress_bar=False)
    assert len(dataset) == 1 and dataset.tasks == [DOT]


def test_a_dataset_that_collect_did_not_make_is_left_alone(tmp_path):
    collect(tmp_path / "data", [DOT], 1, workers=1, progress_bar=False)
    (tmp_path / "data" / "collect.json").unlink()
    with pytest.raises(ValueError, match="contains another collection"):
        collect(tmp_path / "data", [DOT], 2, workers=1, progress_bar=False)


def test_the_label_tells_how_to_make_the_data_again(tmp_path):
    collect(tmp_path / "data", [DOT], 1, seed=7, workers=1, progress_bar=False)
    label = json.loads((tmp_path / "data" / "collect.json").read_text())
    assert (label["tasks"], label["episodes"], label["seed"]) == ([DOT], 1, 7)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"tasks": []}, "different tasks"),
        ({"tasks": [DOT, DOT]}, "different tasks"),
        ({"episodes": 0}, "at least 1 episode"),
        ({"behaviour": "noize"}, "Did you mean 'noise'"),
        ({"behaviour": "policy"}, "which needs it"),
        ({"policy": "a.zip"}, "belongs to the behaviour 'policy'"),
        ({"behaviour": "policy", "policy": "no.zip"}, r"No policy no\.zip"),
        ({"behaviour": "policy", "policy": "sacc:no.zip"}, "Did you mean 'sac'"),
        ({"behaviour": "scripted"}, "Meta-World's tasks only"),
        ({"sigmas": [0.5]}, r"sigmas \(--sigma\) have no effect on the behaviour 'noise'"),
        ({"sigmas": [0.5, -0.5]}, r"numbers of at least 0, got \[0.5, -0.5\]"),
        ({"sigmas": [float("nan")]}, "numbers of at least 0"),
        ({"sigmas": []}, "numbers of at least 0"),
        ({"behaviour": "icm", "sigmas": [0.5]}, "take scripted or policy"),
        ({"settings": {"gamma": 0.9}}, r"settings \(--set\) have no effect on .* 'noise'"),
        (
            {
                "behaviour": "scripted",
                "tasks": ["wpt/metaworld-reach-v0"],
                "settings": {"steps": 9},
            },
            "explore-state",
        ),
    ],
)
def test_what_cannot_be_collected_is_refused_before_anything_is_written(
    tmp_path, arguments, message
):
    with pytest.raises(ValueError, match=message):
        collect(tmp_path / "data", **({"tasks": [DOT], "episodes": 1} | arguments))
    assert not (tmp_path / "data").exists()


def test_scripts_are_noised_from_episode_to_episode(tmp_path):
    task, env = "wpt/metaworld-reach-v0", {"rendering": "fast"}
    data = collect(tmp_path, [task], 2, 0, 1, "scripted", env, progress_bar=False)
    assert [t.source for t in data] == [f"scripted policy, sigma {s}" for s in (0.1, 0.3)]
    assert [len(t) for t in data] == [100, 100]
    roughness = [np.abs(np.diff(t.action[:, 3])).mean() for t in data]  # the gripper's
    assert roughness[0] < roughness[1]


# Saved policies


def test_a_saved_policy_is_noised_from_episode_to_episode(tmp_path):
    model = agent(gym.make(DOT), embodiment="dot")
    model.save(tmp_path / "dot.zip")
    arguments = {"behaviour": "policy", "policy": str(tmp_path / "dot.zip"), "sigmas": [0.0, 0.5]}
    data = collect(tmp_path / "data", [DOT], 3, workers=1, progress_bar=False, **arguments)
    names = [f"policy dot.zip, sigma {sigma}" for sigma in (0.0, 0.5, 0.0)]
    assert [t.source for t in data] == names
    env, state = gym.make(DOT), None
    seed = int(np.random.SeedSequence([0, zlib.crc32(DOT.encode()), 0]).generate_state(1)[0])
    obs, _ = env.reset(seed=seed)
    for step in range(3):  # without noise it is what `predict` says
        action, state = model.predict(obs, state, np.array([step == 0]), deterministic=True)
        np.testing.assert_allclose(data[0].action[step], action, atol=1e-6)
        obs = env.step(action)[0]
    roughness = [np.abs(np.diff(t.action, axis=0)).mean() for t in data]
    assert roughness[1] > roughness[0]


def test_a_policy_of_sb3_that_takes_states_is_shown_states_and_rescaled(tmp_path):
    space = gym.spaces.Box(-3.0, 3.0, (2,))  # twice and more of the task's [-1, 1]
    model = SAC("MlpPolicy", StateEnv(space), learning_starts=0, buffer_size=10, device="cpu")
    model.save(tmp_path / "sac.zip")
    name = f"sac:{tmp_path / 'sac.zip'}"
    assert sees_states(name)
    act = SavedPolicy(np.random.default_rng(0), name, 0.0, 2)
    expected = model.predict(np.ones(5, np.float32), deterministic=True)[0] / 3
    np.testing.assert_allclose(act(None, {"state": np.ones(5)}, 0), expected, atol=1e-6)
    with pytest.raises(ValueError, match="the task takes 6 actions; pass a policy of this robot"):
        SavedPolicy(np.random.default_rng(0), name, 0.0, 6)


@pytest.mark.filterwarnings("ignore:.*maximum and minimum values are equal")
def test_a_saved_policy_of_an_action_that_is_fixed_collects_numbers(tmp_path):
    env = ClockEnv()
    env.action_space = gym.spaces.Box(np.float32([2, -1]), np.float32([2, 1]))
    agent(env).save(tmp_path / "fixed.zip")
    act = SavedPolicy(np.random.default_rng(0), str(tmp_path / "fixed.zip"), 0.1, 2)
    taken = [act(env.reset()[0], {}, step) for step in range(2)]
    assert np.isfinite(taken).all() and np.abs(taken).max() <= 1


class StateEnv(gym.Env):
    observation_space = gym.spaces.Box(-np.inf, np.inf, (5,), np.float32)

    def __init__(self, action_space):
        self.action_space = action_space


def test_rewards_are_stored_if_asked_for(tmp_path):
    (stored,) = collect(tmp_path, [DOT], 1, workers=1, progress_bar=False, rewards=True)
    env = gym.make(DOT).unwrapped
    env.reset(seed=0)
    assert stored.reward is not None and stored.reward.shape == (25,)


def test_uniform_actions_are_a_behaviour(tmp_path):
    data = collect(tmp_path, [DOT], 8, workers=1, progress_bar=False, behaviour="random")
    actions = np.concatenate([t.action for t in data])
    assert np.abs(actions).max() <= 1
    assert actions.std() == pytest.approx(3**-0.5, abs=0.03)
    assert {t.source for t in data} == {"uniform random actions"}


# Curiosity

QUICK = {k: v for k, v in SETTINGS.items() if k in EXPLORE} | {"imagine_horizon": 3}
QUICK |= {"offline_ratio": 0.0, "guidance": 0.0}


def curious(path, tasks=(DOT, WIDE), workers=1, behaviour="plan2explore", episodes=3):
    return collect(path, tasks, episodes, 1, workers, behaviour, progress_bar=False, settings=QUICK)


@pytest.fixture(scope="module")
def explored(tmp_path_factory):
    return curious(tmp_path_factory.mktemp("explored") / "data")


def test_curious_agents_play_task_by_task_without_rewards(explored):
    assert explored.tasks == [DOT] * 3 + [WIDE] * 3
    assert explored.action_dims.tolist() == [2] * 3 + [3] * 3
    assert [t.reward for t in explored] == [None] * 6
    assert explored[4].source == "plan2explore, episode 2"
    assert not list(explored.path.glob("exploring-*"))


def test_curious_agents_play_the_same_in_processes_of_their_own(explored, tmp_path):
    assert same(explored, curious(tmp_path / "two", workers=2))


@pytest.mark.parametrize("stop_at", [2, 4])
def test_a_curious_agent_that_was_stopped_goes_on_to_the_same_data(
    explored, tmp_path, monkeypatch, stop_at
):
    saved, save = [], Plan2Explore.save

    def dying(model, path):
        saved.append(path)
        if len(saved) == stop_at:  # the episode is stored, the model is not
            raise KeyboardInterrupt
        save(model, path)

    monkeypatch.setattr(Plan2Explore, "save", dying)
    with pytest.raises(KeyboardInterrupt):
        curious(tmp_path)
    assert len(TrajectoryDataset.open(tmp_path)) == 3 * ((stop_at - 1) // 3)
    monkeypatch.setattr(Plan2Explore, "save", save)
    assert same(explored, curious(tmp_path))


def test_a_curious_agent_whose_episodes_terminate_goes_on_to_the_same_data(tmp_path):
    settings = QUICK | {"train_ratio": 4, "learning_starts": 0, "warmup_steps": 0}
    for name, parts in (("whole", [4]), ("stopped", [2, 4])):
        for episodes in parts:
            make = partial(ClockEnv, terminates=True)
            list(explore(Expedition(DOT, episodes, 0, "icm", tmp_path / name, make, settings)))
    whole, stopped = (TrajectoryDataset.open(tmp_path / n / "data") for n in ("whole", "stopped"))
    assert whole[3].terminated and same(whole, stopped)


def test_a_curious_agent_killed_while_its_folder_is_made_goes_on(tmp_path):
    trip = Expedition(DOT, 1, 1, "plan2explore", tmp_path, lambda: gym.make(DOT), QUICK)
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "index.jsonl").touch()  # and no meta.json
    assert list(explore(trip)) == [1]


# The paper's split


def test_by_default_the_papers_meta_world_data_are_collected(tmp_path, monkeypatch):
    asked = []
    monkeypatch.setattr(
        module, "collect", lambda *arguments, **more: asked.append((arguments, more)) or stop()
    )
    call(monkeypatch, "collect", "--suite", "metaworld", "--out", tmp_path)
    [((_, tasks, number, seed, _, behaviour, _), more)] = asked
    assert (len(tasks), number, seed, behaviour) == (50, 1000, 0, "scripted")
    plan = Recipe(sigmas=tuple(more["sigmas"]))
    count = Counter(plan.sigma(episode) for episode in range(number))
    assert count == {0.1: 200, 0.3: 200, 0.5: 200, 1.0: 200, 2.0: 200}
    assert not more["rewards"]


def stop():
    raise StopIteration


def test_the_command_collects_with_what_it_is_given(tmp_path, monkeypatch):
    words = ["--tasks", "walker-stand", "--behaviour", "icm", "--episodes", 7]
    asked = []
    monkeypatch.setattr(
        module, "collect", lambda *arguments, **more: asked.append((arguments, more)) or stop()
    )
    call(monkeypatch, "collect", "--out", tmp_path, *words, "--set", "size=debug", "gamma=0.9")
    [((_, tasks, episodes, _, _, behaviour, _), more)] = asked
    assert (tasks, episodes, behaviour) == (["wpt/dmc-walker-stand-v0"], 7, "icm")
    assert more["settings"] == {"size": "debug", "gamma": 0.9}
