"""Data and task in the same units of actions, or a warning."""

import numpy as np
import pytest
from gymnasium import spaces
from test_tables import rows, save

from wpt_agents.data.dataset import TrajectoryDataset
from wpt_agents.data.importers.formats import open_episodes
from wpt_agents.data.trajectory import Trajectory
from wpt_agents.data.units import Ranges, compare_units, in_units_of, rescaled

UNIT = spaces.Box(0, 1, (2,), np.float32)


def played(action, **labels):
    action = np.asarray(action, np.float32)
    return Trajectory(np.zeros((len(action) + 1, 8, 8, 3), np.uint8), action, **labels)


def constant(*values, length=30):
    return played(np.tile(np.array(values), (length, 1)))


def import_rows(tmp_path, trajectories, **options):
    arrays = rows(trajectories)
    arrays["terminals"] = np.concatenate([np.arange(len(t)) == len(t) - 1 for t in trajectories])
    path = save(tmp_path / "in.hdf5", arrays)
    return TrajectoryDataset.from_hdf5(path, tmp_path / "out", image_size=8, **options)


def test_actions_that_never_leave_0_to_1_are_questioned_by_dimension(tmp_path):
    swing = np.linspace(-1, 1, 40)
    gripper = np.arange(40) % 2
    data = [played(np.stack([swing, gripper, 0.03 * swing], 1))]
    words = r"in\.hdf5: .* of 3 dimensions .*: 1 \(0 to 1\), 2 \(-0\.03 to 0\.0285\)\. .*low="
    with pytest.warns(UserWarning, match=words):
        dataset = import_rows(tmp_path, data)
    assert dataset.bounds == [None]


def test_the_remedies_for_questioned_actions_work_to_the_letter(tmp_path):
    gripper = np.tile([0.0, 1.0], 20)
    data = [played(np.stack([gripper, gripper], 1))]
    dataset = import_rows(tmp_path, data, low=[0, 0], high=[1, 1])  # warnings are errors here
    assert dataset[0].action[:2].tolist() == [[-1, -1], [1, 1]]
    assert dataset.bounds == [[[0, 0], [1, 1]]]
    again = open_episodes(tmp_path / "in.hdf5", image_size=8, low=-1, high=1)[0]
    assert again.action[:2].tolist() == [[0, 0], [1, 1]]
    assert again.bounds.tolist() == [[-1, -1], [1, 1]]


def test_a_few_actions_or_known_bounds_are_not_questioned():
    ranges = Ranges()
    ranges.add(constant(0, 1, length=5))
    ranges.add(played(np.zeros((50, 2)), bounds=np.array([[0, 0], [1, 1]])))
    ranges.warn("data")


def test_bounds_are_kept_by_the_store_and_its_copies(tmp_path):
    bounds = np.array([[0, -2], [1, 2.5]])
    with TrajectoryDataset.create(tmp_path / "a", image_size=8) as dataset:
        dataset.append(played(np.zeros((3, 2)), bounds=bounds))
        dataset.append(played(np.zeros((3, 2))))
    merged = TrajectoryDataset.merge(tmp_path / "b", [tmp_path / "a"])
    for data in (TrajectoryDataset.open(tmp_path / "a"), merged, merged.subset([0, 1])):
        np.testing.assert_array_equal(data[0].bounds, bounds)
        assert data[1].bounds is None and data.bounds == [bounds.tolist(), None]


def test_bounds_of_another_width_are_refused():
    with pytest.raises(ValueError, match=r"bounds must be \(2, 2\), .* got \(2, 3\)"):
        played(np.zeros((3, 2)), bounds=np.zeros((2, 3)))


def test_actions_beyond_the_limits_are_clipped_with_a_warning(tmp_path):
    data = [played(np.tile([[0.5, -0.5]], (10, 1)))]
    with pytest.warns(UserWarning, match="dimension 0 run from 0.5 to 0.5, beyond the limits -0.2"):
        dataset = import_rows(tmp_path, data, low=-0.25, high=0.25)
    assert dataset[0].action[0].tolist() == [1, -1]


