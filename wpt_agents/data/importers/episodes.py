"""The base of all readers of other data formats: options, and conversion of images and actions."""

import io
import warnings
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Sequence
from importlib import import_module
from typing import Any

import numpy as np

from wpt_agents.data.images import Resizer
from wpt_agents.data.importers.keys import as_bytes, is_encoded
from wpt_agents.data.trajectory import IMAGE_SIZE, Trajectory, check_finite
from wpt_agents.data.units import both_limits, rescaled


class Episodes(ABC):
    """Episodes in a fixed order, each read and converted when it is accessed.

    Episodes with a single image contain no action and are skipped with a warning.

    :param image_size: height and width to resize to
    :param rewards: whether to keep the rewards; pre-training needs none
    :param embodiment: the robot's name, for all episodes
    :param task: the task, for all episodes
    :param image_key: the name of the images or of the camera; required if the format's usual name
        is missing or if there are several
    :param action_key: the name of the actions, or several names whose arrays are concatenated in
        that order; in a string, they are separated by commas
    :param done_key: the name of the flags that mark the end of an episode; if the format itself
        separates episodes, the name of the flag that marks a terminal state
    :param low: (A,) or one number: the actions' lowest values, if they are not in [-1, 1]
    :param high: (A,) or one number: their highest values
    :param crop: cut out the middle square of images that are not square, instead of squeezing them
    :ivar name: where the data come from, for messages
    """

    name = "The data"

    def __init__(
        self,
        image_size: int = IMAGE_SIZE,
        rewards: bool = False,
        embodiment: str | None = None,
        task: str | None = None,
        image_key: str | None = None,
        action_key: str | Sequence[str] | None = None,
        done_key: str | None = None,
        low: float | Sequence[float] | np.ndarray | None = None,
        high: float | Sequence[float] | np.ndarray | None = None,
        crop: bool = False,
    ) -> None:
        self.image_size = image_size
        self.rewards = rewards
        self.embodiment = embodiment
        self.task = task
        self.image_key = image_key
        self.action_keys = as_keys(action_key)
        self.done_key = done_key
        self.limits = both_limits(low, high)
        self._resize = Resizer(image_size, crop, "pass crop=True (--crop)", cut="")
        self._warned_of_clipping = False

    @abstractmethod
    def __len__(self) -> int:
        """The number of episodes."""

    @abstractmethod
    def __getitem__(self, i: int) -> Trajectory:
        """Return episode `i`, 0 <= i < len.

        :raises ValueError: if it cannot be read or converted; names the file and the remedy
        """

    def __iter__(self) -> Iterator[Trajectory]:
        return (self[i] for i in range(len(self)))

    def number(self, i: int) -> int:
        """Return the number by which `skip` leaves episode `i` out."""
        return i

    def _trajectory(
        self,
        image: np.ndarray,
        action: np.ndarray,
        reward: np.ndarray | None,
        source: str,
        limits: tuple[np.ndarray, np.ndarray] | None = None,
        **labels: Any,
    ) -> Trajectory:
        """Check and convert an episode in our convention: (T + 1, ...), (T, A) and (T,).

        :param limits: the format's action limits; the user's limits take precedence
        """
        try:
            action = as_actions(action)
            limits = self._limits_of(action) or limits
            if limits is not None:
                check_finite(action)  # infinity would be clipped to a limit
                self._check_limits(action, *limits)
            return Trajectory(
                image=as_images(image, self._resize),
                action=action if limits is None else rescaled(action, *limits),
                reward=None if reward is None or not self.rewards else np.ravel(reward),
                source=source,
                bounds=None if limits is None else np.stack(limits),
                **{"embodiment": self.embodiment, "task": self.task, **labels},
            )
        except ValueError as error:
            raise ValueError(f"{source}: {error}") from error

    def _limits_of(self, action: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
        """Return the user's limits, one for each dimension of `action`; None if there are none."""
        if self.limits is None:
            return None
        width = action.shape[1]
        low, high = (np.repeat(x, width) if x.shape == (1,) else x for x in self.limits)
        return low, high

    def _check_limits(self, action: np.ndarray, low: np.ndarray, high: np.ndarray) -> None:
        """Warn once if actions lie outside the limits: they are clipped."""
        if self._warned_of_clipping or action.shape[1:] != low.shape or low.shape != high.shape:
            return
        slack = 1e-3 * (high - low)  # do not warn about rounding errors of measured actions
        outside = ((action < low - slack) | (action > high + slack)).any(0)
        if outside.any():
            self._warned_of_clipping = True
            i = int(np.flatnonzero(outside)[0])
            warnings.warn(
                f"{self.name}: actions in dimension {i} run from {action[:, i].min():.4g} to "
                f"{action[:, i].max():.4g}, beyond the limits {low[i]:.4g} to {high[i]:.4g}, and "
                "are clipped to them",
                stacklevel=5,
            )

    def _refuse_done_key(self, form: str) -> None:
        if self.done_key is not None:
            raise ValueError(f"{form} stores where episodes end; leave done_key out")


class Without(Episodes):
    """The episodes of a source without some of them.

    :param skip: the numbers of the episodes to leave out, counted from 0
    :raises ValueError: if there is no episode of such a number
    """

    def __init__(self, episodes: Episodes, skip: Iterable[int]) -> None:
        super().__init__(episodes.image_size)
        self.name = episodes.name
        self._episodes = episodes
        gone = {int(i) for i in skip}
        strange = sorted(gone - set(range(len(episodes))))
        if strange:
            raise ValueError(
                f"skip names the episode {strange[0]}, but there are {len(episodes)}, counted from "
                "0"
            )
        self._kept = [i for i in range(len(episodes)) if i not in gone]

    def __len__(self) -> int:
        return len(self._kept)

    def __getitem__(self, i: int) -> Trajectory:
        return self._episodes[self._kept[i]]

    def number(self, i: int) -> int:
        """Return the number of episode `i` in the source."""
        return self._kept[i]


def as_keys(names: str | Sequence[str] | None) -> tuple[str, ...]:
    """Return names of arrays as a tuple; a string may contain several, separated by commas."""
    if names is None:
        return ()
    parts = names.split(",") if isinstance(names, str) else names
    return tuple(part.strip() for part in parts)


def warn_left_out(count: int, source: object) -> None:
    """Warn about episodes with a single image, which a reader skips."""
    if count:
        warnings.warn(
            f"{source}: {count} episode{'s' * (count > 1)} of a single image left out, because "
            "no image shows the outcome of an action",
            stacklevel=3,
        )


def needs(module: str, what: str) -> Any:
    """Import an optional package, or raise an error that says how to install it."""
    try:
        return import_module(module)
    except ImportError as error:
        package = module.split(".")[0]
        raise ImportError(f"Reading {what} needs {package}: pip install {package}") from error


def as_actions(action: np.ndarray) -> np.ndarray:
    """Return actions as (T, A) floats.

    :raises ValueError: if it is not an array of continuous actions
    """
    action = np.asarray(action)
    if action.ndim == 1 and action.dtype.kind in "iub":
        raise ValueError(
            f"the action of a step is one whole number ({action.dtype}), as for discrete actions; "
            "WPT needs continuous actions of shape (T, A)"
        )
    if action.ndim == 1:
        action = action[:, None]  # a single actuator
    if action.ndim != 2 or action.dtype.kind not in "fiub":
        raise ValueError(f"actions must be numbers (T, A), got {action.shape} {action.dtype}")
    return np.ascontiguousarray(action, np.float32 if action.dtype == np.float32 else np.float64)


def as_images(image: np.ndarray, resize: Resizer) -> np.ndarray:
    """Return resized colour images; of stacked frames, only the newest.

    :param image: (N, H, W, 3 k) or (N, 3 k, H, W) uint8, or whole numbers 0 .. 255 as floats; or N
        PNG or JPEG files, as in `is_encoded`
    :return: (N, S, S, 3) uint8
    :raises ValueError: if it is anything else; names shape, dtype or range, and the remedy
    """
    image = np.asarray(image)
    if is_encoded(image):
        return decoded((as_bytes(row) for row in image), resize)
    if image.ndim == 3 and image.dtype == np.uint8:
        raise ValueError(
            f"the images are {image.shape} without a channel axis: grayscale? Repeat them, "
            "np.repeat(image[..., None], 3, axis=-1)"
        )
    if image.ndim != 4:
        raise ValueError(
            f"the observations are {image.shape} {image.dtype}, not (N, H, W, 3) uint8 images; "
            "name the images' key, image_key (--image-key), or render the states first"
        )
    # The axis that is smaller than the others is the channel axis.
    axis = 1 if image.shape[1] < min(image.shape[2:]) else -1
    _check_channels(image, axis)
    return resize(np.moveaxis(_as_bytes(image), axis, -1)[..., -3:])


def decoded(pictures: Iterable[bytes], resize: Resizer) -> np.ndarray:
    """Return PNG or JPEG files as images, each resized as soon as it is decoded.

    :return: (N, S, S, 3) uint8
    :raises ValueError: if one cannot be decoded
    """
    reader = needs("PIL.Image", "encoded images")
    images: list[np.ndarray] = []
    for data in pictures:
        try:
            picture = np.array(reader.open(io.BytesIO(data)).convert("RGB"))
        except (OSError, SyntaxError) as error:
            raise ValueError(f"one of its images is damaged: {error}") from error
        images.append(resize(picture[None]))
    return np.concatenate(images)


def _check_channels(image: np.ndarray, axis: int) -> None:
    channels = image.shape[axis]
    if channels % 3 == 0:
        return
    problem = f"the images have {channels} channels ({image.shape}), colour needs 3"
    first = "image[:, :{}]" if axis == 1 else "image[..., :{}]"
    remedies = {
        1: f"grayscale? Repeat it, np.repeat(image, 3, axis={axis})",
        2: f"grayscale with alpha? Take np.repeat({first.format(1)}, 3, axis={axis})",
        4: f"RGBA? Drop the alpha channel, {first.format(3)}",
    }
    other = "the axes must be (N, H, W, 3) or (N, 3, H, W)"
    raise ValueError(f"{problem}: {remedies.get(channels, other)}")


def _as_bytes(image: np.ndarray) -> np.ndarray:
    """Return the images as uint8; floats are accepted only if they are whole numbers 0 .. 255."""
    if image.dtype == np.uint8:
        return image
    least, most = float(image.min()), float(image.max())
    if not np.isfinite([least, most]).all():
        raise ValueError("the images hold NaN or infinity; leave that episode out")
    whole = image.dtype.kind in "fiu" and 0 <= least and (1 < most <= 255 or most == 0)
    if whole and np.array_equal(image, np.rint(image)):
        return image.astype(np.uint8)  # Diffusion Policy stores bytes as float32
    scale = "255 * image" if 0 <= least and most <= 1 else "(image - low) / (high - low) * 255"
    raise ValueError(
        f"the images are {image.dtype} from {least:.4g} to {most:.4g}, not uint8 from 0 to 255; "
        f"store np.rint({scale}).astype(np.uint8)"
    )
