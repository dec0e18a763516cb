"""DMControl: rewards, seeds, episodes, and each custom reward on states set by hand."""

import json
from importlib import import_module
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import wpt_envs  # noqa: F401
from dm_control import suite
from shimmy import DmControlCompatibilityV0
from wpt_envs import tasks


def stock_name(task):
    """What dm_control calls it, if it has it."""
    return task.name.removeprefix(f"{task.embodiment}-").replace("-", "_")


def stock_names(domain):
    return set(import_module(f"dm_control.suite.{domain}").SUITE)


DMC = tasks.suite("dmc", paper_only=False)
STOCK = [task for task in DMC if stock_name(task) in stock_names(task.embodiment)]
REWARDS = json.loads((Path(__file__).parents[1] / "fixtures" / "dmc_rewards.json").read_text())


def first_rewards(name, steps=10):
    """The first rewards after reset(seed=0), action repeat 2, on sines."""
    env = gym.make(name).unwrapped  # without pixels: rewards do not need them
    env.reset(seed=0)
    width = env.action_space.shape[0]
    rewards = []
    for step in range(steps):
        action = (0.9 * np.sin(0.37 * step + np.arange(width))).astype(np.float32)
        rewards.append(sum(env.step(action)[1] for _ in range(2)))
    return rewards


def physics_of(name, **qvel):
    """The task and its physics at rest in the model's own pose."""
    env = gym.make(f"wpt/dmc-{name}-v0").unwrapped.dm_env
    physics = env.physics
    with physics.reset_context():
        for joint, value in qvel.items():
            physics.named.data.qvel[joint] = value
    return env.task, physics


def place(physics, **qpos):
    for joint, value in qpos.items():
        physics.named.data.qpos[joint] = value
    physics.forward()


@pytest.mark.parametrize("task", REWARDS)
def test_the_first_rewards_are_the_recorded_ones(task):
    assert first_rewards(f"wpt/dmc-{task}-v0") == pytest.approx(REWARDS[task], abs=1e-4)


def test_rewards_are_recorded_for_all_of_the_papers_tasks_and_cheetah_run_hard():
    paper = {task.name for task in tasks.suite("dmc")}
    assert set(REWARDS) == paper | {"cheetah-run-hard"}


@pytest.mark.filterwarnings("ignore:`in1d`:DeprecationWarning")  # dm_control's, not ours
@pytest.mark.parametrize("domain", ["acrobot", "quadruped"])
def test_a_seed_is_dm_controls_random_state_and_goes_on_without_one(domain):
    name = {"acrobot": "swingup", "quadruped": "walk"}[domain]
    theirs = suite.load(domain, name, task_kwargs={"random": 7})
    ours = gym.make(f"wpt/dmc-{domain}-{name}-v0").unwrapped
    for seed in (7, None, None):
        ours.reset(seed=seed)
        theirs.reset()
        assert np.array_equal(ours.dm_env.physics.get_state(), theirs.physics.get_state())


@pytest.mark.filterwarnings("ignore:`in1d`:DeprecationWarning")  # dm_control's, not ours
@pytest.mark.parametrize("task", STOCK, ids=lambda task: task.name)
def test_a_stock_task_is_the_same_through_shimmy(task):
    theirs = DmControlCompatibilityV0(suite.load(task.embodiment, stock_name(task)))
    ours = gym.make(task.id).unwrapped
    theirs.reset(seed=5), ours.reset(seed=5)
    for step in range(5):
        action = np.sin(step + np.arange(task.action_dim)).astype(np.float32)
        (obs, *rest), (state, *ends, _) = theirs.step(action), ours.step(action)
        assert np.array_equal(np.concatenate([np.ravel(part) for part in obs.values()]), state)
        assert rest[:3] == ends  # reward, terminated, truncated


