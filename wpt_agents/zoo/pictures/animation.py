"""A GIF of an episode beside true and dreamed images, for pages that show no videos."""

import os
from collections.abc import Sequence

import numpy as np
from matplotlib import font_manager
from PIL import Image, ImageDraw, ImageFont

from wpt_agents.zoo.pictures.runs import INK

SHOTS = 50  # pictures in a GIF, at most: each costs 10 to 25 kB
SLOWDOWN = 2  # it plays at half speed, because episodes of Meta-World last 2.5 seconds
LAST = 2500  # milliseconds for which the last picture stays
COLUMNS = 4  # pairs of a true and a dreamed image
GAP = 4  # pixels between images
BAND = 20  # pixels of a row or column of text
COLOURS = 128


def animate(
    path: str | os.PathLike[str],
    shots: Sequence[np.ndarray],
    fps: float,
    true: np.ndarray | None = None,
    dreamed: np.ndarray | None = None,
    context: int = 0,
) -> None:
    """Write a GIF of an episode, and beside it a strip of true above dreamed images.

    Each pair of the strip plays until the step that is written above it, and then stays.

    :param shots: the film, each (S, S, 3) uint8
    :param fps: frames per second of the film in real time
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
    # One palette for all pictures, so that what does not move does not flicker.
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
    """Put the film and the strip side by side, for each of `steps`."""
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
                break  # its turn has not come
            at = min(step, ends[column + 1])
            x = film + 2 * GAP + BAND + column * (size + GAP)
            for row, images in enumerate((true, dreamed)):
                image = Image.fromarray(images[at]).resize((size, size), Image.Resampling.NEAREST)
                picture.paste(image, (x, BAND + row * (size + GAP)))
        pictures.append(picture)
    return pictures


def _frame(film: int, ahead: Sequence[int]) -> Image.Image:
    """Draw the empty strip with its labels.

    :param ahead: how many steps each column's last image lies beyond the last observed one
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
