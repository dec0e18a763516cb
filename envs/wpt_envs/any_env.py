"""The same observation, repeat and padding around any Gymnasium environment that renders."""

from typing import Any

import gymnasium as gym
import numpy as np

from wpt_envs.wrappers import dress


def pixels(
    env: gym.Env,
    *,
    image_size: int = 64,
    action_repeat: int = 1,
    pad_action_to: int | None = None,
    rendering: str | None = None,
    camera: str | int | dict[str, Any] = -1,
    state_in_info: bool = False,
    render_size: int | None = None,
) -> gym.Env:
    """`env` seen through its own `render()`, or drawn by this package's renderer.

    :param rendering: `exact`, `near` or `fast` draws a MuJoCo environment, one with `model`
        and `data`, several times quicker; `None` shrinks what `env.render()` answers
    :param camera: the camera to draw from; only together with `rendering`

    >>> env = wpt_envs.pixels(gym.make("Ant-v5", render_mode="rgb_array"))
    """
    return dress(
        _LookRendered(env) if rendering is None else _LookDrawn(env, rendering, camera),
        image_size=image_size,
        action_repeat=action_repeat,
        pad_action_to=pad_action_to,
        state_in_info=state_in_info,
        render_size=render_size,
    )


class _LookRendered(gym.Wrapper):
    """Looks by `env.render()`, shrunk by averaging over areas."""

    def __init__(self, env: gym.Env) -> None:
        super().__init__(env)
        if env.render_mode != "rgb_array":
            raise ValueError(
                f"{env} has render_mode={env.render_mode!r}; make it with render_mode='rgb_array'"
            )

    def look(self, size: int) -> np.ndarray:
        """The picture now: (size, size, 3) uint8."""
        image = np.asarray(self.env.render(), np.float32)
        rows, columns = _areas(image.shape[0], size), _areas(image.shape[1], size)
        image = np.einsum("ih,hwc,jw->ijc", rows, image, columns, optimize=True)
        return np.clip(np.rint(image), 0, 255).astype(np.uint8)


class _LookDrawn(gym.Wrapper):
    """Looks through a camera of this package's renderer."""

    def __init__(
        self, env: gym.Env, rendering: str, camera: str | int | dict[str, Any] = -1
    ) -> None:
        super().__init__(env)
        inner = env.unwrapped
        if not hasattr(inner, "model") or not hasattr(inner, "data"):
            raise ValueError(f"{env} is no MuJoCo environment; give rendering=None")
        from wpt_envs.rendering import View  # brings MuJoCo, which a CartPole does not need

        self._view = View(inner.model, inner.data, rendering, camera)

    def look(self, size: int) -> np.ndarray:
        """The picture now: (size, size, 3) uint8."""
        return self._view.look(size)

    def close(self) -> None:
        """Frees the GL contexts, then closes the environment."""
        self._view.close()
        super().close()


def _areas(pixels_in: int, pixels_out: int) -> np.ndarray:
    """(pixels_out, pixels_in): the share of each pixel in each of the new ones."""
    edges_in = np.linspace(0, 1, pixels_in + 1)
    edges = np.linspace(0, 1, pixels_out + 1)
    overlap = np.minimum(edges[1:, None], edges_in[1:]) - np.maximum(
        edges[:-1, None], edges_in[:-1]
    )
    return (np.clip(overlap, 0, None) * pixels_out).astype(np.float32)
