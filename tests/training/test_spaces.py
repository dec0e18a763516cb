"""Refused spaces: each message holds a line of code, and that line, run as it stands, helps."""

import re

import gymnasium
import numpy as np
import numpy as numpy  # a remedy names it so
import pytest
import wpt_envs
from debug_agent import ClockEnv, agent
from gymnasium import spaces
from gymnasium.wrappers import (
    AddRenderObservation,
    ClipAction,
    FlattenObservation,
    FrameStackObservation,
    GrayscaleObservation,
    NormalizeObservation,
    RescaleAction,
    ResizeObservation,
)
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    VecFrameStack,
    VecNormalize,
    VecTransposeImage,
)

from wpt_agents.training.spaces import HUGE

GRAY = (64, 64, 1)


class Seen(ClockEnv):
    """The clock, as these observations show it; it keeps the actions that it takes."""

    def __init__(self, show=None, observation=None, action=None, render=None):
        super().__init__()
        self.show = show or (lambda image: image)
        self.observation_space = observation or self.observation_space
        self.action_space = action or self.action_space
        self.draw = render or (lambda image: image)
        self.taken = []

    def reset(self, **kwargs):
        image, info = super().reset(**kwargs)
        return self.show(image), info

    def step(self, action):
        self.taken.append(action)
        image, *rest = super().step(action)
        return self.show(image), *rest

    def render(self):
        return self.draw(super().render())


def followed(env, words):
    """The environment after the line of code in the refusal, which must match `words`."""
    with pytest.raises(ValueError, match=words) as refusal:
        agent(env)
    lines = re.findall(r"`env = (.*?)`", str(refusal.value))
    assert lines, refusal.value
    names = {"gymnasium": gymnasium, "numpy": numpy, "wpt_envs": wpt_envs, "env": env}
    return [eval(line, names) for line in lines]


def learnt(env, steps=21, **changes):
    return agent(env, learning_starts=0, train_ratio=1, **changes).learn(steps)


def shown(model):
    """The grey levels of the first episode's images, one a step."""
    return model.replay_buffer.trajectories[0].image[:, 0, 0, 0].tolist()


CLOCK = list(range(8))  # what ClockEnv shows
box = spaces.Box


@pytest.mark.parametrize(
    ("show", "space", "words", "levels"),
    [
        (
            lambda i: (i / 255).astype("f4"),
            box(0, 1, (64, 64, 3)),
            r"float32 images in \[0, 1\]",
            1,
        ),
        (lambda i: i / 255, box(0, 1, (64, 64, 3), np.float64), r"float64 images in \[0, 1\]", 1),
        (lambda i: (i / 127.5 - 1).astype("f4"), box(-1, 1, (64, 64, 3)), r"in \[-1, 1\]", 1),
        (lambda i: i.astype("f4"), box(0, 255, (64, 64, 3)), "bytes stored as float32", 1),
        (lambda i: i.astype(int), box(0, 255, (64, 64, 3), int), "bytes stored as int64", 1),
        (lambda i: (i / 255).astype("f4"), box(-np.inf, np.inf, (64, 64, 3)), "without bounds", 1),
        (
            lambda i: (i / 255).astype("f4").transpose(2, 0, 1),
            box(0, 1, (3, 64, 64)),
            r"float32 images in \[0, 1\]",
            1,
        ),
        (
            lambda i: np.stack([i, 2 * i, 3 * i]),
            box(0, 255, (3, 64, 64, 3), np.uint8),
            "stacks of images; take the newest",
            3,
        ),
        (
            lambda i: np.concatenate([i, 2 * i], -1),
            box(0, 255, (64, 64, 6), np.uint8),
            "stacked by their channels; take the newest",
            2,
        ),
        (
            lambda i: np.concatenate([i, 2 * i], -1).transpose(2, 0, 1),
            box(0, 255, (6, 64, 64), np.uint8),
            "stacked by their channels; take the newest",
            2,
        ),
    ],
)
def test_the_line_for_observations_shows_the_images_that_there_are(show, space, words, levels):
    (env,) = followed(Seen(show, space), words)
    assert shown(learnt(env)) == [levels * level for level in CLOCK]


@pytest.mark.filterwarnings("ignore:grayscale observations")
def test_the_line_for_a_missing_channel_adds_one():
    (env,) = followed(Seen(lambda i: i[..., 0], box(0, 255, (64, 64), np.uint8)), "without an axis")
    assert shown(learnt(env)) == CLOCK


@pytest.mark.parametrize(
    "space",
    [
        box(-1, 1, (17,)),
        spaces.Dict(a=box(0, 1, (2,))),
        spaces.Discrete(5),
        spaces.Tuple([box(0, 1, (2,))]),
        box(0, 255, (64, 64, 2), np.uint8),
    ],
)
def test_the_lines_for_what_is_no_image_take_the_pictures(space):
    for env in followed(Seen(lambda i: space.sample(), space), "sees images, .*render_mode"):
        assert shown(learnt(env)) == CLOCK


