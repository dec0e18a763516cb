"""The last evaluations of each run: their mean, the worst one and the last one."""

import html

import numpy as np
from run_folders import make_run, write_page
from typer.testing import CliRunner

from wpt_agents.zoo.commands.app import app
from wpt_agents.zoo.report import steadiness
from wpt_agents.zoo.report.folders import find_finished


def evaluated(folder, returns, successes=None):
    """Replace the evaluations of a run; the k-th is after 200 k frames, two in each step."""
    steps = 100 * np.arange(1, len(returns) + 1)
    arrays = {"timesteps": steps, "results": np.array(returns, float)}
    if successes is not None:
        arrays["successes"] = np.array(successes)
    np.savez(folder / "evaluations.npz", **arrays, ep_lengths=np.full(np.shape(returns), 50))


def test_the_last_ten_evaluations_count_by_hand(tmp_path):
    folder = make_run(tmp_path, "metaworld-reach")
    # 14 evaluations of two episodes each; the first four, without a success, are too early to count
    successes = [[False, False]] * 4 + [[True, True]] * 8 + [[False, False], [True, False]]
    evaluated(folder, np.zeros((14, 2)), successes)
    [row] = steadiness.steadiness(find_finished(tmp_path))
    assert row.means.tolist() == [1.0] * 8 + [0.0, 0.5]  # of which the mean is 8.5 / 10
    assert steadiness.cells(row)[3:] == ["0", "10", "2", "1,000", "0.85", "0.00", "0.50"]


def test_returns_of_the_second_half_count_where_the_task_counts_no_success(tmp_path):
    folder = make_run(tmp_path, "dmc-walker-run", frames=600)
    evaluated(folder, [[10.0, 30.0], [500.0, 540.0], [700.0, 740.0]])  # at 200, 400 and 600 frames
    [row] = steadiness.steadiness(find_finished(tmp_path))
    assert steadiness.cells(row)[4:] == ["2", "2", "400", "620", "520", "720"]


def test_page_and_markdown_show_them_and_leave_out_runs_without_late_evaluations(tmp_path):
    evaluated(make_run(tmp_path, "metaworld-reach", frames=400), [[0.0, 0.0]], [[True, False]])
    early = make_run(tmp_path, "metaworld-reach", seed=1, frames=500)
    evaluated(early, [[0.0, 0.0]], [[True, True]])
    (make_run(tmp_path, "metaworld-reach", seed=2, frames=400) / "evaluations.npz").unlink()
    ran = CliRunner().invoke(app, ["report", str(tmp_path), "--markdown"])
    assert ran.exit_code == 0, ran.output
    table = steadiness.markdown(steadiness.steadiness(find_finished(tmp_path)))
    assert table in ran.stdout
    line, _, note = table.splitlines()[4:]
    assert note == steadiness.NOTE and "may show an earlier policy" in note
    assert line == "| metaworld-reach | wpt | debug | 0 | 1 | 2 | 200 | 0.50 | 0.50 | 0.50 |"
    write_page(tmp_path, tmp_path / "index.html")
    page = html.unescape((tmp_path / "index.html").read_text())
    assert page.count("<th>worst</th>") == page.count(note) == 1
    (tmp_path / "debug" / "wpt" / "metaworld-reach_0" / "evaluations.npz").unlink()
    assert steadiness.markdown(steadiness.steadiness(find_finished(tmp_path))) == ""
    write_page(tmp_path, tmp_path / "index.html")
    assert "<th>worst</th>" not in (tmp_path / "index.html").read_text()
