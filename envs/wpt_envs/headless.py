"""Choose an off-screen backend before mujoco or dm_control is imported.

On Linux with `MUJOCO_GL` unset, MuJoCo opens a window, and aborts the process without a display.
Importing this package therefore sets it to `egl`, and the first task or renderer changes that to
`osmesa` if EGL does not work and OSMesa is installed. A value that the user has set is kept if it
works; otherwise an error says which value does.
"""

import ctypes
import difflib
import importlib
import os
import sys
import warnings

_INSTALL = (
    "Drawing off screen needs EGL or OSMesa. If neither works, install one: "
    "`apt-get install libegl1 libegl-mesa0 libgl1-mesa-dri` or `apt-get install libosmesa6`."
)
_ANY = ("", "on", "enable", "enabled", "true", "1")  # values of MUJOCO_GL that mean "unset"
_NONE = ("off", "disable", "disabled", "false", "0")  # values that disable rendering
_WINDOW = ("glfw", "glx")
_OFF_SCREEN = ("egl", "osmesa")
_EGL_VARIABLES = ("__EGL_VENDOR_LIBRARY_FILENAMES", "__EGL_VENDOR_LIBRARY_DIRS", "EGL_PLATFORM")
_PLATFORM_DEVICE = 0x313F  # EGL_PLATFORM_DEVICE_EXT
_preferred_here = False


class RenderingError(RuntimeError):
    """Nothing can be drawn off screen; the message says what to set or to install."""


def prefer_egl() -> None:
    """Set `MUJOCO_GL` if the user did not, and normalise its spelling."""
    global _preferred_here
    # Mesa's software rasteriser reads this when dm_control or MuJoCo first open it. At 64 x 64
    # its threads are slower than none, and a forked process would wait for them forever.
    os.environ.setdefault("LP_NUM_THREADS", "0")
    if sys.platform != "linux":
        return
    asked = os.environ.get("MUJOCO_GL", "").strip().lower()
    if asked in _ANY:
        wants_osmesa = _pyopengl_platform() == "osmesa" and _osmesa_works()
        asked, _preferred_here = "osmesa" if wants_osmesa else "egl", not wants_osmesa
    os.environ["MUJOCO_GL"] = asked
    if not os.environ.get("MUJOCO_EGL_DEVICE_ID", "any").strip():
        del os.environ["MUJOCO_EGL_DEVICE_ID"]  # MuJoCo fails on an empty value
    _agree_with_pyopengl()
    if "dm_control._render" in sys.modules:
        _correct_dm_control()


def choose() -> None:
    """Check that `MUJOCO_GL` works; replace a value set by `prefer_egl` with OSMesa if necessary.

    :raises RenderingError: if the value does not work here; names one that does
    """
    global _preferred_here
    asked = os.environ.get("MUJOCO_GL", "")
    if sys.platform != "linux" or asked == "":
        return
    _check_name(asked)
    if asked == "egl":
        _check_device()
    works = {"egl": _egl_works, "osmesa": _osmesa_works}.get(asked, _window_works)
    if works():
        return
    if asked in _WINDOW:
        raise RenderingError(
            f"MUJOCO_GL={asked} draws in a window, but there is no display that works: unset "
            "MUJOCO_GL, or set MUJOCO_GL=egl"
        )
    if not _preferred_here:
        raise RenderingError(
            f"MUJOCO_GL={asked} does not work here; unset it. {_INSTALL}{_suspects()}"
        )
    if not _osmesa_works():
        raise RenderingError(_INSTALL + _suspects())
    os.environ["MUJOCO_GL"], _preferred_here = "osmesa", False
    _agree_with_pyopengl()


def _check_name(asked: str) -> None:
    if asked in _NONE:
        raise RenderingError(
            f"MUJOCO_GL={asked} forbids drawing, which this package needs: unset MUJOCO_GL, or "
            "set MUJOCO_GL=egl"
        )
    valid = (*_OFF_SCREEN, *_WINDOW)
    if asked not in valid:
        near = difflib.get_close_matches(asked, valid, n=1, cutoff=0.5)
        hint = f" Did you mean {near[0]}?" if near else ""
        raise RenderingError(
            f"MUJOCO_GL={asked} is not known.{hint} There are: {', '.join(valid)}, or leave it "
            "unset"
        )