@pytest.mark.parametrize(
    ("wrap", "words"),
    [
        (lambda env: FrameStackObservation(env, 4), "FrameStackObservation makes this.*leave it"),
        (FlattenObservation, "FlattenObservation makes this of the images; leave it out"),
        (NormalizeObservation, "NormalizeObservation makes this of the images; leave it out"),
        (GrayscaleObservation, "GrayscaleObservation makes this of the images; leave it out"),
        (
            lambda env: GrayscaleObservation(env, keep_dim=True),
            "in colour, .*GrayscaleObservation takes the colour away; leave it out",
        ),
        (
            lambda env: VecFrameStack(DummyVecEnv([lambda: env]), 4),
            "VecFrameStack makes this of the images; leave it out.*No stack of frames is needed",
        ),
        (
            lambda env: VecTransposeImage(VecFrameStack(DummyVecEnv([lambda: env]), 3)),
            "VecFrameStack makes this of the images; leave it out",
        ),
        (lambda env: VecNormalize(DummyVecEnv([lambda: env])), "VecNormalize.*norm_obs=False"),
    ],
)
def test_the_wrapper_that_spoils_the_images_is_named(wrap, words):
    with pytest.raises(ValueError, match=words):
        agent(wrap(ClockEnv()))
    assert shown(learnt(ClockEnv())) == CLOCK  # it was left out


@pytest.mark.parametrize("wrap", [lambda env: env, VecTransposeImage])
def test_four_grayscale_images_are_not_taken_for_one_with_transparency(wrap):
    env = DummyVecEnv([lambda: Seen(lambda i: i[..., :1], box(0, 255, (64, 64, 1), np.uint8))])
    with pytest.raises(ValueError, match="VecFrameStack makes this of the images; leave it out"):
        agent(wrap(VecFrameStack(env, 4)))


def test_normalised_rewards_are_taken_once_the_images_are_left_alone():
    env = VecNormalize(DummyVecEnv([ClockEnv]), norm_obs=False)
    assert shown(learnt(env)) == CLOCK


@pytest.mark.parametrize(
    ("show", "space", "warning"),
    [
        (
            lambda i: i[..., :1],
            box(0, 255, GRAY, np.uint8),
            r"grayscale .*, 1\), are repea",
        ),
        (
            lambda i: np.concatenate([i, 255 + 0 * i[..., :1]], -1),
            box(0, 255, (64, 64, 4), np.uint8),
            "RGBA .* without their transparency",
        ),
        (
            lambda i: i[..., :1].transpose(2, 0, 1),
            box(0, 255, (1, 64, 64), np.uint8),
            "grayscale .* are repeated",
        ),
    ],
)
def test_grayscale_and_transparent_images_are_taken_with_a_warning(show, space, warning):
    with pytest.warns(UserWarning, match=warning):
        model = learnt(Seen(show, space))
    assert shown(model) == CLOCK
    image = model.replay_buffer.trajectories[0].image
    assert (image == image[..., :1]).all()


def test_images_resized_by_gymnasium_are_taken():
    pytest.importorskip("cv2", reason="gymnasium's ResizeObservation needs opencv-python")
    env = Seen(lambda i: i.repeat(2, 0).repeat(2, 1), box(0, 255, (128, 128, 3), np.uint8))
    assert shown(learnt(ResizeObservation(env, (64, 64)))) == CLOCK


@pytest.mark.filterwarnings("ignore:(grayscale|RGBA) observations")
def test_rendered_pictures_may_be_grayscale_or_transparent():
    number = box(0, 1, (1,))
    for channels in (1, 4):
        env = Seen(lambda i: number.low, number, render=lambda i, c=channels: i[..., [0] * c])
        assert shown(learnt(AddRenderObservation(env))) == CLOCK
        assert shown(learnt(wpt_envs.pixels(env))) == CLOCK


@pytest.mark.parametrize("first", [False, True])
@pytest.mark.parametrize("shape", [(30, 120), (120, 30)])
def test_the_line_for_wide_and_high_images_cuts_their_middle_out(shape, first):
    def show(image):
        wide = np.zeros((*shape, 3), np.uint8)
        middle = wide[:, 45:75] if shape[1] > shape[0] else wide[45:75]
        middle[:] = image[0, 0, 0]
        return wide.transpose(2, 0, 1) if first else wide

    space = box(0, 255, (3, *shape) if first else (*shape, 3), np.uint8)
    env = Seen(show, space)
    with pytest.warns(UserWarning, match=r"squeezed to 64 x 64.* factor of 4\.00") as warned:
        squeezed = learnt(env)
    assert shown(squeezed) == [0] * 8  # the corner is black
    (line,) = re.findall(r"`env = (.*?)`", str(warned[0].message))
    with pytest.warns(UserWarning, match="30 x 30 are resized to 64 x 64"):
        assert shown(learnt(eval(line, {"gymnasium": gymnasium, "env": env}))) == CLOCK


# ------------------------------------------------------------------------------------ actions