@pytest.mark.parametrize("domain", ["cartpole", "acrobot", "cheetah", "walker", "quadruped"])
def test_every_stock_task_of_a_domain_is_in_the_table(domain):
    assert stock_names(domain) == {stock_name(task) for task in STOCK if task.embodiment == domain}


def test_a_seed_of_more_than_32_bits_is_a_seed_of_its_own():
    env = gym.make("wpt/dmc-cartpole-swingup-v0", state_in_info=True)
    states = [env.reset(seed=seed)[1]["state"] for seed in (2**40 + 3, 2**40 + 3, 2**41 + 3, 3)]
    env.close()
    assert np.array_equal(states[0], states[1])
    assert len({state.tobytes() for state in states}) == 3


def test_the_constructors_seed_is_used_once():
    env = gym.make("wpt/dmc-acrobot-swingup-v0", seed=7).unwrapped
    first, second = env.reset()[0], env.reset()[0]
    assert np.array_equal(first, env.reset(seed=7)[0])
    assert not np.array_equal(first, second)


@pytest.mark.parametrize(
    "name", ["cartpole-balance", "acrobot-swingup", "cheetah-jump", "walker-run", "quadruped-roll"]
)
def test_an_episode_is_truncated_after_its_frames_and_never_terminated(name):
    task = tasks.find("dmc", name)
    env = gym.make(task.id).unwrapped
    env.reset(seed=0)
    still = np.zeros(task.action_dim, np.float32)
    ends = [env.step(still)[2:4] for _ in range(task.frames)]
    assert ends == [(False, False)] * (task.frames - 1) + [(False, True)]
    with pytest.raises(gym.error.ResetNeeded, match=r"call reset\(\)"):
        env.step(still)


@pytest.mark.parametrize("task", DMC, ids=lambda task: task.name)
def test_the_table_has_the_simulators_width(task):
    env = gym.make(task.id).unwrapped
    assert env.dm_env.action_spec().shape == (task.action_dim,)


def test_the_hard_reward_drops_what_is_low_and_charges_effort():
    task, physics = physics_of("walker-walk-hard")
    task.before_step(np.array([3.0, 4, 0, 0, 0, 0]), physics)  # effort 5, costs 0.5
    place(physics, rootz=-1)  # lying: the reward is below 0.6
    assert task.get_reward(physics) == pytest.approx(-0.5)
    task, physics = physics_of("walker-walk-hard", rootx=1.0)
    task.before_step(np.array([3.0, 4, 0, 0, 0, 0]), physics)
    assert task.get_reward(physics) == pytest.approx(1 - 0.5, abs=0.01)


@pytest.mark.parametrize(("speed", "share"), [(-1, 1), (-0.5, 3.5 / 6), (0, 1 / 6), (1, 1 / 6)])
def test_walking_backwards_pays_standing_times_speed(speed, share):
    task, physics = physics_of("walker-walk-backwards", rootx=speed)
    assert task.get_reward(physics) == pytest.approx(share, abs=0.01)  # S is 1 when upright


@pytest.mark.parametrize(("speed", "share"), [(-8, 1), (-4, 3.5 / 6), (8, 1 / 6)])
def test_running_backwards_wants_eight_metres_a_second(speed, share):
    task, physics = physics_of("walker-run-backwards", rootx=speed)
    assert task.get_reward(physics) == pytest.approx(share, abs=0.01)


@pytest.mark.parametrize(("speed", "share"), [(-6, 1), (-3, 3.5 / 6), (0, 1 / 6)])
def test_a_backflip_pays_feet_and_thighs_in_the_air_and_speed(speed, share):
    task, physics = physics_of("walker-backflip", rootx=speed)
    place(physics, rootz=2)
    assert task.get_reward(physics) == pytest.approx(share, abs=0.01)


@pytest.mark.parametrize(("speed", "reward"), [(-8, 1), (-4, 0.5), (0, 0), (4, 0)])
def test_the_cheetah_runs_backwards_at_eight_metres_a_second(speed, reward):
    task, physics = physics_of("cheetah-run-backwards", rootx=speed)
    assert task.get_reward(physics) == pytest.approx(reward)


