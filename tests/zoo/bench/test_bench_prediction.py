"""What `open-loop` and `bench prediction` measure, by hand, and both commands to their pictures."""

import json
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import torch
import wpt_envs
from debug_agent import agent, noise
from matplotlib.image import imread
from typer.testing import CliRunner

from wpt_agents.agents.wpt import WPT
from wpt_agents.data.dataset import TrajectoryDataset
from wpt_agents.data.trajectory import Trajectory
from wpt_agents.model.images import to_unit
from wpt_agents.model.world_model import squared_error
from wpt_agents.zoo.bench import prediction as bench
from wpt_agents.zoo.commands.app import app
from wpt_agents.zoo.judge import prediction
from wpt_agents.zoo.judge.probes import QUANTITIES
from wpt_agents.zoo.pictures import predictions as prediction_pictures

pytestmark = pytest.mark.slow  # it runs simulators or whole runs

PIXELS = 64 * 64 * 3


def clock(steps, speed=1):
    """Every byte of image t is t * speed, and action t is t / 1000."""
    level = (speed * np.arange(steps + 1)).astype(np.uint8)
    image = np.tile(level[:, None, None, None], (1, 64, 64, 3))
    action = np.arange(steps, dtype=np.float32)[:, None] / 1000
    return Trajectory(image, action, embodiment=f"clock {speed}")


def test_the_error_is_that_of_eq_1_by_hand():
    true, predicted = np.zeros((2, 2, 64, 64, 3), np.uint8)
    predicted[1, 0, 0, 0], predicted[1, 5, 5, 2] = 51, 255  # (51/255)^2 + 1 = 1.04
    np.testing.assert_allclose(prediction.squared_error(true, predicted), [0, 1.04], rtol=1e-6)
    # 255 - 254 must not wrap around in either direction
    high, low = np.full((1, 64, 64, 3), 255, np.uint8), np.full((1, 64, 64, 3), 254, np.uint8)
    for a, b in ((high, low), (low, high)):
        assert prediction.squared_error(a, b) == pytest.approx(PIXELS / 255**2)


def test_the_error_is_the_one_that_pre_training_minimises():
    true, predicted = noise(2, 3), noise(2, 3, seed=1)
    images = (to_unit(torch.from_numpy(x)) for x in (true, predicted))
    expected = squared_error(*images).numpy()
    np.testing.assert_allclose(prediction.squared_error(true, predicted), expected, rtol=1e-5)


def test_a_model_dreams_the_same_at_every_call_and_sees_the_context_alone():
    batch = prediction.windows(clock(50), 1, 4)
    dreamt = prediction.dream(agent())(batch)
    assert dreamt.shape == batch.image.shape and dreamt.dtype == np.uint8
    later = batch.image.clone()
    later[:, prediction.CONTEXT :] = 255
    assert np.array_equal(dreamt, prediction.dream(agent())(replace(batch, image=later)))
    later[:, prediction.CONTEXT - 1] = 255
    assert not np.array_equal(dreamt, prediction.dream(agent())(replace(batch, image=later)))


def test_the_mean_of_samples_is_their_mean_and_errs_less_than_they_do():
    batch, model = prediction.windows(clock(50), 1, 4), agent()
    generator = torch.Generator().manual_seed(0)
    world_model = model.policy.world_model
    samples = [world_model.open_loop(batch, 5, generator).numpy() for _ in range(3)]
    assert not np.array_equal(samples[0], samples[1])
    mean = prediction.dream(model, 3)(batch)
    np.testing.assert_allclose(mean, sum(x.astype(float) for x in samples) / 3, rtol=1e-5)
    true = batch.image.numpy()
    alone = np.mean([prediction.squared_error(true, x) for x in samples], 0)
    spread = np.mean([prediction.squared_error(mean, x) for x in samples], 0)
    together = prediction.squared_error(true, mean)
    np.testing.assert_allclose(together, alone - spread, rtol=1e-3)  # variance leaves the error


def test_the_last_episodes_of_each_task_are_held_out(tmp_path):
    with TrajectoryDataset.create(tmp_path / "data") as data:
        for speed in range(1, 7):  # three episodes of each of two tasks
            data.append(clock(2, speed))
    plan = bench.QUICK._replace(episodes=3, held_out=1)
    trained_on, held_out = bench.split(data, plan)
    assert held_out.embodiments == ["clock 3", "clock 6"]
    assert trained_on.embodiments == ["clock 1", "clock 2", "clock 4", "clock 5"]
    assert bench.of(trained_on, "clock 2", "clock 5").embodiments == ["clock 2", "clock 5"]


