"""The result of a run: written and read back, and read as version 0.1 wrote it."""

import json

import pytest

from wpt_agents.zoo.result import (
    Change,
    Result,
    Score,
    Variant,
    read_result,
    read_score,
    write_result,
)
from wpt_agents.zoo.sequence_result import read_row

RESULT = Result(
    suite="dmc",
    task="dmc-walker-run",
    method="wpt",
    variant=Variant("tiny", (Change("collect.tasks", "[a, b]"), Change("gamma", "0.9")), "my data"),
    seed=3,
    frames=1000,
    steps=500,
    metric="success",
    scores={
        "nothing": Score((0.0, 0.0), (False, False)),
        "last": Score((1.0, 2.0), (False, True), (True, True)),
        "best": Score((3.0, 4.0), (True, True)),
    },
    seconds={"learn": 2.5},
    commit="abc",
    updates=7,
    cpu_seconds=1.5,
    model="0123456789ab",
    pretrained="ba9876543210",
)


def test_a_result_is_read_back_as_it_was_written(tmp_path):
    write_result(tmp_path, RESULT)
    assert read_result(tmp_path) == RESULT
    stored = json.loads((tmp_path / "result.json").read_text())
    assert (stored["preset"], stored["data"], stored["command"]) == (
        *("tiny", "my data"),
        RESULT.command,
    )
    assert stored["scores"]["last"]["success_rate"] == 0.5  # for other programs
    assert stored["scores"]["last"]["success_rate_any"] == 1.0
    assert stored["scores"]["best"]["success_rate_any"] is None


def test_the_best_policy_counts_if_the_run_kept_it():
    assert RESULT.final == RESULT.scores["best"] and RESULT.counted() == 1.0
    assert RESULT.counted("last") == 0.5


def test_the_name_of_a_variant_is_read_back():
    name = str(RESULT.variant)
    assert name == "tiny 'collect.tasks=[a, b]' gamma=0.9 'data=my data'"
    assert Variant.parse(name) == RESULT.variant
    assert str(
        Variant("tiny", (Change("env.rendering", "near"), Change("gamma", "1"))).playing
    ) == ("tiny env.rendering=near")


def test_the_command_has_every_change_and_the_data():
    assert RESULT.command == (
        "python -m wpt_agents.zoo run --suite dmc --tasks dmc-walker-run --method wpt --preset tiny"
        " --frames 1000 --seeds 3-3 --set 'collect.tasks=[a, b]' --set gamma=0.9 --data 'my data'"
    )


@pytest.mark.parametrize(
    ("scores", "expected"),
    [(["WPT"], ["last"]), (["random", "WPT, last", "WPT"], ["random", "last", "best"])],
)
def test_a_result_of_version_0_1_is_read_with_the_names_of_today(tmp_path, scores, expected):
    score = {"returns": [1.0], "successes": [], "mean": 1.0, "low": None, "high": None}
    stored = {
        **{"suite": "dmc", "task": "dmc-a", "method": "wpt", "preset": "debug gamma=0.9 data=x"},
        **{"seed": 0, "frames": 10, "steps": 5, "metric": "return", "seconds": {"learn": 1.0}},
        **{"commit": None, "scores": {name: score for name in scores}},
    }
    (tmp_path / "result.json").write_text(json.dumps(stored))
    result = read_result(tmp_path)
    assert list(result.scores) == expected
    assert result.variant == Variant("debug", (Change("gamma", "0.9"),), "x")
    assert (result.updates, result.cpu_seconds, result.model) == (None, None, None)


def test_no_file_is_no_result_and_a_damaged_one_is_named(tmp_path):
    assert read_result(tmp_path) is None
    (tmp_path / "result.json").write_text('{"suite": "dmc"}')
    with pytest.raises(ValueError, match=r"result.json is damaged.*delete it"):
        read_result(tmp_path)


@pytest.mark.parametrize("content", ["", "{", "[]", '{"returns": 1}'])
def test_a_damaged_score_of_a_policy_or_of_a_task_is_named(tmp_path, content):
    (tmp_path / "random.json").write_text(content)
    with pytest.raises(ValueError, match=r"random.json is damaged.*delete it"):
        read_score(tmp_path / "random.json")
    (tmp_path / "scores.json").write_text(content)
    with pytest.raises(ValueError, match=r"scores.json is damaged.*delete it"):
        read_row(tmp_path)
