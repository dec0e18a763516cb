"""`pixels`: image observations for any Gymnasium environment that renders."""

from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.utils import RecordConstructorArgs

from wpt_envs.pictures import PictureReader, shrink
from wpt_envs.simulation import find_simulation, model_and_data, usual_camera
from wpt_envs.wrappers import dress

if TYPE_CHECKING:
    from wpt_envs.rendering import Camera, View


def pixels(
    env: gym.Env,
    *,
    image_size: int = 64,
    action_repeat: int = 1,
    pad_action_to: int | None = None,
    rendering: str | None = None,
    camera: "Camera | None" = None,
    image_key: str | None = None,
    crop: bool = False,
    state_in_info: bool = False,
    render_size: int | None = None,
) -> gym.Env:
    """Wrap an environment so that its observations are images of (image_size, image_size, 3) uint8.

    The images come from its own `render()`, from an entry of its Dict observations (`image_key`),
    or from this package's renderer of MuJoCo simulations (`rendering`).

    :param env: any Gymnasium environment
    :param image_size: side of the observed image, to which larger images are shrunk
    :param action_repeat: steps of `env` in one step, their rewards summed
    :param pad_action_to: width to which actions are padded
    :param rendering: `exact`, `near` or `fast` draws a MuJoCo environment several times faster
        than its own `render()`
    :param camera: name, number or attributes of the camera to draw from, only together with
        `rendering`; the environment's own if None
    :param image_key: the entry of Dict observations to use as the image instead of `render()`
    :param crop: crop images that are not square to the middle square; if False, they are squeezed
        with a warning. With `rendering`, images are always square
    :param state_in_info: put the observation of `env` into `info["state"]`
    :param render_size: side of what `render()` returns; the last observation if None
    :raises ValueError: if the environment cannot provide such images

    >>> env = wpt_envs.pixels(gym.make("Ant-v5", render_mode="rgb_array"))
    """
    return dress(
        _looked_at(env, rendering, camera, image_key, crop),
        image_size=image_size,
        action_repeat=action_repeat,
        pad_action_to=pad_action_to,
        state_in_info=state_in_info,
        render_size=render_size,
    )


def _looked_at(
    env: gym.Env,
    rendering: str | None,
    camera: "Camera | None",
    image_key: str | None,
    crop: bool,
) -> gym.Env:
    if not isinstance(env, gym.Env):
        raise ValueError(f"pixels wraps one Gymnasium environment, not {_instead(env)}")
    if rendering is None and camera is not None:
        raise ValueError(f"camera={camera!r} needs our renderer: add rendering='near', for example")
    if image_key is not None:
        if rendering is not None:
            raise ValueError("image_key and rendering both choose the image: pass only one of them")
        return _LookObserved(env, image_key, crop)
    if rendering is None:
        return _LookRendered(env, crop)
    if crop:
        raise ValueError(f"rendering={rendering!r} draws square images: leave crop out")
    return _LookDrawn(env, rendering, camera)


def _instead(env: Any) -> str:
    """Describe an argument that is not an environment, and how to make it one."""
    if isinstance(env, str):
        return f"an id: `env = wpt_envs.pixels(gymnasium.make({env!r}, render_mode='rgb_array'))`"
    if hasattr(env, "num_envs"):
        return (
            f"the vector {type(env).__name__}: wrap each environment in it, for example by "
            "gymnasium.make_vec(..., render_mode='rgb_array', wrappers=[wpt_envs.pixels])"
        )
    if hasattr(env, "action_spec") and hasattr(env, "physics"):
        return (
            "a dm_env: "
            "`env = wpt_envs.pixels(shimmy.DmControlCompatibilityV0(env, render_mode='rgb_array', "
            "render_kwargs={'height': 64, 'width': 64}))`"
        )
    return f"a {type(env).__name__}"