def _check_device() -> None:
    """Raise an error if EGL has no device with the number that is set."""
    asked = os.environ.get("MUJOCO_EGL_DEVICE_ID")
    if asked is None:
        return
    count = len(_egl_devices())
    if not asked.strip().isdecimal() or not int(asked) < count:
        there = f"a number from 0 to {count - 1}" if count else "no device at all"
        raise RenderingError(
            f"MUJOCO_EGL_DEVICE_ID={asked} is not an EGL device; EGL has {there} here: unset it, "
            "or set a number. EGL numbers the GPUs from 0 and has no names such as cuda:0"
        )


def _suspects() -> str:
    suspects = [f"{name}={os.environ[name]}" for name in _EGL_VARIABLES if os.environ.get(name)]
    return f" These variables may be the cause: {', '.join(suspects)}." if suspects else ""


# ---------------------------------------------------------------------------- which backends work


def _egl_library() -> ctypes.CDLL | None:
    try:
        egl = ctypes.CDLL("libEGL.so.1")
    except OSError:
        return None
    egl.eglGetProcAddress.restype = ctypes.c_void_p
    return egl


def _egl_devices() -> list[int]:
    """The handles of EGL's devices, queried from the library, which cannot abort the process."""
    egl = _egl_library()
    query = egl.eglGetProcAddress(b"eglQueryDevicesEXT") if egl is not None else None
    if not query:
        return []
    query_type = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_int, ctypes.c_void_p, ctypes.c_void_p)
    devices, count = (ctypes.c_void_p * 16)(), ctypes.c_int()
    query_type(query)(16, devices, ctypes.byref(count))
    return [device or 0 for device in devices[: count.value]]


def _egl_works() -> bool:
    """Return whether the chosen device opens, or any device if none is chosen."""
    egl, devices = _egl_library(), _egl_devices()
    get_display = egl.eglGetProcAddress(b"eglGetPlatformDisplayEXT") if egl is not None else None
    if egl is None or not get_display:
        return False
    display_type = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_int, ctypes.c_void_p, ctypes.c_void_p)
    egl.eglInitialize.argtypes = [ctypes.c_void_p] * 3
    asked = os.environ.get("MUJOCO_EGL_DEVICE_ID")
    return any(
        egl.eglInitialize(display_type(get_display)(_PLATFORM_DEVICE, device, None), None, None)
        for device in (devices if asked is None else [devices[int(asked)]])
    )


def _osmesa_works() -> bool:
    for name in ("libOSMesa.so.8", "libOSMesa.so.6", "libOSMesa.so"):
        try:
            ctypes.CDLL(name)
        except OSError:
            continue
        return True
    return False


def _window_works() -> bool:
    if not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        return False
    import glfw

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # glfw warns that there is no display
        return bool(glfw.init())


# ------------------------------------------------------------------- other libraries' choices


def _pyopengl_platform() -> str:
    return os.environ.get("PYOPENGL_PLATFORM", "").strip().lower()


def _agree_with_pyopengl() -> None:
    """Set `PYOPENGL_PLATFORM`, which MuJoCo uses, to the value of `MUJOCO_GL`."""
    asked = os.environ["MUJOCO_GL"]
    if asked in _OFF_SCREEN and _pyopengl_platform() not in ("", asked):
        os.environ["PYOPENGL_PLATFORM"] = asked


def _correct_dm_control() -> None:
    """Let dm_control choose again if it was imported first and settled on a window system.

    Otherwise its `physics.render` would fail without a display, or abort the process.
    """
    render = sys.modules["dm_control._render"]
    if render.BACKEND in _OFF_SCREEN or _window_works():
        return
    try:
        choose()
    except RuntimeError:
        return  # the first task or renderer of this package raises it again
    importlib.reload(render)
