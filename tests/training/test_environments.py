"""The doors to `set_env`: ids, functions, lists, vectors of Gymnasium, foreign VecEnvs."""

import subprocess
import sys

import gymnasium as gym
import numpy as np
import pytest
from clock_episodes import all_on_time, learnt, stored
from debug_agent import ClockEnv, agent, noise, on_time
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv, VectorEnv, VectorWrapper
from stable_baselines3.common.callbacks import BaseCallback, EvalCallback, EveryNTimesteps
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from wpt_agents.agents.wpt import WPT
from wpt_agents.training.environments import as_vec_env

FORK = pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")


# ---------------------------------------------------------------------------- what is accepted


@pytest.mark.parametrize(
    ("door", "n_envs"),
    [
        (ClockEnv, 1),
        (lambda: ClockEnv(), 1),
        (ClockEnv(), 1),
        (EnvSpec("Clock-v0", entry_point=ClockEnv, max_episode_steps=7), 1),
        ([ClockEnv(), ClockEnv()], 2),
        ((ClockEnv, ClockEnv, ClockEnv), 3),
        (DummyVecEnv([ClockEnv, ClockEnv]), 2),
        (make_vec_env(ClockEnv, n_envs=2), 2),
    ],
)
def test_one_environment_or_several_are_taken_however_they_come(door, n_envs):
    model = learnt(door)
    assert model.n_envs == n_envs and all_on_time(model, 6)
    assert len(model.ep_info_buffer) == 6 or isinstance(door, DummyVecEnv)


@FORK
@pytest.mark.parametrize("mode", AutoresetMode)
@pytest.mark.parametrize("kind", [SyncVectorEnv, AsyncVectorEnv])
@pytest.mark.parametrize("terminates", [True, False])
def test_vectors_of_gymnasium_store_every_image_in_its_place(kind, mode, terminates):
    lengths = (7, 5)
    vector = kind(
        [lambda n=n: ClockEnv(n, terminates) for n in lengths], autoreset_mode=mode, copy=False
    )
    model = learnt(vector, 70)  # 35 of each: 5 episodes of 7, 7 of 5
    model.get_env().close()
    for length, count in zip(lengths, (5, 7), strict=True):
        episodes = [episode for episode in stored(model) if len(episode) == length]
        assert len(episodes) == count and all(on_time(episode, length) for episode in episodes)
    assert {episode.terminated for episode in stored(model)} == {terminates}
    infos = [(episode["l"], episode["r"]) for episode in model.ep_info_buffer]
    assert set(infos) == {(7, 28.0), (5, 15.0)} and all(model.ep_success_buffer)


def test_gyms_make_vec_is_taken_with_its_default_and_with_updates_meanwhile():
    gym.register("Clock-v0", entry_point=ClockEnv, max_episode_steps=7)
    vector = gym.make_vec("Clock-v0", num_envs=2, vectorization_mode="sync")
    model = agent(vector, learning_starts=0, train_ratio=4, train_freq="step").learn(42)
    del gym.registry["Clock-v0"]
    assert all_on_time(model, 6) and model.updates > 10


def test_the_seeds_of_a_vector_count_up_from_the_agents_own():
    class Dice(ClockEnv):
        def reset(self, *, seed=None, options=None):
            self.seed = seed
            return super().reset(seed=seed)

    vector = SyncVectorEnv([Dice, Dice])
    agent(vector, seed=5).learn(1)
    assert [env.unwrapped.seed for env in vector.envs] == [5, 6]


def test_options_of_a_reset_reach_the_environments_of_a_vector_once():
    class Choosy(ClockEnv):
        def reset(self, *, seed=None, options=None):
            self.options = options
            return super().reset(seed=seed)

    vector = SyncVectorEnv([Choosy, Choosy])
    env = as_vec_env(vector)
    for options in ({"level": 3}, None):
        env.set_options(options)
        env.reset()
        assert [env.unwrapped.options for env in vector.envs] == [options] * 2
    env.set_options([{"level": 1}, {"level": 2}])
    with pytest.raises(ValueError, match="same options for all"):
        env.reset()


def test_an_attribute_of_a_vector_is_set_to_the_same_value_everywhere():
    vector = SyncVectorEnv([ClockEnv, ClockEnv])
    env = as_vec_env(vector)
    env.set_attr("target", [1, 2])
    assert env.get_attr("target") == [env.unwrapped.target for env in vector.envs] == [[1, 2]] * 2