def test_windows_reach_from_start_to_end_each_image_with_the_action_that_led_to_it():
    batch = prediction.windows(clock(100), 3, 2)
    assert batch.image.shape == (3, 45, 64, 64, 3)
    assert batch.image[:, 0, 0, 0, 0].tolist() == [0, 28, 56]  # 101 images, 45 in a window
    assert batch.image[:, -1, 0, 0, 0].tolist() == [44, 72, 100]
    np.testing.assert_allclose(batch.action[1, 1], [0.028, 0], rtol=1e-6)  # from image 28 to 29
    assert batch.is_first[:, 0].all() and not batch.is_first[:, 1:].any()


def test_copying_the_last_frame_errs_by_the_square_of_the_time_that_passed():
    batch = prediction.windows(clock(100), 3, 1)
    errors = prediction.errors_by_horizon(prediction.copy_last_frame, [batch, batch])
    assert errors.shape == (2, 41)  # two trajectories, horizons 0 .. 40
    by_hand = PIXELS * (np.arange(41) / 255) ** 2  # at horizon h each byte is h too low
    np.testing.assert_allclose(errors, [by_hand, by_hand], rtol=1e-5)


def test_the_mean_frame_is_that_of_all_training_images_and_never_changes(tmp_path):
    with TrajectoryDataset.create(tmp_path / "data") as dataset:
        dataset.append(clock(2, 10))  # 0, 10, 20
        dataset.append(clock(1, 90))  # 0, 90
    mean = prediction.MeanFrame(dataset)
    np.testing.assert_allclose(mean.image, np.full((64, 64, 3), 24))  # 120 / 5
    batch = prediction.windows(clock(44), 1, 1)
    errors = prediction.errors_by_horizon(mean, [batch])[0]
    by_hand = PIXELS * ((np.arange(4, 45) - 24) / 255) ** 2  # horizon 0 is image 4
    np.testing.assert_allclose(errors, by_hand, rtol=1e-5)


def test_a_row_counts_horizons_from_1_and_compares_within_trajectories():
    errors = np.zeros((2, 41))
    errors[0, 1:], errors[1, 1:], errors[:, 0] = 2, 6, 99  # horizon 0 is no prediction
    row = prediction.row("arm", "x", errors, errors + 3)
    assert row["mean of 1 to 40"] == row["+1"] == row["+40"] == 4
    assert row["95 %"] == "2.0 to 6.0" and row["episodes"] == 2
    # both trajectories are 3 below copying: paired, there is nothing left to chance
    assert row["minus copying"] == -3 and row["95 % "] == "-3.0 to -3.0"


def test_a_single_trajectory_has_no_interval():
    row = prediction.row("arm", "x", np.ones((1, 41)), np.ones((1, 41)))
    assert (row["episodes"], row["95 %"], row["95 % "]) == (1, "-", "-")
    mean, low, high = prediction.with_interval(np.ones((1, 41)))
    assert mean.tolist() == [1.0] * 41 and np.isnan([low, high]).all()


def test_the_typical_window_moves_neither_most_nor_least():
    parts = [prediction.windows(clock(44, speed), 1, 1) for speed in (5, 1, 3)]
    assert prediction.typical(parts) is parts[2]


def test_a_montage_puts_each_image_into_its_row_and_column():
    rows = [np.full((2, 4, 4, 3), 10, np.uint8), np.full((2, 4, 4, 3), 20, np.uint8)]
    rows[1][1] = 30
    picture = prediction_pictures.montage(rows, gap=1)
    assert picture.shape == (9, 9, 3)
    assert [picture[y, x, 0] for y, x in ((0, 0), (0, 8), (8, 0), (8, 8))] == [10, 10, 20, 30]
    assert (picture[4] == 255).all() and (picture[:, 4] == 255).all()


def test_models_of_other_keywords_have_a_folder_of_their_own_and_share_the_data(monkeypatch):
    collected = []

    def stop(folder, *_, **__):
        collected.append(folder)
        raise InterruptedError

    monkeypatch.setattr(bench, "collect", stop)
    settings = ["data_dependent_init=false", "pixel_weight=8"]
    for chosen in ([], settings):
        with pytest.raises(InterruptedError):
            next(bench.rows(quick=True, settings=chosen))
    assert collected == [bench.QUICK.folder / "data"] * 2
    assert bench.changed(bench.QUICK, []) == bench.QUICK
    plan, other = bench.changed(bench.QUICK, settings), bench.changed(bench.QUICK, settings[:1])
    changes = {"data_dependent_init": False, "pixel_weight": 8}
    assert plan.model == bench.QUICK.model | changes and plan.updates == bench.QUICK.updates
    assert len({bench.QUICK.folder, plan.folder, other.folder}) == 3
    with pytest.raises(ValueError, match="pixel_weight"):
        next(bench.rows(quick=True, settings=["pixel_wait=8"]))
    assert len(collected) == 2


