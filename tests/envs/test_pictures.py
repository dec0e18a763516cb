"""What an environment returns as its picture: converted once, or refused with the culprit named."""

import re
import warnings

import gymnasium as gym
import numpy as np
import pytest
import shimmy
import wpt_envs
from dm_control import suite
from gymnasium import spaces
from wpt_envs.pictures import PictureReader, shrink

# Most pictures here are not square, to tell rows from columns.
pytestmark = pytest.mark.filterwarnings("ignore:.*squeezed to a square")
GRAY = np.arange(30, dtype=np.uint8).reshape(5, 6, 1) * 8
COLOUR = np.concatenate([GRAY, GRAY + 1, GRAY + 2], -1)


def read(*pictures):
    """What the last of these pictures becomes, of one environment."""
    reader = PictureReader("render() of <Door>", "make it with render_mode='rgb_array'")
    return [reader.read(picture) for picture in pictures][-1]


@pytest.mark.parametrize(
    "picture",
    [
        COLOUR,
        COLOUR.astype(np.int64),
        COLOUR.astype(np.float32),
        COLOUR / 255,
        (COLOUR / 255).astype(np.float32),
        COLOUR.transpose(2, 0, 1),
        np.concatenate([COLOUR, GRAY], -1),
        np.concatenate([COLOUR, GRAY], -1) / 255,
    ],
)
def test_the_same_picture_is_read_from_every_form(picture):
    assert read(picture).dtype == np.uint8 and np.array_equal(read(picture), COLOUR)


def test_grayscale_and_black_and_white_are_repeated():
    for picture in (GRAY, GRAY[..., 0], GRAY.transpose(2, 0, 1), GRAY / 255):
        assert np.array_equal(read(picture), GRAY.repeat(3, -1))
    assert np.unique(read(GRAY > 100)).tolist() == [0, 255]


def test_the_first_picture_that_is_not_black_decides_what_floats_mean():
    black, dim = np.zeros((2, 2, 3)), np.full((2, 2, 3), 0.5)
    assert read(black).max() == 0
    assert read(black, dim).max() == 128  # of [0, 1]
    assert read(100 * dim, dim).max() == 0  # of [0, 255], where 0.5 is nearly black
    with pytest.raises(ValueError, match=r"from 0\.5 to 200, beyond \[0, 1\]: return uint8"):
        read(dim, np.where(np.eye(2)[..., None] > 0, 200.0, dim))


@pytest.mark.parametrize(
    ("picture", "words"),
    [
        (None, "returned None, not a picture: make it with render_mode='rgb_array'"),
        ("frame", "a str, not a picture"),
        ([COLOUR], r"a list of 1, not one picture as an array: return its last entry"),
        ((COLOUR, COLOUR), "a tuple of 2, not one picture"),
        (COLOUR[None], r"shape \(1, 5, 6, 3\): a picture is \(H, W, 3\)"),
        (COLOUR[..., :2], r"shape \(5, 6, 2\)"),
        (np.zeros((0, 4, 3)), r"shape \(0, 4, 3\)"),
        (np.zeros(7), r"shape \(7,\)"),
        (COLOUR.astype(np.int64) - 1, r"int64 values from -1 to 233, beyond \[0, 255\]"),
        (COLOUR.astype(np.uint16) * 200, r"uint16 values .* beyond \[0, 255\]"),
        (np.full((2, 2, 3), -0.5), r"values from -0.5 to -0.5, beyond"),
        (np.full((2, 2, 3), np.nan), "values from nan to nan, beyond"),
        (np.full((2, 2, 3), "x"), "an array of <U1, not of numbers"),
    ],
)
def test_what_is_no_picture_is_refused_by_what_it_is(picture, words):
    with pytest.raises(ValueError, match=words) as refusal:
        read(picture)
    assert str(refusal.value).startswith("render() of <Door> returned ")


def test_shrinking_averages_over_areas():
    stripes = np.repeat([[[0], [30], [60]]], 3, axis=2).astype(np.uint8)
    assert shrink(stripes, 1).tolist() == [[[30, 30, 30]]]
    assert np.array_equal(shrink(COLOUR[:, :5], 5), COLOUR[:, :5])


def test_the_middle_square_is_cut_out_if_asked_for():
    for picture in (COLOUR, COLOUR / 255, COLOUR.transpose(2, 0, 1)):
        read_cropped = PictureReader("render() of <Door>", "", crop=True).read(picture)
        assert np.array_equal(read_cropped, COLOUR[:, :5])  # 5 x 6: the last column is left out
    high = COLOUR.transpose(1, 0, 2)
    assert np.array_equal(PictureReader("", "", crop=True).read(high), high[:5])
    wide = np.zeros((2, 9, 3), np.uint8)
    wide[:, 3:5] = 255  # columns 3 and 4 are the middle
    assert (PictureReader("", "", crop=True).read(wide) == 255).all()


def test_pictures_that_are_squeezed_are_warned_of_once_and_the_remedy_helps():
    reader = PictureReader("render() of <Road>", "")
    with pytest.warns(
        UserWarning, match=r"<Road> returned pictures of 5 x 20, .*4\.00.* crop=True"
    ):
        reader.read(np.zeros((5, 20, 3), np.uint8))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        reader.read(np.zeros((5, 20, 3), np.uint8))  # the second
        PictureReader("", "").read(COLOUR[:, :5])  # a square
        PictureReader("", "", crop=True).read(COLOUR)  # what the warning advises


# --------------------------------------------------------------------- an entry of a dictionary