def test_a_method_of_a_vector_is_returned_and_not_called():
    vector = SyncVectorEnv([ClockEnv, ClockEnv])
    env = as_vec_env(vector)
    env.reset()
    env.step(np.zeros((2, 2), np.float32))
    assert env.has_attr("reset") and callable(env.get_attr("reset", indices=[1])[0])
    assert [env.unwrapped.time for env in vector.envs] == [1, 1]


@pytest.mark.parametrize("mode", AutoresetMode)
def test_the_info_of_each_reset_of_a_vector_is_kept(mode):
    class Counting(ClockEnv):
        resets = 0

        def reset(self, *, seed=None, options=None):
            self.resets += 1
            return super().reset(seed=seed)[0], {"resets": self.resets}

    env = as_vec_env(SyncVectorEnv([lambda: Counting(2), lambda: Counting(3)], autoreset_mode=mode))
    env.reset()
    counts = []
    for _ in range(4):
        *_, infos = env.step(np.zeros((2, 2), np.float32))
        counts.append([info["resets"] for info in env.unwrapped.reset_infos])
        assert not any("resets" in info for info in infos)
    assert counts == [[1, 1], [2, 1], [2, 2], [3, 2]]


def test_a_vector_whose_reset_takes_no_options_is_not_handed_any():
    class Plain(SyncVectorEnv):
        def reset(self, *, seed=None):
            return super().reset(seed=seed)

    assert as_vec_env(Plain([ClockEnv])).reset().shape == (1, 64, 64, 3)


class Own(VectorEnv):
    """A vector environment of two clocks that are stepped in its own code."""

    def __init__(self, mode):
        self.num_envs, self.clocks = 2, [ClockEnv(), ClockEnv()]
        self.metadata = {} if mode is None else {"autoreset_mode": mode}
        self.single_observation_space = ClockEnv.observation_space
        self.single_action_space = self.clocks[0].action_space

    def reset(self, *, seed=None, options=None):
        return np.stack([clock.reset()[0] for clock in self.clocks]), {}

    def step(self, actions):
        steps = [clock.step(action) for clock, action in zip(self.clocks, actions, strict=True)]
        image, reward, over, late, _ = map(np.stack, zip(*steps, strict=True))
        if not late.any():
            return image, reward, over, late, {}
        return self.reset()[0], reward, over, late, {"final_obs": image}


def test_somebodys_own_vector_is_taken_if_it_resets_in_the_same_step():
    assert all_on_time(learnt(Own(AutoresetMode.SAME_STEP)), 6)
    assert all_on_time(learnt(VectorWrapper(Own(AutoresetMode.SAME_STEP))), 6)
    with pytest.raises(ValueError, match=r"Own resets in the step after .*SAME_STEP"):
        agent(Own(AutoresetMode.NEXT_STEP))
    with pytest.raises(ValueError, match=r"Own has no autoreset_mode.*SAME_STEP"):
        agent(Own(None))


@FORK
def test_workers_without_shared_memory_are_taken_in_the_mode_that_the_refusal_names():
    keywords = {"num_envs": 2, "vectorization_mode": "async"}
    gym.register("Clock-v0", entry_point=ClockEnv, max_episode_steps=7)
    vector = gym.make_vec("Clock-v0", **keywords, vector_kwargs={"shared_memory": False})
    with pytest.raises(ValueError, match="not by a mask: make it with vector_kwargs") as refusal:
        agent(vector)
    vector.close()
    line = str(refusal.value).split("make it with vector_kwargs=")[1]
    options = eval(line, {"gymnasium": gym}) | {"shared_memory": False}
    vector = gym.make_vec("Clock-v0", **keywords, vector_kwargs=options)
    del gym.registry["Clock-v0"]
    model = learnt(vector)
    vector.close()
    assert all_on_time(model, 6)


# --------------------------------------------------------------------------- what is refused


class Bare:
    """A dm_env of nothing that Shimmy knows."""

    def action_spec(self): ...

    observation_spec = reset = step = action_spec


