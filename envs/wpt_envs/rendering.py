"""The renderer: pictures of a MuJoCo model at three levels of quality, from its own GL context."""

import os
import weakref
from collections.abc import Iterator
from contextlib import contextmanager
from copy import copy
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from wpt_envs.headless import choose
from wpt_envs.meshes import thin_meshes

choose()  # before MuJoCo reads MUJOCO_GL
import mujoco  # noqa: E402

from wpt_envs.contexts import current, free, new_context  # noqa: E402

_FLAGS = {
    "shadow": mujoco.mjtRndFlag.mjRND_SHADOW,
    "reflection": mujoco.mjtRndFlag.mjRND_REFLECTION,
}

Camera = str | int | dict[str, Any]  # a name, a number, or the free camera's attributes


@dataclass(frozen=True)
class Quality:
    """The settings of a rendering; None keeps the model's own setting."""

    samples: int | None = None  # multisampling
    supersample: int = 1  # the image is drawn larger by this factor, then averaged
    shadow_size: int | None = None  # texels of the shadow map
    tessellation: tuple[int, int, int] | None = None  # slices, stacks, quads of round shapes
    floor_spacing: float = 1  # widens the grid on which a floor is lit
    cell: float = 0  # side in metres of the cells in which vertices of a mesh are merged
    faces: int | None = None  # largest number of triangles of a mesh
    off: tuple[str, ...] = ()


QUALITIES = {
    "exact": Quality(),
    "near": Quality(
        samples=4,
        shadow_size=512,
        tessellation=(14, 7, 2),
        floor_spacing=1.4,
        cell=0.001,
        faces=2800,
    ),
    "fast": Quality(
        samples=0,
        supersample=2,
        shadow_size=0,
        tessellation=(10, 5, 1),
        floor_spacing=2,
        cell=0.005,
        faces=600,
        off=("shadow", "reflection"),
    ),
}


class Renderer:
    """Draw `data` from one camera, without any effect on the physics.

    The GL context is made at the first image, so that environments that never draw need none. It
    is current only while drawing, so that other renderers are not disturbed.

    :param camera: name or number of a camera of the model, -1 for the free camera, or a dict of
        attributes of the free camera, such as `distance`
    :param flip: flip the image upside down
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        data: mujoco.MjData,
        size: int = 64,
        rendering: str = "near",
        camera: Camera = -1,
        flip: bool = False,
    ) -> None:
        self._model, self._data, self._size = model, data, size
        self._quality = _quality(rendering)
        self._camera = _camera(model, camera)
        self._flip = flip
        self._gl: Any = None
        self._finalizer: weakref.finalize | None = None

    def render(self) -> np.ndarray:
        """Return the current image, (size, size, 3) uint8, the top row first."""
        if self._gl is None or self._process != os.getpid():  # a context does not survive a fork
            self._open()
        mujoco.mjv_updateScene(
            self._model,
            self._data,
            self._option,
            self._perturb,
            self._camera,
            mujoco.mjtCatBit.mjCAT_ALL,
            self._scene,
        )
        with current(self._gl):
            mujoco.mjr_render(self._viewport, self._scene, self._mjr)
            mujoco.mjr_readPixels(self._pixels, None, self._viewport, self._mjr)
        image = self._pixels if self._flip else self._pixels[::-1]  # GL's first row is the lowest
        return _shrink(image, self._quality.supersample)

    def upload_terrain(self) -> None:
        """Upload the model's height fields as they are now."""
        if self._gl is not None:
            with current(self._gl):
                for field_id in range(self._model.nhfield):
                    mujoco.mjr_uploadHField(self._model, self._mjr, field_id)

    def close(self) -> None:
        """Free the GL context; the next image makes a new one."""
        if self._finalizer is not None:
            self._finalizer()
            self._gl = self._mjr = self._finalizer = None

    def _open(self) -> None:
        side = self._size * self._quality.supersample
        self._viewport = mujoco.MjrRect(0, 0, side, side)
        self._pixels = np.empty((side, side, 3), np.uint8)
        self._option, self._perturb = mujoco.MjvOption(), mujoco.MjvPerturb()
        self._scene = mujoco.MjvScene(self._model, maxgeom=max(1000, 4 * self._model.ngeom))
        for name in self._quality.off:
            self._scene.flags[_FLAGS[name]] = 0
        self._gl = new_context(side)
        self._process = os.getpid()
        with current(self._gl), _lowered(self._model, self._quality, side):
            self._mjr = mujoco.MjrContext(self._model, mujoco.mjtFontScale.mjFONTSCALE_100)
            mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._mjr)
        self._finalizer = weakref.finalize(self, free, self._gl, self._mjr, self._process)


