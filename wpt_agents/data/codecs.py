"""The codecs of image blocks: lossless (zstd, raw), or JPEG for noisy cameras."""

from collections.abc import Callable
from dataclasses import dataclass
from io import BytesIO

import numpy as np
import zstandard

from wpt_agents.files.names import unknown_name

JPEG_QUALITY = 95  # of 100; about a fourth of the images' size


@dataclass(frozen=True)
class Codec:
    """A way to store images, (n, S, S, 3) uint8, followed by a vector of bytes.

    :param encode: images and vector -> the stored bytes
    :param decode: the stored bytes and the size of the vector -> the images' bytes, followed by
        the vector's
    """

    encode: Callable[[np.ndarray, bytes], bytes]
    decode: Callable[[memoryview, int], bytes | memoryview]
    lossless: bool = True


def _to_jpeg(images: np.ndarray, vector: bytes) -> bytes:
    """Encode one tall picture of all images: separate headers would take a third more space."""
    from PIL import Image

    stream = BytesIO()
    tall = Image.fromarray(np.ascontiguousarray(images).reshape(-1, images.shape[2], 3))
    # subsampling=0 keeps the full resolution of colours, of which 64 pixels have little to lose.
    tall.save(stream, "JPEG", quality=JPEG_QUALITY, subsampling=0)
    return stream.getvalue() + vector


def _from_jpeg(stored: memoryview, size: int) -> bytes:
    from PIL import Image

    end = len(stored) - size
    return np.asarray(Image.open(BytesIO(stored[:end]))).tobytes() + stored[end:]


CODECS = {
    "jpeg": Codec(_to_jpeg, _from_jpeg, lossless=False),
    "raw": Codec(lambda images, vector: images.tobytes() + vector, lambda stored, size: stored),
    "zstd": Codec(
        # 3 is zstd's own default level
        lambda images, vector: zstandard.ZstdCompressor(3).compress(images.tobytes() + vector),
        lambda stored, size: zstandard.ZstdDecompressor().decompress(stored),
    ),
}


def find_codec(name: str) -> Codec:
    """Return the codec of this name.

    :raises ValueError: there is no such codec
    """
    if name not in CODECS:
        raise unknown_name("codec", name, CODECS)
    return CODECS[name]