@pytest.mark.parametrize(
    ("door", "words"),
    [
        ([], "An empty list"),
        ([env := ClockEnv(), env], r"same environment twice.*for _ in range\(4\)"),
        ([ClockEnv(), ClockEnv(actions=3)], r"one action_space: number 0 has .* number 1"),
        (3, "This int is not an environment: pass an id, a Gymnasium environment, a function"),
        ({"env": ClockEnv()}, "This dict is not an environment"),
        (lambda: None, "This NoneType is not an environment"),
        (Bare(), "This Bare is a dm_env. Write a gymnasium.Env around it, as Shimmy"),
    ],
)
def test_what_is_no_environment_is_refused_by_what_it_is(door, words):
    with pytest.raises(ValueError, match=words):
        agent(door)


def test_a_bare_dm_env_is_refused_with_the_line_that_wraps_it():
    import shimmy
    import wpt_envs
    from dm_control import suite

    env = suite.load("cartpole", "balance")
    with pytest.raises(ValueError, match=r"Environment is a dm_env\. Wrap") as refusal:
        agent(env)
    line = str(refusal.value).split("`env = ")[1].rstrip("`")
    env = eval(line, {"wpt_envs": wpt_envs, "shimmy": shimmy, "env": env})
    assert agent(env).learn(2).num_timesteps == 2
    env.close()


