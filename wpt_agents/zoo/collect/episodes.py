"""Play the episodes of a collection; each depends only on its task, recipe and number."""

import json
import warnings
import zlib
from collections.abc import Mapping
from contextlib import closing
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import wpt_envs
from gymnasium import spaces

from wpt_agents.data.trajectory import Trajectory
from wpt_agents.model.actions import to_bounds
from wpt_agents.training.spaces import check_actions
from wpt_agents.zoo.collect.behaviours import Act, noise_actions, random_actions, scripted_actions
from wpt_agents.zoo.collect.policies import SavedPolicy, sees_states
from wpt_agents.zoo.collect.state_curiosity import STAGES, by_state, stage_files, state_policy

STATE_CURIOSITY = "explore-state"  # the behaviour of `state_curiosity`
SIGMAS = (0.1, 0.3, 0.5, 1.0, 2.0)  # of the noise on scripted actions, used in turn


MAX_STEPS = 1000  # limit for environments without a time limit


def record(env: gym.Env, act: Act, seed: int, max_steps: int = MAX_STEPS) -> Trajectory:
    """Play one episode of at most `max_steps`, and return it with its rewards."""
    obs, info = env.reset(seed=seed)
    # copies, since some environments draw into the same array or scale the action in place
    images, actions, rewards = [np.array(obs)], list[np.ndarray](), list[float]()
    terminated = truncated = False
    while not (terminated or truncated or len(actions) == max_steps):
        action = np.asarray(act(obs, info, len(actions)), np.float32)
        obs, reward, terminated, truncated, info = env.step(action.copy())
        images.append(np.array(obs))
        actions.append(action)
        rewards.append(float(reward))
    return Trajectory(
        np.stack(images), np.stack(actions), np.array(rewards, np.float32), bool(terminated)
    )


@dataclass(frozen=True)
class Recipe:
    """The settings by which the episodes of a collection are played, apart from the task.

    :param behaviour: one of `BEHAVIOURS`
    :param env: keyword arguments of `gymnasium.make`
    :param rewards: whether to keep the rewards
    :param sigmas: standard deviations of the noise on scripted and saved policies, used in turn
    :param policy: a saved policy, see `wpt_agents.zoo.collect.policies.load_policy`
    :param settings: keywords of WPT for a curious agent, in addition to `EXPLORE`
    :param stages: the folder with the stages of an exploration by state, which are played in turn
    """

    seed: int = 0
    behaviour: str = "noise"
    env: Mapping[str, Any] = field(default_factory=dict)
    rewards: bool = False
    sigmas: tuple[float, ...] = SIGMAS
    policy: str | None = None
    settings: Mapping[str, Any] = field(default_factory=dict)
    stages: str | None = None

    def label(self) -> dict[str, Any]:
        """Return a part of `collect.json`: seed, behaviour, env, and non-default settings."""
        always = "seed", "behaviour", "env"
        default = vars(Recipe())
        changed = {k: v for k, v in vars(self).items() if k in always or v != default[k]}
        return json.loads(json.dumps(changed))

    def sigma(self, episode: int) -> float:
        """Return the noise of an episode."""
        return self.sigmas[episode % len(self.sigmas)]


@dataclass(frozen=True)
class Job:
    """Consecutive episodes of one task, with everything that a worker needs."""

    task: str
    first: int
    count: int
    recipe: Recipe


def play(job: Job) -> list[Trajectory]:
    """Play the episodes of a job, which depend only on the job."""
    with closing(make_env(job.task, job.recipe)) as env:
        episodes = range(job.first, job.first + job.count)
        return [play_episode(env, job, episode) for episode in episodes]


def make_env(task: str, recipe: Recipe) -> gym.Env:
    """Make the task with actions in [-1, 1], and with the state in `info` if it is needed."""
    needs_state = (
        (recipe.behaviour == "scripted" and has_script(task))
        or (recipe.policy is not None and sees_states(recipe.policy))
        or recipe.stages is not None
    )
    keywords = {**recipe.env, "state_in_info": True} if needs_state else recipe.env
    env = gym.make(task, **keywords)
    check_actions(env.action_space, max_action_dim=None)
    space = env.action_space
    assert isinstance(space, spaces.Box), space
    unit = spaces.Box(-1, 1, space.shape, np.float32)
    if space == unit:
        return env
    # Gymnasium's RescaleAction divides by zero for whole numbers and for bounds that are equal.
    return gym.wrappers.TransformAction(env, lambda action: to_bounds(action[None], space)[0], unit)


def play_episode(env: gym.Env, job: Job, episode: int) -> Trajectory:
    """Play the episode of this number, which depends only on job and number."""
    recipe = job.recipe
    task = zlib.crc32(job.task.encode())  # by name, because tasks may be added
    source = np.random.SeedSequence([recipe.seed, task, episode])
    assert env.action_space.shape is not None
    act, name = _actions(
        np.random.default_rng(source), job.task, recipe, episode, env.action_space.shape[0]
    )
    with warnings.catch_warnings():  # some of Meta-World's scripts exceed the action limits
        warnings.filterwarnings("ignore", "Constant\\(s\\) may be too high")
        played = record(env, act, int(source.generate_state(1)[0]))
    reward = played.reward if recipe.rewards else None
    return replace(played, reward=reward, embodiment=robot_of(job.task), task=job.task, source=name)


def _actions(
    rng: np.random.Generator, task: str, recipe: Recipe, episode: int, width: int
) -> tuple[Act, str]:
    if recipe.behaviour == "policy":
        assert recipe.policy is not None
        sigma = recipe.sigma(episode)
        name = f"policy {Path(recipe.policy).name}, sigma {sigma}"
        return SavedPolicy(rng, recipe.policy, sigma, width), name
    if recipe.stages is not None:
        stage = episode % STAGES
        explorer = state_policy(stage_files(Path(recipe.stages), task)[stage].read_bytes())
        name = f"curiosity on the state, stage {stage + 1} of {STAGES}"
        return by_state(explorer, rng), name
    if recipe.behaviour == "random":
        return random_actions(rng, width, MAX_STEPS)
    if recipe.behaviour == "scripted" and has_script(task):
        return scripted_actions(rng, task, recipe.sigma(episode))
    return noise_actions(rng, width, MAX_STEPS)


def robot_of(task: str) -> str | None:
    """Return the name of the robot of a task, or None for an unknown task."""
    row = wpt_envs.TASKS.get(task)
    return row.embodiment if row else None


def has_script(task: str) -> bool:
    """Return whether Meta-World has a scripted policy for the task."""
    row = wpt_envs.TASKS.get(task)
    return row is not None and row.suite == "metaworld"