@pytest.mark.parametrize("high", [np.inf, np.finfo(np.float32).max, 2.0**31, 10 * HUGE])
def test_infinite_bounds_are_refused_and_the_line_gives_them_bounds(high):
    (env,) = followed(Seen(action=box(-high, high, (2,), np.float32)), "finite bounds")
    learnt(env)
    assert 0.1 < np.abs(env.unwrapped.taken).max() <= 1


@pytest.mark.parametrize("wrap", [lambda env: env, ClipAction])
def test_infinite_bounds_stay_infinite_under_clip_action_and_the_line_mends_that_too(wrap):
    """ClipAction has nothing to clip to here, and RescaleAction nothing to rescale from.

    Older advice named these two. Clipping is to the bounds of the environment underneath, which are
    infinite, so that actions would still be unbounded, and gymnasium's RescaleAction refuses them.
    The line gives the bounds that only the user can know.
    """
    infinite = Seen(action=box(-np.inf, np.inf, (2,), np.float32))
    with pytest.raises(ValueError, match="unbounded"):
        RescaleAction(infinite, np.float32(-1), np.float32(1))
    (env,) = followed(wrap(infinite), "finite bounds, .*for example from -1 to 1, by")
    learnt(env)
    assert 0.1 < np.abs(infinite.taken).max() <= 1


def test_clip_action_hides_bounds_and_leaving_it_out_shows_them():
    env = Seen(action=box(-2, 3, (2,), np.float32))
    with pytest.raises(ValueError, match="ClipAction also hides the bounds; leave it out"):
        agent(ClipAction(env))
    learnt(env)
    assert 2 < np.max(env.taken) <= 3 and -2 <= np.min(env.taken) < -1


@pytest.mark.parametrize(
    ("space", "words"),
    [
        (spaces.Discrete(3), "largest of 3 numbers decides"),
        (spaces.Discrete(3, start=-1), "largest of 3 numbers decides"),
        (spaces.MultiBinary(4), "positive numbers switch on"),
        (spaces.MultiDiscrete([3, 2]), "each number is rounded"),
        (spaces.MultiDiscrete([3, 2], start=[-1, 5]), "each number is rounded"),
        (box(-1, 2, (2, 2), np.float32), "flatten it"),
        (box(-1, 2, (), np.float32), "flatten it"),
        (spaces.Dict(a=box(-1, 2, (2,)), b=box(0, 1, (1,))), "flatten it"),
        (spaces.Tuple([box(-1, 2, (2,)), box(0, 1, (1,))]), "flatten it"),
    ],
)
def test_the_line_for_actions_leads_into_the_space(space, words):
    (env,) = followed(Seen(action=space), words)  # ClockEnv asserts that the space contains them
    learnt(env, steps=70, warmup_steps=70)
    taken = {str(action) for action in env.unwrapped.taken}
    assert len(taken) >= getattr(space, "n", 2) or isinstance(space, spaces.MultiBinary)


def test_other_composite_actions_are_refused_with_what_would_do():
    space = spaces.Dict(a=spaces.Discrete(2), b=box(-1, 1, (1,)))
    with pytest.raises(ValueError, match="TransformAction so that it takes a one-dimensional Box"):
        agent(Seen(action=space))


@pytest.mark.parametrize(
    ("space", "values"),
    [
        (box(0, 3, (2,), np.int64), [0, 1, 2, 3]),
        (box(-128, 127, (2,), np.int8), None),
        (box(0, 255, (2,), np.uint8), None),
    ],
)
def test_whole_numbers_are_rounded_so_that_both_ends_are_reached(space, values, tmp_path):
    model = agent(Seen(action=space))
    ends = np.array([[-1.0, 1.0, 0, 0], [0.9999, -0.9999, 0, 0]])
    to_env = model.policy.to_env(ends)
    low, high = space.low[0], space.high[0]
    assert to_env.dtype == space.dtype and to_env.tolist() == [[low, high], [high, low]]
    if values:
        fine = np.linspace(-1, 1, 601)[:, None] * np.ones(4)
        assert np.unique(model.policy.to_env(fine)).tolist() == values
    loaded = type(model).load(saved(model, tmp_path))
    assert loaded.action_space == space and loaded.policy.to_env(ends).dtype == space.dtype


@pytest.mark.parametrize("dtype", [np.float32, np.float64, np.int32])
def test_the_dtype_of_actions_survives_the_model_file(dtype, tmp_path):
    space = box(-2, 2, (2,), dtype)
    model = agent(Seen(action=space))
    loaded = type(model).load(saved(model, tmp_path))
    image = np.zeros((64, 64, 3), np.uint8)
    assert loaded.action_space == space and loaded.action_space.dtype == dtype
    one, _ = model.predict(image, deterministic=True)
    other, _ = loaded.predict(image, deterministic=True)
    assert one.dtype == other.dtype == dtype and np.array_equal(one, other)


def saved(model, folder):
    model.save(folder / "model")
    return folder / "model"
