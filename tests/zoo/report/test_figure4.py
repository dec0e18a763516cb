"""The report of a sequence of tasks: Fig. 4 and the matrix of returns, from made-up results."""

import numpy as np
import pytest
from run_folders import write_page
from test_page import read, text
from zoo_command import call

from wpt_agents.zoo.report.figure4 import figures_4, find_sequences
from wpt_agents.zoo.result import Score, Variant
from wpt_agents.zoo.sequence_result import Row, SequenceResult, write_sequence

TASKS = ("dmc-quadruped-stand", "dmc-quadruped-walk")


def make_sequence(out, method, returns, seed=0, evaluated=True):
    """Writes a sequence: returns[k][j] is the return on task j after task k."""
    folder = out / "tiny" / method / f"ant_{seed}"
    rows = []
    for k, task in enumerate(TASKS[: len(returns)]):
        (folder / task).mkdir(parents=True)
        scores = {TASKS[j]: Score((value,)) for j, value in enumerate(returns[k])}
        rows.append(Row(task, scores, 5, 1.0, 1.0))
        if evaluated:
            arrays = {
                "timesteps": np.array([50, 100]),
                "results": np.array([[1.0], [returns[k][k]]]),
                "ep_lengths": np.full((2, 1), 10),
            }
            np.savez(folder / task / "evaluations.npz", **arrays)
        else:
            lines = ["#{}", "r,l,t", *(f"{value}.0,10,1" for value in range(25))]
            (folder / task / "0.monitor.csv").write_text("\n".join([*lines, ""]), encoding="utf-8")
    (folder / "config.yaml").write_text("task: ant", encoding="utf-8")
    result = SequenceResult(
        "dmc", "ant", method, Variant("tiny"), seed, list(TASKS), 400, 200, rows, "0123"
    )
    write_sequence(folder, result)
    return result


@pytest.fixture
def sequences(tmp_path):
    make_sequence(tmp_path, "wpt", [[800.0], [100.0, 600.0]])
    make_sequence(tmp_path, "wpt", [[600.0], [300.0, 800.0]], seed=1)
    make_sequence(tmp_path, "packnet", [[300.0], [300.0, 400.0]], evaluated=False)
    return tmp_path


def test_a_sequence_is_read_back_as_it_was_written(tmp_path):
    result = make_sequence(tmp_path, "wpt", [[800.0], [100.0, 600.0]])
    [(folder, reread)] = find_sequences(tmp_path)
    assert reread == result and folder.name == "ant_0"
    assert reread.command.endswith("--method wpt --preset tiny --frames 400 --seeds 0-0")


def test_the_matrix_is_the_mean_over_seeds_and_packnet_is_a_share_of_wpt(sequences):
    [figure] = figures_4(find_sequences(sequences))
    matrices = {matrix.name: matrix for matrix in figure.matrices}
    assert matrices["wpt"].rows == [[700.0], [200.0, 700.0]]
    assert matrices["packnet"].rows == [[300.0], [300.0, 400.0]]
    assert matrices["packnet"].share == pytest.approx(0.5)  # (300 + 400) / (700 + 700)
    assert len(figure.curves) == 2 and not figure.missing


def test_the_page_shows_the_figure_and_what_is_missing(sequences, monkeypatch, tmp_path_factory):
    assert call(monkeypatch, "report", sequences) == 0
    page = (sequences / "report" / "index.html").read_text(encoding="utf-8")
    words = text(page)
    assert "Figure 4: the sequence ant, tiny, 400 frames a task" in words
    assert "after quadruped-walk" in words and "50 % of WPT" in words
    assert "stopped, or still running" not in words
    assert page[page.index('id="figure-4-1"') :].count("<svg") == 2
    assert not read(page).open
    other = tmp_path_factory.mktemp("other")
    make_sequence(other, "wpt", [[800.0], [100.0, 600.0]])
    write_page(other, other / "index.html")
    assert "Missing: packnet." in text((other / "index.html").read_text(encoding="utf-8"))


def test_a_folder_of_sequences_alone_has_no_empty_tables(sequences, monkeypatch, capsys):
    assert call(monkeypatch, "report", sequences) == 0
    printed = capsys.readouterr().out
    assert "packnet" in printed and "350" in printed and "paper at 150k" not in printed
    written = (sequences / "report" / "report.md").read_text(encoding="utf-8")
    assert "| after quadruped-walk | 300 | 400 |" in written
    words = text((sequences / "report" / "index.html").read_text(encoding="utf-8"))
    assert "1 sequence" in words and "Every policy" not in words and "seeds ;" not in words


def test_a_sequence_that_is_not_finished_is_shown_as_far_as_it_is(sequences):
    make_sequence(sequences, "packnet", [[100.0]], seed=1)
    [figure] = figures_4(find_sequences(sequences))
    matrices = {matrix.name: matrix for matrix in figure.matrices}
    assert matrices["packnet"].rows == [[200.0]] and len(figure.curves) == 2
    assert matrices["packnet"].share == pytest.approx(200 / 700)  # on the first task
    assert figure.missing == ["1 task of packnet, seed 1"]
    write_page(sequences, sequences / "index.html")
    words = text((sequences / "index.html").read_text(encoding="utf-8"))
    assert "Missing: 1 task of packnet, seed 1." in words and "stopped, or still running" in words


def test_a_folder_without_any_result_is_refused(monkeypatch, tmp_path, capsys):
    assert call(monkeypatch, "report", tmp_path) != 0
    assert "No finished run" in capsys.readouterr().err


def test_sequences_have_no_lines_in_a_record(sequences, monkeypatch, tmp_path, capsys):
    record = tmp_path / "record.csv"
    assert call(monkeypatch, "report", sequences, "--record", record) == 0
    assert "Page:" in capsys.readouterr().out and not record.exists()


def test_a_task_that_ends_within_its_first_episode_has_an_empty_curve(tmp_path):
    make_sequence(tmp_path, "packnet", [[300.0]], evaluated=False)
    monitor = tmp_path / "tiny" / "packnet" / "ant_0" / TASKS[0] / "0.monitor.csv"
    monitor.write_text("#{}\nr,l,t\n", encoding="utf-8")
    [figure] = figures_4(find_sequences(tmp_path))
    assert len(figure.curves) == 1 and figure.matrices[0].rows == [[300.0]]


def test_the_same_sequence_found_twice_is_refused_instead_of_counted_as_two_seeds(tmp_path):
    for copy in ("a", "b"):
        make_sequence(tmp_path / copy, "wpt", [[800.0]])
    with pytest.raises(ValueError, match="are the same run: report one of their folders"):
        find_sequences(tmp_path)
