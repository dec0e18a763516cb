"""Chooses how to draw without a display. Import it before mujoco or dm_control.

On Linux with `MUJOCO_GL` unset MuJoCo asks for a window and, without a display, aborts the
process. So `MUJOCO_GL` becomes `egl` where EGL works and `osmesa` where only that is installed.
"""

import ctypes
import os
import sys

_INSTALL = (
    "No off-screen OpenGL: neither EGL nor OSMesa works on this machine. Install one, e.g. "
    "`apt-get install libegl1 libegl-mesa0 libgl1-mesa-dri` or `apt-get install libosmesa6`."
)
_PLATFORM_DEVICE = 0x313F  # EGL_PLATFORM_DEVICE_EXT


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


def choose() -> str:
    """Sets `MUJOCO_GL` where it is unset, and says what it is now."""
    # Mesa's software rasteriser reads this when first opened, which is below. At 64 x 64 its
    # threads cost more than they bring, and a forked process would wait for them for ever.
    os.environ.setdefault("LP_NUM_THREADS", "0")
    if "MUJOCO_GL" not in os.environ and sys.platform == "linux":
        if _egl_works():
            os.environ["MUJOCO_GL"] = "egl"
        elif _osmesa_works():
            os.environ["MUJOCO_GL"] = "osmesa"
        else:
            raise RuntimeError(_INSTALL)
    return os.environ.get("MUJOCO_GL", "")


choose()
