"""OpenGL contexts for drawing off screen, each current only while it draws."""

import atexit
import os
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import mujoco


def _egl() -> Any | None:
    if os.environ.get("MUJOCO_GL") != "egl":
        return None
    import mujoco.egl

    return mujoco.egl


def new_context(side: int) -> Any:
    """Make a context for images of `side` x `side` with the current value of MUJOCO_GL.

    `mujoco.gl_context` uses the value at MuJoCo's first import, which may be outdated.
    """
    backend = os.environ.get("MUJOCO_GL")
    egl = _egl()
    if backend == "osmesa":
        from mujoco.osmesa import GLContext

        return GLContext(side, side)
    if egl is None:
        from mujoco.gl_context import GLContext

        return GLContext(side, side)
    context = egl.GLContext(side, side)
    # MuJoCo and dm_control share one display, and each ends it when Python exits, too early for
    # the other's contexts; it ends with the process anyway.
    atexit.unregister(egl.EGL.eglTerminate)
    return context


@contextmanager
def current(gl: Any) -> Iterator[None]:
    """Make a context current, and restore the previous one on exit for other renderers."""
    egl = _egl()
    if egl is None:
        gl.make_current()
        yield
        return
    before = egl.EGL.eglGetCurrentContext() or egl.EGL.EGL_NO_CONTEXT
    gl.make_current()
    try:
        yield
    finally:
        nothing = egl.EGL.EGL_NO_SURFACE
        egl.EGL.eglMakeCurrent(egl.EGL_DISPLAY, nothing, nothing, before)


def free(gl: Any, mjr: mujoco.MjrContext, process: int) -> None:
    """Free a context in the process that made it."""
    if process == os.getpid():
        with current(gl):
            mjr.free()
        gl.free()