def test_an_id_of_ours_needs_no_import_and_a_strangers_says_which():
    code = (
        "import sys; from wpt_agents.training.environments import make; "
        "assert 'wpt_envs' not in sys.modules; "
        "print(make('wpt/dmc-cartpole-balance-v0').observation_space.shape)"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert run.stdout.strip() == "(64, 64, 3)", run.stderr
    with pytest.raises(gym.error.NamespaceNotFound, match="'package:nobody/Thing-v0'"):
        agent("nobody/Thing-v0")
    with pytest.raises(gym.error.NameNotFound, match="walker-run"):
        agent("wpt/dmc-walker-rum-v0")


# --------------------------------------------------------------------------- Dict observations


class Cameras(ClockEnv):
    """The clock as entries of a dictionary."""

    def __init__(self, *names):
        super().__init__()
        boxes = {name: ClockEnv.observation_space for name in names}
        self.observation_space = spaces.Dict(arm=spaces.Box(-1, 1, (7,)), **boxes)
        self.names = names

    def _seen(self, image):
        images = {name: image + place for place, name in enumerate(self.names)}
        return {"arm": np.zeros(7, np.float32), **images}

    def reset(self, **kwargs):
        image, info = super().reset(**kwargs)
        return self._seen(image), info

    def step(self, action):
        image, *rest = super().step(action)
        return self._seen(image), *rest


@FORK
@pytest.mark.filterwarnings("default:Of the Dict")
@pytest.mark.parametrize(
    "wrap",
    [
        lambda make: make(),
        lambda make: DummyVecEnv([make, make]),
        lambda make: SyncVectorEnv([make, make], autoreset_mode="SameStep"),
        lambda make: AsyncVectorEnv([make, make]),
    ],
)
def test_the_only_image_of_a_dictionary_is_seen_and_the_warning_names_it(wrap):
    with pytest.warns(UserWarning, match="agent sees 'top', not 'arm'"):
        model = learnt(wrap(lambda: Cameras("top")))
    assert all_on_time(model, 6)
    model.get_env().close()


@pytest.mark.filterwarnings("ignore:Of the Dict", "ignore:Evaluation environment")
def test_prediction_and_evaluation_take_the_dictionary_too():
    model = learnt(Cameras("top"))
    obs = Cameras("top").reset()[0]
    one, _ = model.predict(obs, deterministic=True)
    same, _ = model.predict(obs["top"], deterministic=True)
    assert np.array_equal(one, same)
    mean, _ = evaluate_policy(model, Monitor(Cameras("top")), 1)
    assert mean == 28


def normalised(**keywords):
    cameras = DummyVecEnv([lambda: Monitor(Cameras("top"))] * 2)
    return VecNormalize(cameras, norm_obs=False, **keywords)


@pytest.mark.filterwarnings("ignore:Of the Dict")
@pytest.mark.parametrize(
    "wrap", [lambda it: it, lambda it: [it], lambda it: EveryNTimesteps(8, it)]
)
def test_an_evaluation_sees_the_same_entry_and_takes_over_normalised_rewards(wrap):
    eval_env = normalised(training=False)
    evaluation = EvalCallback(eval_env, eval_freq=1, n_eval_episodes=1, verbose=0)
    model = agent(normalised()).learn(28, callback=wrap(evaluation))
    assert evaluation.last_mean_reward == 28
    assert eval_env.ret_rms.count == pytest.approx(model.get_vec_normalize_env().ret_rms.count, 8)
    assert eval_env.ret_rms.count > 2 and evaluation.eval_env is eval_env


class Refusing(BaseCallback):
    """A callback that raises an error at the start, when it is called by this name."""

    def __init__(self, at):
        super().__init__()
        setattr(self, at, self.refuse)

    def refuse(self):
        raise ValueError("refused")

    def _on_step(self):
        return True


@pytest.mark.filterwarnings("ignore:Of the Dict")
@pytest.mark.parametrize("at", ["_init_callback", "_on_training_start"])
def test_an_evaluation_has_its_own_environment_again_if_learning_does_not_start(at):
    eval_env = normalised(training=False)
    evaluation = EvalCallback(eval_env, verbose=0)
    model = agent(normalised())
    with pytest.raises(ValueError, match="refused"):
        model.learn(28, callback=[evaluation, Refusing(at)])
    assert evaluation.eval_env is eval_env


@pytest.mark.filterwarnings("ignore:Evaluation environment")
def test_the_chosen_image_is_seen_in_learning_predicting_and_after_loading(tmp_path):
    model = agent(Cameras("top", "wrist"), image_key="top", learning_starts=0).learn(42)
    assert all_on_time(model, 6)
    obs, other = Cameras("top", "wrist").reset()[0], noise()
    model.save(tmp_path / "model")
    loaded = WPT.load(tmp_path / "model", device="cpu")
    for learner in (model, loaded):
        seen, _ = learner.predict({**obs, "wrist": other}, deterministic=True)
        assert np.array_equal(seen, learner.predict(obs["top"], deterministic=True)[0])
    assert evaluate_policy(model, Monitor(Cameras("top", "wrist")), 1)[0] == 28


def test_of_several_images_one_is_to_be_chosen():
    with pytest.raises(ValueError, match=r"2 images, 'top', 'wrist': choose .*image_key='top'"):
        agent(Cameras("top", "wrist"))
    vec_env = as_vec_env(Cameras("top", "wrist"), image_key="wrist")
    assert (vec_env.reset() == 1).all()
    with pytest.raises(ValueError, match=r"No entry 'side' .*There are: 'arm', 'top', 'wrist'"):
        as_vec_env(Cameras("top", "wrist"), image_key="side")
    with pytest.raises(ValueError, match="image_key='top' chooses from Dict observations"):
        as_vec_env(ClockEnv(), image_key="top")


def test_an_environment_of_a_chosen_image_can_be_set_again():
    model = agent(Cameras("top", "wrist"), image_key="top")
    model.set_env(model.get_env())
    assert model.learn(7).num_timesteps == 7
    with pytest.raises(ValueError, match="image_key='wrist' chooses from Dict"):
        agent(model.get_env(), image_key="wrist")


def test_another_image_is_seen_as_soon_as_the_keyword_is_written():
    model = agent(Cameras("top", "wrist"), image_key="top").learn(7)
    model.image_key = "wrist"
    assert (model.get_env().reset() == 1).all() and model.policy.image_key == "wrist"
    with pytest.raises(ValueError, match="No entry 'side'"):
        model.image_key = "side"
    assert model.image_key == model.policy.image_key == "wrist"
    assert (model.get_env().reset() == 1).all()


class Labelled(Cameras):
    """A camera beside a mask and the colours of two objects, which are no images."""

    def __init__(self):
        super().__init__("top")
        extra = {"mask": (64, 64), "colours": (2, 3)}
        boxes = {name: spaces.Box(0, 255, shape, np.uint8) for name, shape in extra.items()}
        self.observation_space = spaces.Dict({**self.observation_space.spaces, **boxes})

    def _seen(self, image):
        extra = {name: self.observation_space[name].sample() for name in ("mask", "colours")}
        return {**super()._seen(image), **extra}


@pytest.mark.filterwarnings("ignore:Of the Dict", "ignore:Evaluation environment")
@pytest.mark.parametrize("n", [1, 3, 4])
def test_in_a_batch_of_dictionaries_arrays_of_two_axes_are_not_taken_for_images(n):
    model = agent(Labelled())
    assert evaluate_policy(model, DummyVecEnv([Labelled] * n), n)[0] == 28
    assert model.predict(Labelled().reset()[0])[0].shape == (2,)
