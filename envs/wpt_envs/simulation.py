"""Find the MuJoCo simulation inside any environment, and the camera that it renders with."""

import sys
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    import mujoco

    from wpt_envs.rendering import Camera

DEPTH = 4  # depth of the search in attributes: env._env._physics is 2


def find_simulation(env: Any) -> Any | None:
    """Return the object that holds model and data, the nearest one, or None.

    It is Gymnasium's MujocoEnv, dm_control's Physics, robosuite's MjSim or a similar object, in an
    attribute of the environment or in an attribute of an attribute.
    """
    if "mujoco" not in sys.modules:
        return None
    layer, seen = [env], {id(env)}
    for _ in range(DEPTH):
        for candidate in layer:
            if model_and_data(candidate) is not None:
                return candidate
        layer = [inner for outer in layer for inner in _attributes(outer, seen)]
    return None


def model_and_data(holder: Any) -> "tuple[mujoco.MjModel, mujoco.MjData] | None":
    """Return MuJoCo's own model and data of an object, or None if it holds none."""
    import mujoco

    attributes = getattr(holder, "__dict__", {})
    if not ({"model", "_model"} & attributes.keys() or hasattr(type(holder), "model")):
        return None
    model, data = getattr(holder, "model", None), getattr(holder, "data", None)
    model, data = _raw(model, mujoco.MjModel), _raw(data, mujoco.MjData)
    return None if model is None or data is None else (model, data)


def _raw(wrapper: Any, kind: type) -> Any:
    """Return MuJoCo's own object behind dm_control's wrapper (`ptr`) or robosuite's (`_model`)."""
    for value in (wrapper, *(getattr(wrapper, name, None) for name in ("ptr", "_model", "_data"))):
        if isinstance(value, kind):
            return value
    return None


def _attributes(holder: Any, seen: set[int]) -> Iterator[Any]:
    """The objects in a holder's attributes that have attributes themselves, each once."""
    for value in vars(holder).values():
        for inner in value if isinstance(value, list | tuple) else (value,):
            plain = isinstance(inner, type | np.ndarray) or type(inner).__module__ == "builtins"
            if not plain and hasattr(inner, "__dict__") and id(inner) not in seen:
                seen.add(id(inner))
                yield inner


def usual_camera(env: Any, model: "mujoco.MjModel", data: "mujoco.MjData") -> "Camera":
    """Return the camera that an environment renders with, -1 (free) if it names none.

    Gymnasium's renderer takes a camera of the model, or else the free camera with the environment's
    own settings, looking at the middle of all shapes.

    :param data: the pose whose middle the camera looks at; Gymnasium uses that of the first image
    """
    renderer = getattr(env, "mujoco_renderer", None)
    if renderer is None:
        return -1
    if renderer.camera_id is not None and renderer.camera_id >= 0:
        return int(renderer.camera_id)
    import mujoco

    free = mujoco.MjvCamera()  # with MuJoCo's settings, not the model's, as in Gymnasium
    settings = {name: getattr(free, name) for name in ("azimuth", "elevation")}
    settings |= {"distance": model.stat.extent, "lookat": np.median(data.geom_xpos, axis=0)}
    return settings | (renderer.default_cam_config or {})


def fixed_usual_camera(env: Any, model: "mujoco.MjModel") -> "Camera":
    """Return the same camera, looking at the middle of the model's own pose in every episode."""
    import mujoco

    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return usual_camera(env, model, data)