@pytest.mark.filterwarnings("ignore:.* holds a model of 2 updates already")  # then an error
def test_the_command_trains_measures_and_draws_and_then_trains_no_more(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    ran = CliRunner().invoke(app, ["bench", "prediction", "--quick", "--json"])
    assert ran.exit_code == 0, ran.output
    rows = [json.loads(line) for line in ran.stdout.splitlines()]
    five = ["generalist", "specialist", "untrained", "copy last frame", "mean frame"]
    more = ["left out", "left out, then 1 updates", "from scratch, 1 updates"]
    predicted = {robot: [r["prediction"] for r in rows if r["robot"] == robot] for robot in ROBOTS}
    assert predicted == {"walker": five + more, "cartpole": five}
    assert all(row["+1"] >= 0 and row["episodes"] == 2 for row in rows)
    folder = tmp_path / bench.QUICK.folder
    table = pd.read_csv(folder / "prediction.csv")
    assert len(table) == 13 * 41 and (table.low <= table.high).all()
    for name in ("prediction.png", "strips.png"):
        assert min(imread(folder / name).shape[:2]) > 300
    before = {path: path.stat().st_mtime_ns for path in folder.rglob("model.zip")}
    assert {path.parent.name for path in before} == {
        *("generalist", "specialist-walker", "specialist-cartpole"),
        *("left-out", "left-out-2-then", "scratch-1"),
    }
    again = CliRunner().invoke(app, ["bench", "prediction", "--quick", "--json"])
    repeated = [json.loads(line) for line in again.stdout.splitlines()]
    assert [row | {"rss_mb": 0} for row in repeated] == [row | {"rss_mb": 0} for row in rows]
    assert {path: path.stat().st_mtime_ns for path in before} == before
    fewer = CliRunner().invoke(app, ["bench", "prediction", "--quick", "--updates", "1"])
    assert isinstance(fewer.exception, ValueError)
    assert "has had 2 updates, not 1" in str(fewer.exception)


@pytest.fixture
def pre_trained(tmp_path):
    """A model file, and a dataset of two robots, of whose trajectories one is too short."""
    agent(max_action_dim=2).save(tmp_path / "model.zip")
    with TrajectoryDataset.create(tmp_path / "data") as dataset:
        dataset.extend([clock(60), clock(60), clock(20), clock(60), clock(50, speed=2)])
    return tmp_path


def test_open_loop_compares_the_model_with_the_simplest_guesses(pre_trained):
    model, data = WPT.load(pre_trained / "model.zip"), TrajectoryDataset.open(pre_trained / "data")
    rows = list(prediction.judge({"world model": model}, data, episodes=2))
    ways = ["world model", "copy last frame", "mean frame"]
    assert [(r["robot"], r["prediction"]) for r in rows] == [
        (robot, way) for robot in ("clock 1", "clock 2") for way in ways
    ]
    assert [r["episodes"] for r in rows] == [2, 2, 2, 1, 1, 1]
    copied = {r["robot"]: r for r in rows if r["prediction"] == "copy last frame"}
    assert copied["clock 1"]["+10"] == pytest.approx(PIXELS * (10 / 255) ** 2, abs=0.1)
    assert copied["clock 2"]["+10"] == pytest.approx(PIXELS * (20 / 255) ** 2, abs=0.1)


def test_open_loop_names_the_robots_whose_trajectories_are_too_short(pre_trained):
    model = WPT.load(pre_trained / "model.zip")
    with TrajectoryDataset.open(pre_trained / "data") as more:
        more.append(clock(20, speed=3))
    data = TrajectoryDataset.open(pre_trained / "data")
    with pytest.warns(UserWarning, match=r"No trajectory of clock 3 is long enough .*open_loop"):
        rows = list(prediction.judge({"world model": model}, data, episodes=2))
    assert {row["robot"] for row in rows} == {"clock 1", "clock 2"}


def test_open_loop_draws_and_refuses_what_is_too_short_or_wide(pre_trained):
    words = ["open-loop", str(pre_trained), str(pre_trained / "data")]
    ran = CliRunner().invoke(app, [*words, "--out", str(pre_trained / "seen")])
    assert ran.exit_code == 0, ran.output
    assert "clock 2" in ran.stdout
    for name in ("prediction.png", "strips.png"):
        assert min(imread(pre_trained / "seen" / name).shape[:2]) > 200
    assert len(pd.read_csv(pre_trained / "seen" / "prediction.csv")) == 2 * 3 * 41
    with TrajectoryDataset.create(pre_trained / "short") as dataset:
        dataset.append(clock(43))
    short = CliRunner().invoke(app, [*words[:2], str(pre_trained / "short")])
    assert isinstance(short.exception, ValueError)
    assert "44 images, but 5 observed and 40 predicted" in str(short.exception)
    still = noise(46)
    with TrajectoryDataset.create(pre_trained / "wide") as dataset:
        dataset.append(Trajectory(still, np.zeros((45, 3), np.float32)))
    wide = CliRunner().invoke(app, [*words[:2], str(pre_trained / "wide")])
    assert isinstance(wide.exception, ValueError)
    assert "3 actions, the model takes at most 2: take other data" in str(wide.exception)


def test_open_loop_compares_several_models_by_name(pre_trained):
    agent(max_action_dim=2, seed=1).save(pre_trained / "other.zip")
    agent(max_action_dim=3).save(pre_trained / "wider.zip")
    other, data = f"longer={pre_trained / 'other.zip'}", pre_trained / "data"
    words = ["open-loop", str(pre_trained), str(data), "--out", str(pre_trained / "seen")]
    ran = CliRunner().invoke(app, [*words, "--beside", other])
    assert ran.exit_code == 0, ran.output
    table = pd.read_csv(pre_trained / "seen" / "prediction.csv")
    assert list(table.prediction.unique()) == [
        *("world model", "longer", "copy last frame", "mean frame"),
    ]
    of = {name: rows.error.to_numpy() for name, rows in table.groupby("prediction")}
    assert not np.array_equal(of["world model"], of["longer"])
    alone = list(prediction.judge({"x": WPT.load(pre_trained / "other.zip")},
                                  TrajectoryDataset.open(data), 8))  # fmt: skip
    assert alone[0]["+1"] == pytest.approx(of["longer"][1], abs=0.1)
    ran = CliRunner().invoke(app, [*words, "--beside", other, "--samples", "2"])
    assert ran.exit_code == 0, ran.output
    table = pd.read_csv(pre_trained / "seen" / "prediction.csv")
    assert list(table.prediction.unique()) == [
        *("world model", "world model, mean of 2", "longer", "longer, mean of 2"),
        *("copy last frame", "mean frame"),
    ]
    for wrong, message in (
        (["--beside", "other.zip"], "NAME=MODEL with a new name, not other.zip"),
        (["--beside", other, "--beside", other], "with a new name"),
        (["--beside", other.replace("longer", "mean frame")], "with a new name"),
        (["--beside", f"wider={pre_trained / 'wider.zip'}"], "wider takes 3 instead of 2"),
    ):
        refused = CliRunner().invoke(app, [*words, *wrong])
        assert isinstance(refused.exception, ValueError) and message in str(refused.exception)


ROBOTS = ("walker", "cartpole")


def robot_of(task):
    return wpt_envs.TASKS[task].embodiment


def test_probes_of_one_robot_leave_the_others_out(monkeypatch, tmp_path):
    def by_name(model, tasks, episodes):
        return [{"quantity": name} for task in tasks for name in QUANTITIES[robot_of(task)]]

    monkeypatch.setattr(bench, "probes", by_name)
    monkeypatch.setattr(bench, "QUICK", bench.QUICK._replace(folder=tmp_path))
    probed = list(bench.rows(quick=True, probe=True, robots=["cartpole"]))
    assert {row["model"] for row in probed} == {"untrained", "generalist", "specialist"}
    assert {row["quantity"] for row in probed} == {"cart", "pole cos", "pole sin"}
    assert not (tmp_path / "specialist-walker").exists()
    with pytest.raises(ValueError, match="no robot dog: choose from walker, cartpole"):
        next(bench.rows(quick=True, probe=True, robots=["dog"]))
    with pytest.raises(ValueError, match="no effect without --probe"):
        next(bench.rows(quick=True, robots=["cartpole"]))
