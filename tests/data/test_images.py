"""Images of any size become the size that a model sees."""

import numpy as np
import pytest
import torch

from wpt_agents.data.images import Resizer, area_weights, middle_square, resized


def test_a_pixel_is_the_mean_over_its_area_by_hand():
    # 3 pixels become 2, of 1.5 each: (1 * 10 + 0.5 * 40) / 1.5 = 20 and (0.5 * 40 + 1 * 100) / 1.5
    image = np.zeros((1, 3, 3, 3), np.uint8)
    image[0, :, :, 0] = [10, 40, 100]
    assert resized(image, 2)[0, :, :, 0].tolist() == [[20, 80], [20, 80]]


@pytest.mark.parametrize(("old", "new"), [(96, 64), (84, 64), (64, 64), (32, 64), (480, 64)])
def test_the_weights_of_each_new_pixel_sum_to_1_and_each_old_one_counts_equally(old, new):
    weights = area_weights(old, new)
    np.testing.assert_allclose(weights.sum(1), 1, rtol=1e-6)
    np.testing.assert_allclose(weights.sum(0), new / old, rtol=1e-6)


def test_a_dot_keeps_its_share_of_brightness():
    image = np.zeros((1, 128, 128, 3), np.uint8)
    image[0, 64, 64] = 200  # a quarter of the new pixel's area
    small = resized(image, 64)
    assert small[0, 32, 32].tolist() == [50, 50, 50] and small.sum() == 150


def test_many_images_are_resized_as_one_by_one():
    images = np.random.default_rng(0).integers(0, 256, (130, 20, 12, 3)).astype(np.uint8)
    one_by_one = np.concatenate([resized(image[None], 8) for image in images])
    np.testing.assert_array_equal(resized(images, 8), one_by_one)


def test_images_that_cannot_be_written_are_resized_without_a_warning():
    images = np.frombuffer(bytes(range(192)), np.uint8).reshape(1, 8, 8, 3)  # as of a file
    torch.set_warn_always(True)  # otherwise torch warns once in a process
    try:
        assert resized(images, 4).shape == (1, 4, 4, 3)
    finally:
        torch.set_warn_always(False)


def test_the_middle_square_of_wide_and_of_high_images():
    image = np.arange(2 * 4 * 6 * 3).reshape(2, 4, 6, 3)
    np.testing.assert_array_equal(middle_square(image), image[:, :, 1:5])
    np.testing.assert_array_equal(middle_square(image.transpose(0, 2, 1, 3))[:, 0], image[:, :, 1])


def test_each_shape_is_warned_of_once():
    resize = Resizer(4)
    with pytest.warns(UserWarning) as warned:
        for shape in ((8, 8), (8, 8), (8, 4), (8, 4)):
            assert resize(np.zeros((2, *shape, 3), np.uint8)).shape == (2, 4, 4, 3)
    assert ["resized" in str(w.message) for w in warned] == [True, False]
    assert "squeezed" in str(warned[1].message)
    resize(np.zeros((2, 4, 4, 3), np.uint8))  # nothing to say
