"""The one place where images are resized to the size that a model sees."""

import warnings
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

CHUNK = 64  # images that are converted to floats at once


def resized(images: np.ndarray, size: int) -> np.ndarray:
    """Resize images to a square by averaging over the area that each new pixel covers.

    Images that are not square are squeezed. Averaging over areas is free of aliasing, and small
    objects keep their share of brightness.

    :param images: (N, H, W, 3) uint8
    :return: (N, size, size, 3) uint8
    """
    _, height, width, channels = images.shape
    rows, columns = area_weights(height, size), area_weights(width, size)
    parts = [np.zeros((0, size, size, channels), np.uint8)]  # the answer to no images
    chunk = max(1, CHUNK * 256**2 // max(height * width, 256**2))  # fewer images if they are large
    for at in range(0, len(images), chunk):
        # writable, because torch warns of read-only arrays, such as those of a file
        piece = np.require(images[at : at + chunk], requirements=("C", "W"))
        pixels = torch.from_numpy(piece).float()
        count = len(pixels)
        # The average over an area separates into one product for each axis.
        pixels = rows @ pixels.reshape(count, height, width * channels)
        pixels = columns @ pixels.reshape(count, size, width, channels)
        parts.append(pixels.round().clamp(0, 255).byte().numpy())
    return np.concatenate(parts)


@lru_cache(maxsize=32)
def area_weights(old: int, new: int) -> Tensor:
    """Return the share of each old pixel in each new one along an axis: (new, old)."""
    edges = torch.arange(new + 1, dtype=torch.float64) * old / new
    pixel = torch.arange(old, dtype=torch.float64)
    overlap = torch.minimum(edges[1:, None], pixel + 1) - torch.maximum(edges[:-1, None], pixel)
    # computed in float64, so that the rows sum to 1 after rounding
    return (overlap.clamp(min=0) * new / old).float()


def middle_square(images: np.ndarray) -> np.ndarray:
    """Cut out the middle square of images: (N, H, W, 3) -> (N, S, S, 3) with S = min(H, W)."""
    rows, columns = middle(*images.shape[1:3])
    return images[:, rows, columns]


def middle(height: int, width: int) -> tuple[slice, slice]:
    """Return the rows and columns of the square in the middle of an image."""
    side = min(height, width)
    top = (height - side) // 2
    left = (width - side) // 2
    return slice(top, top + side), slice(left, left + side)


def resize_message(
    height: int, width: int, size: int, crop_option: str = "", cut: str | None = None
) -> str:
    """Return the warning that images are resized, with advice how to keep their proportions.

    :param crop_option: the caller's option for cutting out the middle, if there is one
    :param cut: code that cuts out the middle; None for that of channels-last images, "" for none,
        because the images may be laid out differently
    """
    if height == width:
        return f"Images of {height} x {width} are resized to {size} x {size}"
    rows, columns = middle(height, width)
    if cut is None:
        cut = f"image[..., {rows.start}:{rows.stop}, {columns.start}:{columns.stop}, :]"
    ratio = max(height, width) / min(height, width)
    ways = [f"cut the middle out first: {cut}"] if cut else []
    ways += [crop_option] if crop_option else []
    return (
        f"Images of {height} x {width} are squeezed to {size} x {size}, which distorts shapes by a "
        f"factor of {ratio:.2f}; to keep the proportions, {', or '.join(ways)}"
    )


class Resizer:
    """Resize images to one size, and warn once for each original shape.

    :param size: height and width of the result
    :param crop: cut out the middle square instead of squeezing
    :param crop_option: the user's option for `crop`, for the warning
    :param cut: of `resize_message`
    """

    def __init__(
        self, size: int, crop: bool = False, crop_option: str = "", cut: str | None = None
    ) -> None:
        self.size, self.crop, self._crop_option, self._cut = size, crop, crop_option, cut
        self._warned: set[tuple[int, int]] = set()

    def __call__(self, images: np.ndarray) -> np.ndarray:
        """Resize images: (N, H, W, 3) uint8 -> (N, size, size, 3) uint8."""
        if self.crop:
            images = middle_square(images)
        height, width = images.shape[1:3]
        if (height, width) == (self.size, self.size):
            return np.ascontiguousarray(images)
        if (height, width) not in self._warned:
            self._warned.add((height, width))
            message = resize_message(height, width, self.size, self._crop_option, self._cut)
            warnings.warn(message, stacklevel=3)
        return resized(images, self.size)
