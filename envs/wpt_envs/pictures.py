"""Check images that environments return, convert them to (H, W, 3) uint8, and shrink them."""

import warnings
from typing import Any

import numpy as np


class PictureReader:
    """Convert the images that one environment returns into (H, W, 3) uint8.

    uint8 images are kept, other integers must be in [0, 255]. Floats are in [0, 1] or in
    [0, 255]: the first image that is not black decides for all that follow.

    :param source: the source of the images, for messages, such as "render() of <CarRacing>"
    :param remedy: what the user can do if there is no image
    :param crop: cut out the middle square; otherwise the first image that is not square causes a
        warning, because `shrink` will squeeze it
    """

    def __init__(self, source: str, remedy: str, crop: bool = False) -> None:
        self.source = source
        self.remedy = remedy
        self.crop = crop
        self._scale: float | None = None  # of floats, once it is known
        self._warned = False

    def read(self, picture: Any) -> np.ndarray:
        """Check and convert one image.

        :param picture: (H, W, 3), or with one or four channels, or with channels first
        :return: (H, W, 3) uint8, a view where nothing had to be converted; with `crop`, H = W
        :raises ValueError: if it is anything else
        """
        if picture is None or isinstance(picture, str | bytes | dict):
            what = "None" if picture is None else f"a {type(picture).__name__}"
            raise ValueError(f"{self.source} returned {what}, not a picture: {self.remedy}")
        if isinstance(picture, list | tuple):
            raise ValueError(
                f"{self.source} returned a {type(picture).__name__} of {len(picture)}, not one "
                f"picture as an array: return its last entry, or {self.remedy}"
            )
        array = self._colour(np.asarray(picture))
        if self.crop:
            array = middle_square(array)
        else:
            self._warn_of_squeezing(*array.shape[:2])
        return self._bytes(array)

    def _warn_of_squeezing(self, height: int, width: int) -> None:
        if height == width or self._warned:
            return
        self._warned = True
        ratio = max(height, width) / min(height, width)
        warnings.warn(
            f"{self.source} returned pictures of {height} x {width}, which are squeezed to a "
            f"square; this distorts shapes by a factor of {ratio:.2f}. Pass crop=True to pixels() "
            "to cut out the middle square instead, or let the environment draw squares",
            stacklevel=5,
        )

    def _colour(self, array: np.ndarray) -> np.ndarray:
        """Return the image with three channels, which come last."""
        if array.ndim == 2:
            array = array[..., None]
        if array.ndim == 3 and array.shape[-1] not in (1, 3, 4) and array.shape[0] in (1, 3, 4):
            array = array.transpose(1, 2, 0)
        if array.ndim != 3 or array.shape[-1] not in (1, 3, 4) or array.size == 0:
            raise ValueError(
                f"{self.source} returned an array of shape {array.shape}: a picture is (H, W, 3), "
                "in grayscale (H, W) or (H, W, 1), with transparency (H, W, 4)"
            )
        return np.repeat(array, 3, -1) if array.shape[-1] == 1 else array[..., :3]

    def _bytes(self, array: np.ndarray) -> np.ndarray:
        if array.dtype == np.uint8:
            return array
        if array.dtype == bool:
            return array * np.uint8(255)
        if not np.issubdtype(array.dtype, np.integer) and not np.issubdtype(
            array.dtype, np.floating
        ):
            raise ValueError(f"{self.source} returned an array of {array.dtype}, not of numbers")
        low, high = float(array.min()), float(array.max())
        scale = self._scale_of(array.dtype, high)
        if not (low >= 0 and high * scale <= 255.5):  # also rejects NaN
            ends = "[0, 1]" if scale == 255 else "[0, 255]"
            raise ValueError(
                f"{self.source} returned {array.dtype} values from {low:.4g} to {high:.4g}, beyond "
                f"{ends}: return uint8, 0 for black and 255 for white"
            )
        return np.rint(array * scale).astype(np.uint8)

    def _scale_of(self, dtype: np.dtype, high: float) -> float:
        if np.issubdtype(dtype, np.integer):
            return 1.0
        if self._scale is None and high > 0:
            self._scale = 255.0 if high <= 1 else 1.0
        return self._scale or 1.0


def middle_square(picture: np.ndarray) -> np.ndarray:
    """Cut out the square in the middle: (H, W, 3) -> (S, S, 3) with S = min(H, W), a view."""
    height, width = picture.shape[:2]
    side = min(height, width)
    top = (height - side) // 2
    left = (width - side) // 2
    return picture[top : top + side, left : left + side]


def shrink(picture: np.ndarray, size: int) -> np.ndarray:
    """Shrink by averaging areas, which keeps thin lines. Images that are not square are squeezed.

    :param picture: (H, W, 3) uint8
    :return: (size, size, 3) uint8
    """
    rows, columns = _areas(picture.shape[0], size), _areas(picture.shape[1], size)
    image = np.einsum("ih,hwc,jw->ijc", rows, np.float32(picture), columns, optimize=True)
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


def _areas(pixels_in: int, pixels_out: int) -> np.ndarray:
    """(pixels_out, pixels_in): the share of each old pixel in each new one."""
    edges_in = np.linspace(0, 1, pixels_in + 1)
    edges = np.linspace(0, 1, pixels_out + 1)
    overlap = np.minimum(edges[1:, None], edges_in[1:]) - np.maximum(
        edges[:-1, None], edges_in[:-1]
    )
    return (np.clip(overlap, 0, None) * pixels_out).astype(np.float32)