class View:
    """One camera of a model, with a renderer for each size of its pictures.

    :param upright: flip the image if the camera is mounted upside down
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        data: mujoco.MjData,
        rendering: str = "near",
        camera: Camera = -1,
        upright: bool = False,
    ) -> None:
        _quality(rendering)
        self.camera = camera
        fixed = _camera(model, camera).fixedcamid
        flip = upright and fixed >= 0 and _hangs(model, data, fixed)
        self._new = partial(Renderer, model, data, rendering=rendering, camera=camera, flip=flip)
        self._renderers: dict[int, Renderer] = {}

    def at(self, rendering: str) -> "View":
        """Return a view by the same camera at another rendering."""
        other = copy(self)
        other._new = partial(self._new, rendering=rendering)
        other._renderers = {}
        return other

    def look(self, size: int) -> np.ndarray:
        """Return the current image, (size, size, 3) uint8."""
        if size not in self._renderers:
            self._renderers[size] = self._new(size=size)
        return self._renderers[size].render()

    def upload_terrain(self) -> None:
        """Upload the model's height fields as they are now."""
        for renderer in self._renderers.values():
            renderer.upload_terrain()

    def close(self) -> None:
        """Free the GL contexts."""
        for renderer in self._renderers.values():
            renderer.close()


def _quality(rendering: str) -> Quality:
    if rendering not in QUALITIES:
        raise ValueError(f"No rendering {rendering!r}. There are: {', '.join(QUALITIES)}")
    return QUALITIES[rendering]


def _hangs(model: mujoco.MjModel, data: mujoco.MjData, camera: int) -> bool:
    """Return whether a camera's upward axis points down."""
    mujoco.mj_camlight(model, data)
    return data.cam_xmat[camera].reshape(3, 3)[2, 1] < 0


def _camera(model: mujoco.MjModel, camera: Camera) -> mujoco.MjvCamera:
    names = [model.camera(index).name for index in range(model.ncam)]
    view = mujoco.MjvCamera()
    if isinstance(camera, dict) or camera == -1:
        mujoco.mjv_defaultFreeCamera(model, view)
        for name, value in (camera if isinstance(camera, dict) else {}).items():
            setattr(view, name, value)
        return view
    if camera not in names and camera not in range(len(names)):
        raise ValueError(f"No camera {camera!r}. There are: -1 (free), {', '.join(names)}")
    view.type = mujoco.mjtCamera.mjCAMERA_FIXED
    view.fixedcamid = names.index(camera) if isinstance(camera, str) else camera
    return view


def _shrink(image: np.ndarray, factor: int) -> np.ndarray:
    """Average squares of `factor` x `factor` pixels into a new array."""
    if factor == 1:
        return image.copy()
    total = image[::factor, ::factor].astype(np.uint16)
    for offset in range(1, factor * factor):
        total += image[offset // factor :: factor, offset % factor :: factor]
    return ((total + factor * factor // 2) // (factor * factor)).astype(np.uint8)


# ------------------------------------------------------------------- cheaper uploads


@contextmanager
def _lowered(model: mujoco.MjModel, quality: Quality, side: int) -> Iterator[None]:
    """Lower the model's quality settings while a GL context is made, then restore them."""
    detail, window = model.vis.quality, model.vis.global_
    slices, stacks, quads = quality.tessellation or (None, None, None)
    numbers = [
        (window, "offwidth", side),
        (window, "offheight", side),
        (detail, "offsamples", quality.samples),
        (detail, "shadowsize", quality.shadow_size),
        (detail, "numslices", slices),
        (detail, "numstacks", stacks),
        (detail, "numquads", quads),
    ]
    names = ("geom_size", "mesh_vert", "mesh_facenum", "mesh_face", "mesh_facenormal")
    arrays = [getattr(model, name) for name in (*names, "mesh_facetexcoord")]
    kept_numbers = [(part, name, getattr(part, name)) for part, name, _ in numbers]
    kept_arrays = [array.copy() for array in arrays]
    try:
        for part, name, value in numbers:
            if value is not None:
                setattr(part, name, value)
        floors = model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE
        model.geom_size[floors, 2] *= quality.floor_spacing
        if quality.faces is not None:
            thin_meshes(model, quality.cell, quality.faces)
        yield
    finally:
        for part, name, value in kept_numbers:
            setattr(part, name, value)
        for array, value in zip(arrays, kept_arrays, strict=True):
            array[:] = value
