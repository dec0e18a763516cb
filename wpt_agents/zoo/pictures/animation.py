"""A GIF of an episode with true and imagined images, for pages that do not show videos."""

import os
from collections.abc import Sequence

import numpy as np
from matplotlib import font_manager
from PIL import Image, ImageDraw, ImageFont

from wpt_agents.zoo.pictures.style import INK

SHOTS = 50  # maximum number of frames in a GIF, of 10 to 25 kB each
SLOWDOWN = 2  # half speed, because episodes of Meta-World last only 2.5 seconds
LAST = 2500  # duration of the last frame in milliseconds
COLUMNS = 4  # pairs of a true and an imagined image
GAP = 4  # pixels between images
BAND = 20  # size of a row or column of text in pixels
COLOURS = 128


def animate(
    path: str | os.PathLike[str],
    shots: Sequence[np.ndarray],
    fps: float,
    true: np.ndarray | None = None,
    dreamed: np.ndarray | None = None,
    context: int = 0,
) -> None:
    """Write a GIF of an episode with a strip of true images above imagined ones.

    Each pair of the strip plays until the step in its label, and then stops.

    :param shots: the frames of the video, each (S, S, 3) uint8
    :param fps: frames per second in real time
    :param true: (T, 64, 64, 3) uint8, the images that the agent observes
    :param dreamed: (T, 64, 64, 3) uint8, predicted from the first `context` of them
    """
    stride = -(-len(shots) // SHOTS)
    steps = [*range(0, len(shots) - 1, stride), len(shots) - 1]
    if true is None or dreamed is None:
        pictures = [Image.fromarray(shots[step]) for step in steps]
    else:
        assert true.shape == dreamed.shape, (true.shape, dreamed.shape)
        pictures = _compose(shots, steps, true, dreamed, context)
    # One palette for all frames, so that static parts do not flicker.
    samples = np.concatenate([np.asarray(picture)[::3, ::3] for picture in pictures])
    palette = Image.fromarray(samples).quantize(COLOURS)
    first, *others = [p.quantize(palette=palette, dither=Image.Dither.NONE) for p in pictures]
    shown = round(1000 * SLOWDOWN * stride / fps)  # milliseconds
    durations = [shown] * len(others) + [LAST]
    first.save(path, save_all=True, append_images=others, duration=durations, loop=0)


def _compose(
    shots: Sequence[np.ndarray],
    steps: Sequence[int],
    true: np.ndarray,
    dreamed: np.ndarray,
    context: int,
) -> list[Image.Image]:
    """Combine the frames and the strip, for each of `steps`."""
    ends = np.linspace(context, len(true) - 1, COLUMNS + 1).round().astype(int).tolist()
    blank = _frame(shots[0].shape[0], [end - context + 1 for end in ends[1:]])
    film = shots[0].shape[0]
    size = (film - GAP) // 2
    pictures = []
    for step in steps:
        picture = blank.copy()
        picture.paste(Image.fromarray(shots[step]), (GAP, BAND))
        for column in range(COLUMNS):
            if column and step <= ends[column]:
                break  # not started yet
            at = min(step, ends[column + 1])
            x = film + 2 * GAP + BAND + column * (size + GAP)
            for row, images in enumerate((true, dreamed)):
                image = Image.fromarray(images[at]).resize((size, size), Image.Resampling.NEAREST)
                picture.paste(image, (x, BAND + row * (size + GAP)))
        pictures.append(picture)
    return pictures


def _frame(film: int, ahead: Sequence[int]) -> Image.Image:
    """Draw the empty strip with its labels.

    :param ahead: number of steps from the last observed image to each column's last image
    """
    size = (film - GAP) // 2
    width = film + 2 * GAP + BAND + COLUMNS * (size + GAP)
    picture = Image.new("RGB", (width, BAND + film + GAP), "white")
    font = ImageFont.truetype(font_manager.findfont("DejaVu Sans"), 12)
    draw = ImageDraw.Draw(picture)
    middle = BAND // 2
    draw.text((GAP + film / 2, middle), "the episode", INK, font, anchor="mm")
    left = film + 2 * GAP + BAND
    for column, steps in enumerate(ahead):
        x = left + column * (size + GAP) + size / 2
        draw.text((x, middle), f"{steps} steps ahead", INK, font, anchor="mm")
    for row, name in enumerate(("true", "dreamed")):
        label = Image.new("RGB", (size, BAND), "white")
        ImageDraw.Draw(label).text((size / 2, middle), name, INK, font, anchor="mm")
        place = (film + 2 * GAP, BAND + row * (size + GAP))
        picture.paste(label.transpose(Image.Transpose.ROTATE_90), place)
    return picture