@pytest.mark.parametrize(("speed", "reward"), [(0, 1), (0.75, 5.5 / 6), (1, 5 / 6), (9, 5 / 6)])
def test_a_jump_is_high_and_on_the_spot(speed, reward):
    task, physics = physics_of("cheetah-jump", rootx=speed)
    place(physics, rootz=2)
    assert task.get_reward(physics) == pytest.approx(reward)


@pytest.mark.parametrize("task_name", ["run-front", "run-back"])
def test_running_on_one_foot_pays_height_and_speed(task_name):
    task, physics = physics_of(f"cheetah-{task_name}", rootx=3)
    place(physics, rootz=2)
    assert task.get_reward(physics) == pytest.approx((5 * 0.5 + 1) / 6)


def test_running_on_the_front_foot_raises_the_back_one():
    pitched = {name: physics_of(f"cheetah-{name}") for name in ("run-front", "run-back")}
    paid = {}
    for name, (task, physics) in pitched.items():
        place(physics, rooty=0.8)  # nose down: the back foot is up
        paid[name] = task.get_reward(physics)
    assert paid["run-front"] > 1.2 * paid["run-back"]


@pytest.mark.parametrize(
    ("quaternion", "reward"),
    [((1, 0, 0, 0), 1), ((0.5**0.5, 0.5**0.5, 0, 0), 0.5), ((0, 1, 0, 0), 0)],
)
def test_the_quadruped_stands_when_upright(quaternion, reward):
    task, physics = physics_of("quadruped-stand")
    place(physics, root=[0, 0, 2, *quaternion])
    assert task.get_reward(physics) == pytest.approx(reward)


@pytest.mark.parametrize(("height", "paid"), [(3, 1), (0.5, 0.75)])
def test_the_quadruped_jumps_a_metre_high(height, paid):
    task, physics = physics_of("quadruped-jump")
    place(physics, root=[0, 0, height, 1, 0, 0, 0])
    assert task.get_reward(physics) == pytest.approx(paid, abs=0.05)


@pytest.mark.parametrize("direction", [(1, 0, 0), (0, -1, 0), (0, 0, 1), (0.6, 0.8, 0)])
def test_rolling_counts_speed_in_every_direction(direction):
    for name, speed, reward in (("roll", 0.25, 0.75), ("roll", 9, 1), ("roll-fast", 2.5, 0.75)):
        task, physics = physics_of(
            f"quadruped-{name}", root=[*np.multiply(speed, direction), 0, 0, 0]
        )
        place(physics, root=[0, 0, 2, 1, 0, 0, 0])
        assert task.get_reward(physics) == pytest.approx(reward, abs=0.01)


def test_the_escape_terrain_is_drawn_as_it_is_now():
    env = gym.make("wpt/dmc-quadruped-escape-v0", rendering="fast")
    env.reset(seed=0)
    other, _ = env.reset(seed=1)
    fresh, _ = gym.make("wpt/dmc-quadruped-escape-v0", rendering="fast").reset(seed=1)
    assert np.array_equal(other, fresh)


def test_a_longer_floor_is_drawn_and_changes_no_physics():
    stock, longer = (gym.make("wpt/dmc-walker-run-v0", floor=floor) for floor in (None, 3.0))
    images = [env.reset(seed=0)[0] for env in (stock, longer)]
    assert not np.array_equal(*images)
    action = np.ones(6, np.float32)
    assert stock.step(action)[1] == longer.step(action)[1]


def test_rescaled_actions_reach_the_actuators_own_range():
    env = gym.make("wpt/dmc-quadruped-run-v0", rescale_action=True).unwrapped
    env.reset(seed=0)
    env.step(np.ones(12, np.float32))
    physics = env.dm_env.physics
    assert np.allclose(physics.data.ctrl, physics.model.actuator_ctrlrange[:, 1])