class Cameras(gym.Env):
    """Two cameras in one dictionary: each shows the time, the second ten times as bright."""

    render_mode, metadata = None, {"render_modes": []}

    def __init__(self):
        image = spaces.Box(0, 255, (30, 40, 3), np.uint8)
        self.observation_space = spaces.Dict(arm=spaces.Box(-1, 1, (7,)), top=image, wrist=image)
        self.action_space = spaces.Box(-1, 1, (2,), np.float32)

    def reset(self, *, seed=None, options=None):
        self.time = 0
        return self._seen(), {}

    def step(self, action):
        self.time += 1
        return self._seen(), 1.0, False, self.time >= 5, {}

    def _seen(self):
        images = {name: np.full((30, 40, 3), t, np.uint8) for name, t in self._brightness()}
        return {"arm": np.zeros(7, np.float32), **images}

    def _brightness(self):
        return [("top", self.time), ("wrist", 10 * self.time)]


def test_an_entry_of_the_observations_is_shown_without_rendering():
    env = wpt_envs.pixels(Cameras(), image_key="wrist", action_repeat=2, state_in_info=True)
    first, _ = env.reset()
    obs, reward, *_, info = env.step(np.zeros(2, np.float32))
    assert env.observation_space == spaces.Box(0, 255, (64, 64, 3), np.uint8)
    assert (first == 0).all() and (obs == 20).all() and reward == 2
    assert info["state"]["top"].max() == 2


class Road(gym.Env):
    """Renders a wide picture, black but for the square in its middle."""

    render_mode, metadata = "rgb_array", {"render_modes": ["rgb_array"]}
    observation_space = spaces.Dict(road=spaces.Box(0, 255, (30, 120, 3), np.uint8))
    action_space = spaces.Box(-1, 1, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        return {"road": self.render()}, {}

    def step(self, action):
        return {"road": self.render()}, 0.0, False, False, {}

    def render(self):
        picture = np.zeros((30, 120, 3), np.uint8)
        picture[:, 45:75] = 200
        return picture


@pytest.mark.parametrize("options", [{}, {"image_key": "road"}])
def test_pixels_squeezes_wide_pictures_or_cuts_the_middle_out(options):
    squeezed, cropped = (
        wpt_envs.pixels(Road(), image_size=64, crop=crop, **options) for crop in (False, True)
    )
    assert (cropped.reset()[0] == 200).all() and (cropped.step(np.zeros(1, "f4"))[0] == 200).all()
    columns = squeezed.reset()[0][0, :, 0]
    assert columns[:24].max() == 0 and columns[24:40].min() == 200 and columns[40:].max() == 0


def test_our_renderer_draws_squares_and_takes_no_crop():
    env = gym.make("InvertedPendulum-v5")
    with pytest.raises(ValueError, match="rendering='fast' draws square images: leave crop out"):
        wpt_envs.pixels(env, rendering="fast", crop=True)


def test_an_entry_that_is_not_there_or_no_picture_is_refused_by_name():
    with pytest.raises(ValueError, match=r"No entry 'side' .* There are: 'arm', 'top', 'wrist'"):
        wpt_envs.pixels(Cameras(), image_key="side")
    with pytest.raises(ValueError, match=r"observation 'arm' of .*shape \(7,\)"):
        wpt_envs.pixels(Cameras(), image_key="arm").reset()
    with pytest.raises(ValueError, match="image_key='top' chooses from Dict observations"):
        wpt_envs.pixels(gym.make("CartPole-v1", render_mode="rgb_array"), image_key="top")
    with pytest.raises(ValueError, match="both choose the image"):
        wpt_envs.pixels(Cameras(), image_key="top", rendering="near")
    with pytest.raises(ValueError, match="camera='top' needs our renderer"):
        wpt_envs.pixels(Cameras(), camera="top")


# ---------------------------------------------------------------- what is no single environment


def line(function, words):
    """The line of code in a refusal that matches `words`."""
    with pytest.raises(ValueError, match=words) as refusal:
        function()
    return re.search("`(.*)`", str(refusal.value)).group(1)


def test_pixels_of_what_is_no_environment_says_what_to_write():
    names = {"gymnasium": gym, "wpt_envs": wpt_envs, "shimmy": shimmy}
    exec(line(lambda: wpt_envs.pixels("Reacher-v5"), "not an id"), names)
    assert names["env"].reset(seed=0)[0].std() > 3
    names["env"] = suite.load("cartpole", "balance")
    exec(line(lambda: wpt_envs.pixels(names["env"]), "not a dm_env"), names)
    assert names["env"].reset(seed=0)[0].std() > 3
    vector = gym.make_vec("Reacher-v5", num_envs=2, vectorization_mode="sync")
    with pytest.raises(ValueError, match=r"not the vector SyncVectorEnv: .*wrappers=\[wpt_envs"):
        wpt_envs.pixels(vector)
    vector = gym.make_vec(
        "Reacher-v5", 2, "sync", render_mode="rgb_array", wrappers=[wpt_envs.pixels]
    )
    assert vector.reset(seed=0)[0].shape == (2, 64, 64, 3)
    with pytest.raises(ValueError, match="not a function"):
        wpt_envs.pixels(line)


def test_an_action_out_of_bounds_is_taken_once_it_is_clipped_as_the_refusal_says():
    env = wpt_envs.pixels(Cameras(), image_key="top")
    env.reset()
    names = {"numpy": np, "env": env, "action": np.array([0.5, 1.5])}
    exec(line(lambda: env.step(names["action"]), "outside"), names)
    assert names["action"].tolist() == [0.5, 1.0]
    env.step(names["action"])
