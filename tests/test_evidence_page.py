"""The commands of docs/evidence.md plan the runs that the page says, and nothing else."""

import re
from pathlib import Path

import pytest
from typer.testing import CliRunner

from wpt_agents.zoo.commands.app import app
from wpt_agents.zoo.plan.presets import load_preset
from wpt_agents.zoo.report.evidence import HIGH, LOW, paper_scores
from wpt_agents.zoo.run import dispatch
from wpt_agents.zoo.tasks import short_name

PAGE = (Path(__file__).parents[1] / "docs" / "evidence.md").read_text(encoding="utf-8")
RUNS = dict(re.findall(r"^\| ([A-D]) \| (\d+) \|", PAGE, re.M))
WITHOUT_GAP = {"metaworld-door-unlock", "dmc-cartpole-balance"}


def planned(part, monkeypatch):
    """Return the runs of the commands below the heading of a part."""
    (text,) = re.findall(rf"^### {part}: .*?```bash\n(.*?)```", PAGE, re.M | re.S)
    runs = []
    monkeypatch.setattr(dispatch, "preview", lambda plan, *_: runs.extend(plan))
    for command in text.replace("$RECORD", "mid.csv").splitlines():
        words = command.removeprefix("python -m wpt_agents.zoo ").split()
        assert CliRunner().invoke(app, [*words, "--dry-run"]).exit_code == 0, command
    return runs


@pytest.mark.parametrize("part", "ABCD")
def test_each_part_has_as_many_runs_as_the_page_says(part, monkeypatch):
    runs = planned(part, monkeypatch)
    assert len({run.folder for run in runs}) == len(runs) == int(RUNS[part])
    assert {str(run.variant) for run in runs} == {"mid"}  # others are not in the tables


def test_runs_with_different_budgets_are_in_different_folders(monkeypatch):
    budgets = {}
    for part in RUNS:
        for run in planned(part, monkeypatch):
            budgets.setdefault(run.folder, set()).add(run.preset.steps)
    assert {len(steps) for steps in budgets.values()} == {1}


def test_part_a_is_every_task_of_the_paper_and_b_the_tasks_with_a_gap_and_two_controls(monkeypatch):
    tasks = {short_name(run.task) for run in planned("A", monkeypatch)}
    assert len(tasks) == 50
    chosen = {short_name(run.task) for run in planned("B", monkeypatch)}
    assert len(chosen) == 4 + 3 + 2
    papers = {}
    for suite in ("metaworld", "dmc"):
        for method, scores in paper_scores(suite).items():
            papers.setdefault(method, {}).update(scores)
    with_gap = {
        task
        for task in chosen
        if max(papers["dreamer-v3"][task], papers["drq-v2"][task]) <= LOW
        and papers["wpt"][task] >= HIGH
    }
    assert with_gap == chosen - WITHOUT_GAP


@pytest.mark.parametrize(
    ("column", "suite", "name"), [(0, "metaworld", "mid"), (1, "dmc", "mid"), (2, "dmc", "paper")]
)
def test_the_table_of_the_preset_has_the_numbers_of_its_file(column, suite, name):
    (text,) = re.findall(r"\n## The preset\n.*?\n(\|.*?)\n\n", PAGE, re.S)
    rows = [[cell.strip() for cell in row.strip("|").split("|")] for row in text.splitlines()[2:]]
    cells = {row[0].split(" ")[0]: row[1 + column] for row in rows}
    preset = load_preset(suite, name)
    batch, length = preset.wpt["batch_size"], preset.wpt["batch_length"]
    ratio, steps = preset.wpt["train_ratio"], preset.steps
    assert cells["frames;"] == f"{preset.learn.frames:,}; {steps:,}"
    assert cells["batch"] == f"{batch} x {length}; {preset.wpt.get('imagine_starts', 'all')}"
    assert cells["train"] == f"{ratio}; {steps * ratio // (batch * length):,}"
    share = {"a sixth (ten episodes)": 1 / 6, "a tenth": 0.1}[cells["warm-up,"]]
    assert preset.wpt["warmup_steps"] == pytest.approx(share * steps)
