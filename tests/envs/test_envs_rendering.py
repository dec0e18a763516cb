"""The renderer: exact is exact, physics never changes, and nobody's frames are touched."""

import gc
import itertools
import os
import subprocess
import sys

import gymnasium as gym
import mujoco
import numpy as np
import pytest
import wpt_envs
from sampling import one_in_eight
from wpt_envs import headless, measure, rendering

pytestmark = pytest.mark.slow  # it runs simulators or whole runs

FAMILIES = [
    "dmc-cartpole-balance",
    "dmc-acrobot-swingup",
    "dmc-cheetah-run",
    "dmc-walker-run",
    "dmc-quadruped-run",
    "metaworld-button-press",
    "robotics-fetch-push",
    "robotics-shadow-hand-block",
    "robotics-adroit-door",
]
THE_FOUR = [name.removeprefix("wpt/").removesuffix("-v0") for name in measure.THE_FOUR]


def make(name, **kwargs):
    env = gym.make(f"wpt/{name}-v0", **kwargs)
    env.reset(seed=0)
    return env


def model_bytes(model):
    buffer = np.empty(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, buffer)
    return buffer.tobytes()


@pytest.mark.parametrize("name", FAMILIES)
def test_exact_is_the_usual_renderers_picture(name):
    env = make(name, rendering="exact").unwrapped
    usual, free = measure.usual_renderer(env)  # dm_control's or gymnasium's
    for _ in measure.visit_states(env, 2):
        assert np.array_equal(env.look(64), usual())
    free()


@pytest.mark.parametrize("name", THE_FOUR)
def test_physics_is_bit_identical_under_all_renderings(name):
    envs = [make(name, rendering=quality, state_in_info=True) for quality in rendering.QUALITIES]
    for _ in range(4):
        action = envs[0].action_space.sample()
        results = [env.step(action) for env in envs]
        assert len({result[4]["state"].tobytes() for result in results}) == 1
        assert len({result[1] for result in results}) == 1


@pytest.mark.parametrize("quality", ["near", "fast"])
def test_opening_a_renderer_leaves_the_model_as_it_was(quality):
    env = gym.make("wpt/metaworld-hammer-v0", rendering=quality).unwrapped
    before = model_bytes(env.sawyer.model)
    env.look(64)
    assert model_bytes(env.sawyer.model) == before


@pytest.mark.parametrize("name", measure.THE_FOUR)
def test_near_is_within_38_db_of_exact(name):
    assert measure.likeness(wpt_envs.TASKS[name], states=3)["near"] >= 38


COUNTED = [name for name, task in wpt_envs.TASKS.items() if task.in_paper]


@pytest.mark.parametrize("name", one_in_eight(COUNTED))
def test_near_looks_like_exact_on_each_of_the_72(name):
    """One state; the mean over 20, 38 dB and more, is what `python -m wpt_envs likeness` shows."""
    assert measure.likeness(wpt_envs.TASKS[name], states=1)["near"] >= 37


def test_no_environment_changes_anothers_frames():
    envs = {name: make(name, rendering="fast").unwrapped for name in FAMILIES}
    alone = {name: env.look(64) for name, env in envs.items()}
    for first, second in itertools.permutations(FAMILIES, 2):
        assert np.array_equal(envs[first].look(64), alone[first])
        assert np.array_equal(envs[second].look(64), alone[second])
    for env in envs.values():
        env.close()


def test_other_peoples_renderers_keep_their_frames_too():
    walker, press = make("dmc-walker-run").unwrapped, make("metaworld-button-press").unwrapped
    gymnasiums, free = measure.usual_renderer(press)
    dm_controls, _ = measure.usual_renderer(walker)
    dm_controls()
    alone = gymnasiums()  # its context is the current one now, and it never asks again
    walker.look(64), press.look(64)
    assert np.array_equal(gymnasiums(), alone)
    free()


def test_closing_frees_the_context_and_looking_again_makes_a_new_one():
    env = make("dmc-acrobot-swingup", rendering="fast").unwrapped
    before = env.look(64)
    env.close()
    assert np.array_equal(env.look(64), before)
    env.close()


def open_contexts():
    gc.collect()
    contexts = [thing for thing in gc.get_objects() if type(thing).__name__ == "GLContext"]
    return sum(bool(context._context) for context in contexts)


