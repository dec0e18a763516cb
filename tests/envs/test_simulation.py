"""The simulation inside somebody's environment, and the camera it is shown by."""

import gymnasium as gym
import mujoco
import numpy as np
import pytest
import wpt_envs
from dm_control import suite
from gymnasium import spaces
from wpt_envs.measure import psnr
from wpt_envs.simulation import find_simulation, model_and_data

MODEL = """<mujoco><worldbody><light pos="0 0 3"/><geom type="plane" size="1 1 .1"/>
<camera name="above" pos="0 0 2"/><body pos="0 0 1"><freejoint/>
<geom size=".{size}" rgba="1 0 0 1"/></body></worldbody></mujoco>"""


class Holder:
    """Somebody's class that keeps something in an attribute."""

    def __init__(self, **attributes):
        self.__dict__ |= attributes


class Own(gym.Env):
    """Somebody's environment around anything, without rendering."""

    observation_space, render_mode = spaces.Box(-1, 1, (1,)), None
    action_space = spaces.Box(-1, 1, (1,), np.float32)

    def __init__(self, **attributes):
        self.__dict__ |= attributes

    def reset(self, *, seed=None, options=None):
        return np.zeros(1, np.float32), {}


def raw(size=3):
    model = mujoco.MjModel.from_xml_string(MODEL.format(size=size))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return Holder(model=model, data=data)


def test_the_physics_are_found_wherever_they_are_kept():
    walker, simulation = suite.load("walker", "run"), raw()
    wrapped = Holder(model=Holder(_model=simulation.model), data=Holder(_data=simulation.data))
    for env, model in [
        (Own(_env=walker), walker.physics.model.ptr),
        (Own(task=Holder(env=walker)), walker.physics.model.ptr),
        (Own(worlds=[Holder(), walker]), walker.physics.model.ptr),
        (Own(model=simulation.model, data=simulation.data), simulation.model),
        (Own(sim=simulation), simulation.model),
        (Own(robot=Holder(sim=wrapped)), simulation.model),  # as robosuite has it
    ]:
        handle = find_simulation(env)
        assert model_and_data(handle)[0] is model
        assert np.ptp(wpt_envs.pixels(env, rendering="fast").reset()[0]) > 50


def test_what_holds_no_simulation_is_refused_with_the_way_out():
    loop = Holder(model="a language model", data=np.zeros(3))
    loop.itself = loop
    env = Own(loop=loop)
    with pytest.raises(ValueError, match=r"none was found in .*: leave rendering out"):
        wpt_envs.pixels(env, rendering="near")


@pytest.mark.parametrize("holder", ["the same", "a new one"])
def test_a_model_that_is_made_anew_is_drawn_anew(holder):
    env = Own(sim=raw(size=1))
    seen = wpt_envs.pixels(env, rendering="fast", camera="above")
    small, _ = seen.reset()
    if holder == "the same":
        env.sim.__dict__ |= vars(raw(size=6))
    else:  # as in robosuite, and in dm_control's composer
        env.sim = raw(size=6)
    large, _ = seen.reset()
    reds = [int(((i[..., 0] > 80) & (i[..., 1] < 60)).sum()) for i in (small, large)]
    assert 0 < 4 * reds[0] < reds[1]
    seen.close()


TERRAIN = """<mujoco><asset><hfield name="hills" nrow="9" ncol="9" size="1 1 1 .1"/></asset>
<worldbody><light pos="0 0 3"/><geom type="hfield" hfield="hills"/></worldbody></mujoco>"""


class Hills(Own):
    """A new terrain in each episode, in the same simulation."""

    def reset(self, *, seed=None, options=None):
        self.model.hfield_data[:] = np.random.default_rng(seed).random(81)
        return super().reset(seed=seed)


def test_a_new_terrain_is_drawn():
    model = mujoco.MjModel.from_xml_string(TERRAIN)
    env = Hills(model=model, data=mujoco.MjData(model))
    mujoco.mj_forward(model, env.data)
    seen = wpt_envs.pixels(env, rendering="fast")
    first, second, again = (seen.reset(seed=seed)[0] for seed in (1, 2, 1))
    assert not np.array_equal(first, second)
    assert np.array_equal(first, again)
    seen.close()


@pytest.mark.parametrize(
    "name", ["Ant-v5", "Hopper-v5", "Pusher-v5", "Reacher-v5", "InvertedPendulum-v5"]
)
def test_exact_shows_what_the_environments_own_camera_shows(name):
    shown = {}
    for rendering in (None, "exact"):
        env = wpt_envs.pixels(gym.make(name, render_mode="rgb_array"), rendering=rendering)
        shown[rendering] = env.reset(seed=0)[0]
        env.close()
    assert psnr(shown["exact"], shown[None]) > 20  # another view is below 12


def test_a_camera_of_ones_own_is_kept():
    env = gym.make("Ant-v5", render_mode="rgb_array", camera_name="track")
    default = wpt_envs.pixels(env, rendering="fast").reset(seed=0)[0]
    same = wpt_envs.pixels(env, rendering="fast", camera="track").reset(seed=0)[0]
    other = wpt_envs.pixels(env, rendering="fast", camera={"distance": 9.0}).reset(seed=0)[0]
    assert np.array_equal(default, same) and not np.array_equal(default, other)
    env.close()
