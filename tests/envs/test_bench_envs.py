"""The speed table: a row for each rendering, the usual renderer among them."""

import json

import pytest

from wpt_agents.zoo.bench import envs

pytestmark = pytest.mark.slow  # it runs simulators or whole runs


@pytest.mark.parametrize(
    ("task", "usual"), [("dmc-acrobot-swingup", "dm_control"), ("metaworld-reach", "gymnasium")]
)
def test_each_rendering_is_measured_beside_the_usual_renderer(task, usual, monkeypatch):
    monkeypatch.setattr(envs, "THE_FOUR", (f"wpt/{task}-v0",))
    rows = json.loads(json.dumps(list(envs.rows(quick=True))))
    assert [row["rendering"] for row in rows] == ["exact", "near", "fast", usual]
    exact = rows[0]["cpu_ms_per_step"]
    for row in rows:
        assert (row["task"], row["reference"]) == (task, "exact")
        assert row["ratio_to_exact"] == pytest.approx(exact / row["cpu_ms_per_step"], rel=0.02)