def resident_mb():
    with open("/proc/self/statm") as statm:
        return int(statm.read().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20


def in_use():
    """Open contexts, open files, and memory in MB."""
    return open_contexts(), len(os.listdir("/proc/self/fd")), resident_mb()


def look_at_a_ball():
    model = mujoco.MjModel.from_xml_string(BALL)
    view = rendering.View(model, mujoco.MjData(model))
    view.look(16)
    view.close()


def make_each_suite():
    for name in ("dmc-cartpole-balance", "metaworld-reach", "robotics-fetch-reach"):
        make(name, rendering="fast", image_size=16).close()


BALL = "<mujoco><worldbody><light pos='0 0 3'/><geom size='1'/></worldbody></mujoco>"


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
@pytest.mark.parametrize(("open_and_close", "times"), [(look_at_a_ball, 200), (make_each_suite, 9)])
def test_opening_and_closing_leaks_neither_contexts_nor_files_nor_memory(open_and_close, times):
    for _ in range(times // 3):
        open_and_close()
    contexts, files, memory = in_use()
    for _ in range(times - times // 3):
        open_and_close()
    later = in_use()
    assert later[:2] == (contexts, files)
    assert later[2] < memory + 40  # one leaked in ten would be more: a context takes 20 MB or so


def test_a_context_is_open_from_the_first_picture_until_closing():
    before = open_contexts()
    env = make("dmc-cartpole-balance", rendering="fast", image_size=16)
    assert open_contexts() == before + 1
    env.close()
    assert open_contexts() == before


def test_every_robot_stands_in_the_picture():
    for task in wpt_envs.tasks.suite("robotics", paper_only=False):
        env = make(f"robotics-{task.name}", rendering="fast").unwrapped
        before = env.look(64)
        for _ in range(8):
            env.step(np.ones(task.action_dim, np.float32))
        assert np.mean(np.any(before != env.look(64), axis=2)) > 0.01, task.name
        env.close()


def test_every_size_is_drawn_on_its_own():
    env = make("dmc-walker-run", render_size=100)
    assert env.reset(seed=0)[0].shape == (64, 64, 3)
    assert env.render().shape == (100, 100, 3)


def test_a_camera_is_chosen_by_name_number_or_placement():
    env = make("dmc-walker-run", camera="back", rendering="fast")
    numbered = make("dmc-walker-run", camera=1, rendering="fast")
    free = make("dmc-walker-run", camera={"distance": 9.0}, rendering="fast")
    images = [view.reset(seed=0)[0] for view in (env, numbered, free)]
    assert np.array_equal(images[0], images[1])
    assert not np.array_equal(images[0], images[2])


def test_an_unknown_camera_or_rendering_is_answered_with_what_there_is():
    with pytest.raises(ValueError, match="side, back"):
        gym.make("wpt/dmc-walker-run-v0", camera="front")
    with pytest.raises(ValueError, match="exact, near, fast"):
        gym.make("wpt/dmc-walker-run-v0", rendering="nice")


def test_psnr_by_hand():
    black = np.zeros((2, 2, 3), np.uint8)
    assert measure.psnr(black + 51, black) == pytest.approx(20 * np.log10(5))  # 255 / 51 = 5
    assert measure.psnr(black, black) == np.inf


WITHOUT_EGL = """
import os, gymnasium, wpt_envs
try:
    gymnasium.make("wpt/dmc-cartpole-balance-v0").reset()
    print("drawn by", os.environ["MUJOCO_GL"])
except RuntimeError as error:
    print(error)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="asks Linux's EGL loader to find nothing")
def test_without_egl_osmesa_draws_or_an_error_says_what_to_install_but_nothing_aborts():
    blind = os.environ | {"__EGL_VENDOR_LIBRARY_DIRS": "/nowhere"}
    del blind["MUJOCO_GL"]
    code = [sys.executable, "-c", WITHOUT_EGL]
    run = subprocess.run(code, env=blind, capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    assert "drawn by osmesa" in run.stdout or "apt-get install libegl1" in run.stdout


@pytest.fixture
def unset(monkeypatch):
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    monkeypatch.setattr(headless, "_egl_works", lambda: False)
    headless.prefer_egl()
    yield monkeypatch
    headless._preferred_here = False


def test_without_egl_osmesa_is_chosen(unset):
    unset.setattr(headless, "_osmesa_works", lambda: True)
    headless.choose()
    assert os.environ["MUJOCO_GL"] == "osmesa"


def test_without_any_off_screen_gl_the_error_says_what_to_install(unset):
    unset.setattr(headless, "_osmesa_works", lambda: False)
    with pytest.raises(RuntimeError, match="apt-get install libegl1"):
        headless.choose()


def test_a_users_choice_is_kept(monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "glfw")
    monkeypatch.setattr(headless, "_window_works", lambda: True)
    headless.prefer_egl()
    headless.choose()
    assert os.environ["MUJOCO_GL"] == "glfw"


def test_a_users_choice_which_does_not_work_is_an_error_not_an_abort(monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "osmesa")
    monkeypatch.setattr(headless, "_preferred_here", False)
    monkeypatch.setattr(headless, "_osmesa_works", lambda: False)
    with pytest.raises(RuntimeError, match="MUJOCO_GL=osmesa does not work here"):
        headless.choose()


def test_every_rendering_is_a_keyword_of_every_suite():
    names = ("dmc-walker-run", "metaworld-reach", "robotics-fetch-reach")
    for name, quality in itertools.product(names, rendering.QUALITIES):
        gym.make(f"wpt/{name}-v0", rendering=quality)
