"""The GIF of `enjoy`: what is in it, when, and for how long."""

import numpy as np
import pytest
from PIL import Image, ImageSequence

from wpt_agents.zoo.pictures.animation import BAND, GAP, LAST, animate

STEPS, SIZE, CONTEXT = 80, 68, 5
TILE = (SIZE - GAP) // 2
LEFT = SIZE + 2 * GAP + BAND


def read(path):
    """The pictures of a GIF and the milliseconds of each."""
    with Image.open(path) as file:
        pages = ImageSequence.Iterator(file)
        read = [(np.asarray(page.convert("RGB")), page.info["duration"]) for page in pages]
    return [picture for picture, _ in read], [duration for _, duration in read]


def tile(picture, column, row):
    """The middle of an image of the strip."""
    x = LEFT + column * (TILE + GAP) + TILE // 2
    y = BAND + row * (TILE + GAP) + TILE // 2
    return picture[y, x].astype(int)


def shade(step):
    """14 shades in all, which a GIF's palette holds."""
    return 18 * (step // 6)


@pytest.fixture
def film():
    """A film of 80 steps, true images that redden with time, dreams that turn green."""
    shades = shade(np.arange(STEPS)).astype(np.uint8)
    shots = [np.full((SIZE, SIZE, 3), (0, 0, value), np.uint8) for value in shades]
    true = np.zeros((STEPS, 64, 64, 3), np.uint8)
    dreamed = np.zeros((STEPS, 64, 64, 3), np.uint8)
    true[..., 0] = shades[:, None, None]
    dreamed[..., 1] = shades[:, None, None]
    return shots, true, dreamed


def test_the_strip_shows_true_above_dreamed_images_at_their_steps(film, tmp_path):
    animate(tmp_path / "a.gif", film[0], 40.0, *film[1:], CONTEXT)
    pictures, durations = read(tmp_path / "a.gif")
    # 80 steps are more than 50, so every second one is shown: 0, 2, ... 78, and the last, 79.
    # 2 steps of 1/40 s at half speed are 100 ms. Equal pictures are stored as one.
    assert sum(durations) == 40 * 100 + LAST
    # columns end at 5 + 74 k / 4: 23.5 (rounded to even, 24), 42, 60.5 (60) and 79
    for column, end in enumerate((24, 42, 60, 79)):
        assert abs(tile(pictures[-1], column, 0) - (shade(end), 0, 0)).max() <= 3
        assert abs(tile(pictures[-1], column, 1) - (0, shade(end), 0)).max() <= 3
    # step 30 is shown after 1.5 s: the first column has ended, the second plays, the third waits
    now = pictures[np.searchsorted(np.cumsum(durations), 1500, side="right")]
    assert abs(tile(now, 0, 0) - (shade(24), 0, 0)).max() <= 3
    assert abs(tile(now, 1, 1) - (0, shade(30), 0)).max() <= 3
    assert tile(now, 2, 0).min() > 250
    assert abs(now[BAND + 5, GAP + 5].astype(int) - (0, 0, shade(30))).max() <= 3


def test_without_a_world_model_it_is_the_film_alone(film, tmp_path):
    animate(tmp_path / "a.gif", film[0], 40.0)
    pictures, _ = read(tmp_path / "a.gif")
    assert pictures[0].shape == (SIZE, SIZE, 3)