class _LookRendered(gym.Wrapper, RecordConstructorArgs):
    """Take images from `env.render()`."""

    def __init__(self, env: gym.Env, crop: bool = False) -> None:
        RecordConstructorArgs.__init__(self, crop=crop)
        gym.Wrapper.__init__(self, env)
        if env.render_mode != "rgb_array":
            raise ValueError(
                f"{env} has render_mode={env.render_mode!r}; make it with render_mode='rgb_array'"
            )
        source = f"render() of {env}"
        self._reader = PictureReader(source, "make it with render_mode='rgb_array'", crop)

    def look(self, size: int) -> np.ndarray:
        """Return the current image, (size, size, 3) uint8."""
        return shrink(self._reader.read(self.env.render()), size)


class _LookObserved(gym.Wrapper, RecordConstructorArgs):
    """Take images from one entry of the Dict observations."""

    def __init__(self, env: gym.Env, image_key: str, crop: bool = False) -> None:
        RecordConstructorArgs.__init__(self, image_key=image_key, crop=crop)
        gym.Wrapper.__init__(self, env)
        space = env.observation_space
        if not isinstance(space, spaces.Dict):
            raise ValueError(
                f"image_key={image_key!r} chooses from Dict observations, but those of {env} are "
                f"{space}: omit image_key"
            )
        if image_key not in space.spaces:
            names = ", ".join(map(repr, space.spaces))
            raise ValueError(
                f"No entry {image_key!r} in the observations of {env}. There are: {names}"
            )
        self._key, self._seen = image_key, np.zeros((1, 1, 3), np.uint8)
        source = f"The observation {image_key!r} of {env}"
        self._reader = PictureReader(source, "choose another image_key", crop)

    def reset(self, **kwargs: Any) -> tuple[Any, dict[str, Any]]:
        """Start an episode and store its first image."""
        observation, info = self.env.reset(**kwargs)
        self._seen = self._reader.read(observation[self._key])
        return observation, info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Take a step and store the image after it."""
        observation, *outcome = self.env.step(action)
        self._seen = self._reader.read(observation[self._key])
        return observation, *outcome

    def look(self, size: int) -> np.ndarray:
        """Return the current image, (size, size, 3) uint8."""
        return shrink(self._seen, size)


class _LookDrawn(gym.Wrapper, RecordConstructorArgs):
    """Draw images with this package's renderer."""

    def __init__(self, env: gym.Env, rendering: str, camera: "Camera | None" = None) -> None:
        RecordConstructorArgs.__init__(self, rendering=rendering, camera=camera)
        gym.Wrapper.__init__(self, env)
        self._simulation = find_simulation(env.unwrapped)
        if self._simulation is None:
            raise ValueError(
                f"rendering={rendering!r} needs a MuJoCo simulation, and none was found in {env}: "
                "leave rendering out to use the image that its render() returns"
            )
        self._rendering, self._camera = rendering, camera
        self._view: View | None = None
        self._model: Any = None
        self._open()  # fails early on an unknown rendering or camera
        self._model = None  # the default camera looks at the middle of the first image

    def _open(self) -> "View":
        """The view of the simulation, a new one where the environment has made a new model."""
        from wpt_envs.rendering import View  # imports MuJoCo, which CartPole does not need

        simulation = model_and_data(self._simulation)
        assert simulation is not None, self._simulation
        model, data = simulation
        if self._view is None or model is not self._model:
            if self._view is not None:
                self._view.close()
            camera = self._camera
            if camera is None:
                camera = usual_camera(self.env.unwrapped, model, data)
            self._view, self._model = View(model, data, self._rendering, camera), model
        return self._view

    def reset(self, **kwargs: Any) -> tuple[Any, dict[str, Any]]:
        """Start an episode, for which the environment may have made a simulation or a terrain."""
        observation, info = self.env.reset(**kwargs)
        simulation = find_simulation(self.env.unwrapped)
        if simulation is not None:
            self._simulation = simulation
        if self._view is not None:
            self._view.upload_terrain()
        return observation, info

    def look(self, size: int) -> np.ndarray:
        """Return the current image, (size, size, 3) uint8."""
        return self._open().look(size)

    def close(self) -> None:
        """Free the GL contexts, then close the environment."""
        if self._view is not None:
            self._view.close()
        super().close()
