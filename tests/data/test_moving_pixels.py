"""The pixels that move: those that differ from their trajectory's own background."""

import numpy as np
import torch
from debug_agent import recorded

from wpt_agents.data.dataset import TrajectoryDataset
from wpt_agents.data.replay import ReplayBuffer, mix
from wpt_agents.data.trajectory import Batch, MarkedBatch, Trajectory, moving_pixels


def rng(seed=0):
    return np.random.default_rng(seed)


def scene(grey, length=6):
    """A grey image with a white pixel that moves along the first row, a step each time."""
    image = np.full((length + 1, 64, 64, 3), grey, np.uint8)
    for t in range(length + 1):
        image[t, 0, t] = 255
    return Trajectory(image, np.zeros((length, 2), np.float32))


def marks(length):
    """Where the white pixel of `scene` is."""
    expected = np.zeros((length, 64, 64), bool)
    expected[range(length), 0, range(length)] = True
    return expected


def stored(folder, *trajectories):
    with TrajectoryDataset.create(folder) as dataset:
        dataset.extend(trajectories)
    return dataset


def test_a_pixel_moves_if_any_colour_is_off_the_background_by_more_than_20():
    background = np.full((1, 3, 3), 100, np.uint8)
    image = background.copy()
    image[0, 0, 0] = 120  # 20 too bright in red
    image[0, 1, 1] = 121
    image[0, 2, 2] = 79
    assert moving_pixels(image, background).tolist() == [[False, True, True]]


def test_the_background_is_the_median_and_is_kept():
    trajectory = scene(40)
    assert (trajectory.background == 40).all()  # each pixel is white at most once in seven images
    assert trajectory.background is trajectory.background
    assert (moving_pixels(trajectory.image, trajectory.background) == marks(7)).all()


def test_a_long_trajectory_is_glanced_at():
    image = np.zeros((1001, 64, 64, 3), np.uint8)
    image[501:] = 9  # the second half, of which 25 of the 51 images are
    assert (Trajectory(image, np.zeros((1000, 1), np.float32)).background == 0).all()


def test_a_batch_marks_each_piece_by_its_own_background(tmp_path):
    scenes = [scene(40, 6), scene(200, 3)]  # a row of 9 images is chained of both
    replay = ReplayBuffer()
    for trajectory in scenes:
        replay.add(trajectory)
    dataset = stored(tmp_path, *scenes)
    drawn = (
        mix(replay, None, 0.0, 8, 9, 2, rng(), mark=True),
        dataset.sample(8, 9, 2, rng(), mark=True),
    )
    for batch in drawn:
        assert isinstance(batch, MarkedBatch)
        white = (batch.image == 255).all(-1)
        assert torch.equal(batch.moving, white) and (white.sum((-1, -2)) == 1).all()
        assert len({int(x) for x in batch.image[0, :, 5, 60, 0]} & {40, 200}) >= 1


def test_marking_changes_nothing_else():
    replay = ReplayBuffer()
    replay.add(recorded())
    plain = replay.sample(4, 5, 2, rng())
    marked = mix(replay, None, 0.0, 4, 5, 2, rng(), mark=True)
    assert type(plain) is Batch
    for name, stream in vars(plain).items():
        assert torch.equal(stream, getattr(marked, name))
    halves = marked.to("cpu").split(2)
    assert torch.equal(torch.cat([half.moving for half in halves]), marked.moving)


def test_a_stored_trajectory_is_read_as_a_whole_once(tmp_path, monkeypatch):
    dataset = stored(tmp_path, scene(40), scene(200))
    whole = []
    read = TrajectoryDataset.__getitem__
    monkeypatch.setattr(
        TrajectoryDataset, "__getitem__", lambda self, i: whole.append(i) or read(self, i)
    )
    for seed in range(3):
        dataset.sample(16, 4, 2, rng(seed), mark=True)
    assert sorted(whole) == [0, 1]
    dataset.sample(16, 4, 2, rng())
    assert len(whole) == 2


def test_a_damaged_trajectory_that_is_set_aside_takes_its_background_with_it(tmp_path):
    dataset = stored(tmp_path, scene(40), scene(200))
    dataset.sample(16, 4, 2, rng(), mark=True)
    dataset._leave_out({0})
    batch = dataset.sample(4, 4, 2, rng(), mark=True)
    assert torch.equal(batch.moving, (batch.image == 255).all(-1))
