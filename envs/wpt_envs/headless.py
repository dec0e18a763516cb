"""Chooses how to draw without a display, before mujoco or dm_control is imported.

On Linux with `MUJOCO_GL` unset MuJoCo asks for a window and, without a display, aborts the
process. So importing this package sets it to `egl`, and the first task or renderer to `osmesa`
if EGL does not work and OSMesa is there.
"""

import ctypes
import os
import sys

_INSTALL = (
    "Drawing off screen needs EGL or OSMesa. If neither works, install one: "
    "`apt-get install libegl1 libegl-mesa0 libgl1-mesa-dri` or `apt-get install libosmesa6`."
)
_PLATFORM_DEVICE = 0x313F  # EGL_PLATFORM_DEVICE_EXT
_preferred_here = False


def _egl_works() -> bool:
    """Whether some EGL device opens; asked of the library itself, which cannot abort."""
    try:
        egl = ctypes.CDLL("libEGL.so.1")
    except OSError:
        return False
    egl.eglGetProcAddress.restype = ctypes.c_void_p
    query = egl.eglGetProcAddress(b"eglQueryDevicesEXT")
    get_display = egl.eglGetProcAddress(b"eglGetPlatformDisplayEXT")
    if not query or not get_display:
        return False
    query_type = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_int, ctypes.c_void_p, ctypes.c_void_p)
    display_type = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_int, ctypes.c_void_p, ctypes.c_void_p)
    devices, count = (ctypes.c_void_p * 16)(), ctypes.c_int()
    query_type(query)(16, devices, ctypes.byref(count))
    egl.eglInitialize.argtypes = [ctypes.c_void_p] * 3
    return any(
        egl.eglInitialize(display_type(get_display)(_PLATFORM_DEVICE, device, None), None, None)
        for device in devices[: count.value]
    )


def _osmesa_works() -> bool:
    for name in ("libOSMesa.so.8", "libOSMesa.so.6", "libOSMesa.so"):
        try:
            ctypes.CDLL(name)
        except OSError:
            continue
        return True
    return False


def prefer_egl() -> None:
    """Sets `MUJOCO_GL` to `egl` where the user left it unset; costs nothing."""
    global _preferred_here
    # Mesa's software rasteriser reads this when dm_control or MuJoCo first open it. At 64 x 64
    # its threads cost more than they bring, and a forked process would wait for them for ever.
    os.environ.setdefault("LP_NUM_THREADS", "0")
    if "MUJOCO_GL" not in os.environ and sys.platform == "linux":
        os.environ["MUJOCO_GL"], _preferred_here = "egl", True


def choose() -> None:
    """Tries out what is asked for; what `prefer_egl` set gives way to OSMesa if need be."""
    global _preferred_here
    asked = os.environ.get("MUJOCO_GL", "")
    works = {"egl": _egl_works, "osmesa": _osmesa_works}.get(asked)
    if works is None or works():
        return
    if not _preferred_here:
        raise RuntimeError(f"MUJOCO_GL={asked} does not work here; unset it. {_INSTALL}")
    if not _osmesa_works():
        raise RuntimeError(_INSTALL)
    os.environ["MUJOCO_GL"], _preferred_here = "osmesa", False
