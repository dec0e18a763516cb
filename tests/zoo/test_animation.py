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


@pytest.fixture
def film():
    """A film of 80 steps, true images that redden with time, dreams that turn green."""
    shots = [np.full((SIZE, SIZE, 3), (0, 0, 3 * t), np.uint8) for t in range(STEPS)]
    true = np.zeros((STEPS, 64, 64, 3), np.uint8)
    true[..., 0] = 3 * np.arange(STEPS)[:, None, None]
    dreamed = np.zeros((STEPS, 64, 64, 3), np.uint8)
    dreamed[..., 1] = 3 * np.arange(STEPS)[:, None, None]
    return shots, true, dreamed


def test_the_strip_shows_true_above_dreamed_images_at_their_steps(film, tmp_path):
    animate(tmp_path / "a.gif", film[0], 40.0, *film[1:], CONTEXT)
    pictures, durations = read(tmp_path / "a.gif")
    # 80 steps in at most 50 pictures: every second one, 0, 2, ... 78, and the last
    assert len(pictures) == 41
    # 2 steps of 1/40 s at half speed are 100 ms
    assert durations == [100] * 40 + [LAST]
    # columns end at 5 + 74 k / 4: 23.5 (rounded to even, 24), 42, 60.5 (60) and 79
    for column, end in enumerate((24, 42, 60, 79)):
        assert abs(tile(pictures[-1], column, 0) - (3 * end, 0, 0)).max() <= 6
        assert abs(tile(pictures[-1], column, 1) - (0, 3 * end, 0)).max() <= 6
    # picture 15 is step 30: the first column has ended, the second plays, the third waits
    assert abs(tile(pictures[15], 0, 0) - (72, 0, 0)).max() <= 6
    assert abs(tile(pictures[15], 1, 1) - (0, 90, 0)).max() <= 6
    assert (tile(pictures[15], 2, 0) == 255).all()
    assert abs(pictures[15][BAND + 5, GAP + 5].astype(int) - (0, 0, 90)).max() <= 6


def test_without_a_world_model_it_is_the_film_alone(film, tmp_path):
    animate(tmp_path / "a.gif", film[0], 40.0)
    pictures, _ = read(tmp_path / "a.gif")
    assert pictures[0].shape == (SIZE, SIZE, 3)
