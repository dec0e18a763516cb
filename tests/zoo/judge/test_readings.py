"""The readings of `diagnose`: logged values at an update, the dream's error, the prior actor."""

import math

import pytest
from run_folders import make_run

from wpt_agents.zoo.judge.diagnosis import Promise
from wpt_agents.zoo.judge.readings import (
    ENTROPY,
    REWARD_ERROR,
    Logged,
    largest_difference,
    last_logged,
    narrowest_entropy,
    readings,
)

# An evaluation's row has the values of an episode, the row that follows the updates of that step.
PROGRESS = """\
time/total_timesteps,train/updates,train/heldout_reward_error,train/entropy
100,0,9.5,
200,,4.5,2.5
200,250,,
300,590,1.5,
400,610,1.0,-0.5
"""
PROMISES = [Promise(0, 2.0, 2.5, 0, 0, 0), Promise(20, -4.0, -3.0, 0, 0, 0)]


@pytest.fixture
def folder(tmp_path):
    folder = make_run(tmp_path, "metaworld-reach")
    (folder / "progress.csv").write_text(PROGRESS)
    return folder


def test_the_last_value_up_to_an_update_counts_and_rows_of_a_step_belong_together(folder):
    path = folder / "progress.csv"
    assert last_logged(path, REWARD_ERROR, 600) == Logged(1.5, 590)
    assert last_logged(path, ENTROPY, 600) == Logged(2.5, 250)
    assert last_logged(path, ENTROPY, 610) == Logged(-0.5, 610)
    assert last_logged(path, ENTROPY, 249) is None  # not logged by then
    assert last_logged(path, "train/none", 600) is None
    assert last_logged(folder / "none.csv", ENTROPY, 600) is None


def test_a_damaged_log_is_named(folder):
    path = folder / "progress.csv"
    for text in (PROGRESS.replace("2.5", "2.?"), "100,0\n200,1\n"):
        path.write_text(text)
        with pytest.raises(ValueError, match=r"progress.csv is damaged"):
            last_logged(path, ENTROPY, 600)


def test_the_narrowest_entropy_is_that_of_a_normal_with_a_tenth():
    # 4 actions of ln(0.1 sqrt(2 pi e)) each; 10 standard deviations from the bounds
    expected = 4 * math.log(0.1 * math.sqrt(2 * math.pi * math.e))
    assert narrowest_entropy(4) == pytest.approx(expected, abs=1e-4)


def test_the_largest_difference_is_relative_to_what_was_earned():
    assert largest_difference(PROMISES) == 0.25  # 0.5 / 2 and 1 / 4
    assert largest_difference([Promise(0, 0.0, 0.1, 0, 0, 0)]) == math.inf


@pytest.mark.parametrize("earned", [0.0, 1e-27])
def test_a_step_that_earns_nothing_has_no_relative_difference(folder, earned):
    none = Promise(0, earned, 0.1, 0, 0, 0)
    rows = {row.what: (row.value, row.beside) for row in readings(folder, [none], 4, 600)}
    name = "imagined reward of the same actions, largest difference"
    assert rows[name] == ("undefined", "a step earned nothing")


def test_readings_are_those_that_the_folder_allows(folder):
    rows = {row.what: (row.value, row.beside) for row in readings(folder, PROMISES, 4, 600)}
    assert rows == {
        "error of the reward head on a new episode, update 590": ("1.50", "earned -1.00 per step"),
        "entropy of the actor in nats, update 250": (
            *("2.50", "-3.53 with means of 0 and the smallest deviations"),
        ),
        "imagined reward of the same actions, largest difference": ("25 %", "of the earned reward"),
        # returns 4 and 5 are no successes, 10 and 20 are
        "prior actor": ("0.00", "success rate; the final policy 1.00"),
    }
    (folder / "progress.csv").unlink()
    (folder / "result.json").unlink()
    (only,) = readings(folder, PROMISES, 4)
    assert only.value == "25 %"