@pytest.mark.parametrize("bad", [np.inf, -np.inf, np.nan])
def test_an_action_that_is_not_finite_is_refused_where_others_are_clipped(tmp_path, bad):
    action = np.array([[0, 0], [0.5, 3], [0.0, bad]])  # of which the first led to the first image
    folder = tmp_path / "metaworld" / "reach"
    folder.mkdir(parents=True)
    image = np.zeros((3, 8, 8, 3), np.uint8)
    np.savez(folder / "time-id-0-2.npz", observation=image, action=action)
    for form, limits in (("npz", {"low": -4, "high": 4}), ("official", {})):
        episodes = open_episodes(folder, form, image_size=8, **limits)
        with pytest.raises(ValueError, match=r"action 1 is -?(inf|nan) in dimension 1; leave"):
            episodes[0]


def test_actions_outside_are_refused_with_the_range_and_the_remedy():
    action = np.array([[0.5, -3.25], [0.0, 2.5]], np.float32)
    words = r"dimension 1 runs from -3\.25 to 2\.5: .*low=\[0,-3\.25\], high=\[0\.5,2\.5\]"
    with pytest.raises(ValueError, match=words):
        played(action)
    played(rescaled(action, [0, -3.25], [0.5, 2.5]))


# Compared with a task


def stored(path, *trajectories):
    with TrajectoryDataset.create(path, image_size=8) as dataset:
        dataset.extend(trajectories)
    return dataset


def test_known_bounds_that_are_not_the_tasks_are_warned_of(tmp_path):
    arm = played(np.zeros((3, 2)), bounds=np.array([[0, 0], [1, 1]]), embodiment="arm")
    dataset = stored(tmp_path, arm, arm, played(np.zeros((3, 2))))
    compare_units(dataset, UNIT)
    wide = spaces.Box(-2, 2, (2,), np.float32)
    with pytest.warns(UserWarning, match=r"in 2 traj.* for \[0, 0\] and \[1, 1\], in the task for"):
        compare_units(dataset, wide)
    compare_units(dataset, wide, embodiment="hand")  # another robot's data are not used
    compare_units(dataset, spaces.Box(-2, 2, (3,), np.float32))


def test_bounds_of_minus_1_and_1_are_no_units_and_are_not_warned_of(tmp_path):
    normal = played(np.zeros((3, 2)), bounds=np.array([[-1, -1], [1, 1]]))
    compare_units(stored(tmp_path, normal), UNIT)


def test_actions_in_the_boxs_own_units_are_rescaled_by_dimension():
    swing = np.linspace(-1, 1, 30)
    box = spaces.Box(np.array([-1, 0], np.float32), np.array([1, 1], np.float32))
    data = [played(np.stack([swing, np.arange(30) % 2], 1))]
    with pytest.warns(UserWarning, match=r"environment's own units, .*: 1 \(0 to 1\)\. Import"):
        [new] = in_units_of(data, box)
    np.testing.assert_allclose(new.action[:, 0], swing, atol=1e-6)
    assert new.action[:2, 1].tolist() == [-1, 1]


@pytest.mark.parametrize(
    ("trajectory", "box"),
    [
        (constant(-0.5, 0.5), UNIT),  # negative in one dimension, checked below
        (constant(0.5, 0.5), spaces.Box(-1, 1, (2,), np.float32)),
        (constant(0.5, 0.5), spaces.Box(0, 1, (3,), np.float32)),
        (constant(0.5, 0.5, length=5), UNIT),  # too few to say anything
    ],
)
def test_other_actions_stay_as_they_are(trajectory, box, recwarn):
    [new] = in_units_of([trajectory], box)
    expected = trajectory.action.copy()
    if trajectory.action.min() < 0:  # its second dimension is in the Box's units
        expected[:, 1] = 0
    np.testing.assert_allclose(new.action, expected, atol=1e-6)


def test_known_units_are_left_alone():
    known = played(np.full((30, 2), 0.5), bounds=np.array([[0, 0], [1, 1]]))
    [new] = in_units_of([known], UNIT)
    assert new is known
