"""The GL variables of docker images and cluster profiles: what works is chosen, never an abort."""

import os
import subprocess
import sys

import pytest
from wpt_envs import __main__ as command_line
from wpt_envs import headless

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="the variables are Linux's")
NAMES = ("MUJOCO_GL", "PYOPENGL_PLATFORM", "MUJOCO_EGL_DEVICE_ID", "DISPLAY", "WAYLAND_DISPLAY")


@pytest.fixture
def chosen(monkeypatch):
    """Set variables, choose, and return the platform variables of MuJoCo and PyOpenGL."""

    def choose(egl=True, osmesa=False, devices=1, **variables):
        for name in NAMES:
            monkeypatch.setenv(name, "")  # so that it is put back afterwards
            monkeypatch.delenv(name)
        monkeypatch.setattr(headless, "_egl_works", lambda: egl)
        monkeypatch.setattr(headless, "_egl_devices", lambda: [1] * devices)
        monkeypatch.setattr(headless, "_osmesa_works", lambda: osmesa)
        monkeypatch.setattr(headless, "_preferred_here", False)
        for name, value in variables.items():
            monkeypatch.setenv(name, value)
        headless.prefer_egl()
        headless.choose()
        return os.environ["MUJOCO_GL"], os.environ.get("PYOPENGL_PLATFORM")

    return choose


@pytest.mark.parametrize("value", ["", " ", "on", "1", "true", "enable", "EGL", "egl", " Egl "])
def test_what_leaves_the_choice_or_means_egl_draws_by_egl(chosen, value):
    assert chosen(MUJOCO_GL=value) == ("egl", None)


@pytest.mark.parametrize("value", ["glfw", "glx", "GLFW"])
def test_a_window_needs_a_display_that_works(chosen, value, monkeypatch):
    with pytest.raises(RuntimeError, match=r"MUJOCO_GL=gl.* draws in a window.*set MUJOCO_GL=egl"):
        chosen(MUJOCO_GL=value)
    with pytest.raises(RuntimeError, match="no display that works"):
        chosen(MUJOCO_GL=value, DISPLAY=":97")  # nobody serves it
    monkeypatch.setattr(headless, "_window_works", lambda: True)
    assert chosen(MUJOCO_GL=value) == (value.lower(), None)


@pytest.mark.parametrize("value", ["disable", "off", "0", "False", "DISABLED"])
def test_drawing_that_is_forbidden_is_said_to_be(chosen, value):
    with pytest.raises(RuntimeError, match=f"MUJOCO_GL={value.lower()} forbids drawing.*unset"):
        chosen(MUJOCO_GL=value)


def test_an_unknown_name_is_answered_with_the_nearest(chosen):
    with pytest.raises(RuntimeError, match=r"MUJOCO_GL=elg is not known\. Did you mean egl\?"):
        chosen(MUJOCO_GL="elg")
    with pytest.raises(RuntimeError, match="There are: egl, osmesa, glfw, glx, or leave it unset"):
        chosen(MUJOCO_GL="vulkan")


def test_pyopengl_is_told_the_same(chosen):
    assert chosen(PYOPENGL_PLATFORM="osmesa") == ("egl", "egl")
    assert chosen(PYOPENGL_PLATFORM="osmesa", osmesa=True) == ("osmesa", "osmesa")
    assert chosen(PYOPENGL_PLATFORM="EGL") == ("egl", "EGL")
    assert chosen(PYOPENGL_PLATFORM="glx") == ("egl", "egl")
    assert chosen(PYOPENGL_PLATFORM="osmesa", MUJOCO_GL="egl") == ("egl", "egl")
    assert chosen(PYOPENGL_PLATFORM="egl", MUJOCO_GL="osmesa", osmesa=True) == ("osmesa", "osmesa")
    assert chosen(PYOPENGL_PLATFORM="egl", egl=False, osmesa=True) == ("osmesa", "osmesa")


def test_the_device_is_a_number_that_there_is(chosen):
    assert chosen(MUJOCO_EGL_DEVICE_ID="1", devices=2) == ("egl", None)
    assert chosen(MUJOCO_EGL_DEVICE_ID=" ") == ("egl", None)
    assert "MUJOCO_EGL_DEVICE_ID" not in os.environ
    for value in ("7", "cuda:0", "-1", "0,1", "GPU-4f1c2ab0"):
        with pytest.raises(RuntimeError, match=f"MUJOCO_EGL_DEVICE_ID={value} .* from 0 to 0"):
            chosen(MUJOCO_EGL_DEVICE_ID=value)


def test_variables_that_hide_egl_are_named(chosen):
    with pytest.raises(RuntimeError, match=r"apt-get .*cause: EGL_PLATFORM=wayland"):
        chosen(egl=False, EGL_PLATFORM="wayland")


DRAW = """
import gymnasium, {first}, wpt_envs
env = {env}
print("drawn", wpt_envs.pixels(env).reset(seed=0)[0].std() > 3)
"""
WALKER = "shimmy.DmControlCompatibilityV0(suite.load('walker', 'run'), render_mode='rgb_array')"


@pytest.mark.parametrize(
    ("first", "env"),
    [
        ("shimmy; from dm_control import suite; import os", WALKER),
        ("dm_control.mujoco; from dm_control import suite; import shimmy", WALKER),
        ("mujoco", "gymnasium.make('Reacher-v5', render_mode='rgb_array')"),
    ],
)
def test_a_simulator_that_was_imported_first_still_draws_without_a_display(first, env):
    variables = {k: v for k, v in os.environ.items() if k not in NAMES}
    code = [sys.executable, "-c", DRAW.format(first=first, env=env)]
    run = subprocess.run(code, env=variables, capture_output=True, text=True)
    assert "drawn True" in run.stdout, (run.returncode, run.stderr)


def draw_montage(monkeypatch, fault):
    def fail(**_):
        raise fault

    monkeypatch.setattr(sys, "argv", ["wpt_envs", "montage", "tasks.png"])
    monkeypatch.setattr(command_line, "_montage", fail)
    command_line.main()


@pytest.mark.parametrize(
    ("fault", "sentence"),
    [
        (headless.RenderingError("Drawing off screen needs EGL"), "Drawing off screen needs EGL"),
        (
            ModuleNotFoundError("No module named 'dm_control'", name="dm_control"),
            'dm_control is not installed: pip install "wpt-agents[sims]"',
        ),
        (ImportError("Unable to load EGL library"), "Unable to load EGL library"),
    ],
)
def test_the_command_line_says_in_one_sentence_what_is_missing(
    fault, sentence, monkeypatch, capsys
):
    with pytest.raises(SystemExit, match="2"):
        draw_montage(monkeypatch, fault)
    assert capsys.readouterr().err == f"Error: {sentence}\n"


@pytest.mark.parametrize(
    "fault",
    [
        ModuleNotFoundError("No module named 'wpt_envs.x'", name="wpt_envs.x"),
        ImportError("cannot import name 'x' from 'wpt_envs.y'", name="wpt_envs.y"),
    ],
)
def test_a_wrong_import_of_ours_keeps_its_traceback(fault, monkeypatch):
    with pytest.raises(ImportError, match="wpt_envs"):
        draw_montage(monkeypatch, fault)
