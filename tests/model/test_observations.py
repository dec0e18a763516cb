"""What `predict` takes for an observation, an episode's start and a recurrent state."""

import re

import numpy as np
import pytest
from debug_agent import agent, noise

from wpt_agents.model.observations import to_images


def test_colour_images_pass_unchanged_with_their_channels_first_or_last():
    image = noise(2)
    for passed in (image, image.transpose(0, 3, 1, 2)):
        images, batched = to_images(passed)
        assert batched and np.array_equal(images, image)
    single, batched = to_images(image[0])
    assert not batched and np.array_equal(single, image[:1])


def test_grayscale_is_repeated_and_transparency_left_out():
    image = noise(2)
    gray, _ = to_images(image[..., :1])
    assert np.array_equal(gray, np.repeat(image[..., :1], 3, -1))
    rgba = np.concatenate([image, image[..., :1]], -1)
    for passed in (rgba, rgba.transpose(0, 3, 1, 2)):
        assert np.array_equal(to_images(passed)[0], image)


def test_the_image_of_a_dictionary_is_found_or_chosen():
    top, wrist = noise(2, seed=1), noise(2, seed=2)
    mask, arm = noise(2)[..., :1], np.zeros((2, 7))
    assert np.array_equal(to_images({"arm": arm, "mask": mask, "top": top})[0], top)
    both = {"top": top, "wrist": wrist}
    assert np.array_equal(to_images(both, "wrist")[0], wrist)
    with pytest.raises(ValueError, match=r"'top' .*'wrist' .*pass the image alone"):
        to_images(both)
    with pytest.raises(ValueError, match=r"must be an image.*'arm'"):
        to_images({"arm": arm})


def test_floats_are_refused_with_their_range():
    with pytest.raises(ValueError, match=r"\(64, 64, 3\) float64 with values from 0 to 1"):
        to_images(np.eye(64)[..., None] * np.ones(3))


@pytest.mark.parametrize(
    ("image", "remedy"),
    [
        (np.full((64, 64, 3), 0.5), r"np.rint(255 * image).astype(np.uint8)"),
        (np.full((64, 64, 3), 9.0), r"np.rint(image).astype(np.uint8)"),
        (np.zeros((64, 64), np.uint8), r"np.repeat(image[..., None], 3, axis=-1)"),
        (np.zeros(7), "render the environment to pixels"),
    ],
)
def test_what_is_no_image_is_refused_with_the_line_that_makes_one(image, remedy):
    with pytest.raises(ValueError, match=re.escape(remedy)):
        to_images(image)


def test_the_whole_result_of_reset_is_refused_with_the_line_that_helps():
    image = np.zeros((64, 64, 3), np.uint8)
    with pytest.raises(ValueError, match=r"as Gymnasium's reset .* `obs, info = env.reset\(\)`"):
        to_images((image, {}))
    assert to_images((image, image))[0].shape == (2, 64, 64, 3)  # a tuple of images is a batch


@pytest.mark.parametrize("start", [np.ones(3, bool), np.ones((2, 1), bool), [True], True])
def test_an_episode_start_of_another_length_is_refused(start):
    with pytest.raises(ValueError, match=r"episode_start has the shape .* pass 2 bools"):
        agent().predict(noise(2), episode_start=start)


def test_the_episode_start_of_a_single_image_may_be_one_bool():
    model = agent()
    state = model.predict(noise(), deterministic=True)[1]
    one, _ = model.predict(noise(), state, True, deterministic=True)
    same, _ = model.predict(noise(), state, np.array([True]), deterministic=True)
    other, _ = model.predict(noise(), state, False, deterministic=True)
    assert np.array_equal(one, same) and not np.array_equal(one, other)


def test_the_state_of_another_agent_is_refused():
    model = agent()
    state = model.predict(noise(2))[1]
    wider = agent(max_action_dim=6).predict(noise(2))[1]
    lstm = tuple(np.zeros((1, 2, 64), np.float32) for _ in range(2))  # sb3-contrib's RecurrentPPO
    swapped = (state[1], state[0], state[2])
    for foreign, words in [
        (lstm, "tuple of 3 arrays, got tuple of 2"),
        (state[0], "tuple of 3 arrays, got ndarray of 2"),
        (5, "tuple of 3 arrays, got 5"),
        (wider, r"shapes .*\(2, 6\), this model's are .*\(2, 4\)"),
        (swapped, "have the shapes"),
        ((state[0], state[1], state[2][:1]), "environments"),
    ]:
        with pytest.raises(ValueError, match=words):
            model.predict(noise(2), foreign)
    with pytest.raises(ValueError, match="of 2 environments, the observation of 3"):
        model.predict(noise(3), state)
    model.predict(noise(2), list(state))
