"""A damaged file in one run folder is named, and the report shows everything else."""

import json
import warnings

import pytest
from run_folders import make_run, write_page
from test_figure4 import TASKS, make_sequence
from test_page import text
from zoo_command import call

from wpt_agents.zoo.report.figure4 import figures_4, find_sequences
from wpt_agents.zoo.report.folders import find_finished

ALL = ("evaluations.npz", "result.json", "system.json", "predictions.png", "retrieval.png")


def empty(content):
    return b""


def cut(content):
    return content[: len(content) // 2]


def damage(path, how):
    path.write_bytes(how(path.read_bytes()))


@pytest.mark.parametrize("form", [[], ["--markdown"]])
def test_a_run_that_failed_is_named_beside_the_means(form, runs, tmp_path, monkeypatch, capsys):
    (runs[1] / "result.json").unlink()
    (runs[1] / "error.txt").write_text("Traceback\nRuntimeError: [out] of luck\n")
    assert call(monkeypatch, "report", tmp_path, *form) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert "Not finished, and in none of these numbers: 1 run: " in printed
    assert "walker-run_1 (RuntimeError: [out] of luck)" in printed


@pytest.fixture
def runs(tmp_path):
    """Two runs of which the first one will be damaged."""
    return [make_run(tmp_path, "dmc-walker-run", seed, returns=(700.0, 800.0)) for seed in (0, 1)]


@pytest.mark.parametrize("lacking", ["successes", "returns", "last"])
def test_a_result_without_what_counts_is_left_out(lacking, tmp_path):
    folders = [make_run(tmp_path, "metaworld-reach", seed) for seed in (0, 1)]
    content = json.loads((folders[0] / "result.json").read_text())
    if lacking == "last":
        del content["scores"]["last"]
    else:
        content["scores"]["random"][lacking] = []
    (folders[0] / "result.json").write_text(json.dumps(content))
    with pytest.warns(UserWarning, match=r"Left out: .*reach_0/result.json is damaged"):
        write_page(tmp_path, tmp_path / "index.html")
    assert (tmp_path / "index.html").read_text().count('class="run" id=') == 1


@pytest.mark.parametrize("how", [empty, cut])
@pytest.mark.parametrize("name", ALL)
def test_the_page_shows_the_rest(name, how, runs, tmp_path):
    damage(runs[0] / name, how)
    with pytest.warns(UserWarning, match=rf"Left out: .*run_0/{name} is damaged .*; (delete|rest)"):
        write_page(tmp_path, tmp_path / "index.html", "all")
    page = (tmp_path / "index.html").read_text()
    shown = page.count('class="run" id=')
    assert shown == (1 if name == "result.json" else 2)
    assert page.count("<figcaption>Upper row") == (1 if name == "predictions.png" else shown)
    late = page[page.index('<table class="late">') : page.index('<section id="runs">')]
    assert late.count("<tr>") == 1 + (1 if name == "evaluations.npz" else shown)


@pytest.mark.parametrize("how", [empty, cut])
@pytest.mark.parametrize("form", ["--csv", "--markdown"])
@pytest.mark.parametrize("name", ["evaluations.npz", "result.json"])
def test_tables_have_the_rest(name, form, how, runs, tmp_path, monkeypatch, capsys):
    damage(runs[0] / name, how)
    with pytest.warns(UserWarning, match=rf"Left out: .*run_0/{name} is damaged"):
        assert call(monkeypatch, "report", tmp_path, form) == 0
    printed = capsys.readouterr().out
    seeds = "1" if name == "result.json" else "0"
    assert "dmc-walker-run" in printed and "750" in printed
    assert (f",{seeds}" if form == "--csv" else f"eed{'s' * (seeds == '0')} {seeds}") in printed


@pytest.mark.parametrize("name", ALL)
def test_a_damaged_file_is_named_once(name, runs, tmp_path, monkeypatch, capsys):
    damage(runs[0] / name, cut)
    with pytest.warns(UserWarning) as warned:
        assert call(monkeypatch, "report", tmp_path) == 0
    assert len(warned) == 1 and name in str(warned[0].message)


def test_the_command_line_prints_the_warning_without_a_line_of_code(runs, tmp_path, monkeypatch):
    damage(runs[0] / "evaluations.npz", cut)
    with pytest.warns(UserWarning) as warned:
        assert call(monkeypatch, "report", tmp_path) == 0
    [one] = warned
    printed = warnings.formatwarning(one.message, one.category, one.filename, one.lineno)
    assert printed == f"Warning: {one.message}\n"
    other = warnings.formatwarning("old", DeprecationWarning, one.filename, one.lineno)
    assert ".py:" in other and "DeprecationWarning: old" in other


def test_a_run_with_a_damaged_result_is_among_those_that_failed(runs, tmp_path):
    damage(runs[0] / "result.json", cut)
    with pytest.warns(UserWarning, match="Left out"):
        write_page(tmp_path, tmp_path / "index.html")
    page = (tmp_path / "index.html").read_text()
    failed = text(page[page.index('<section id="unfinished">') :])
    assert "result.json is damaged" in failed and "delete it and run again" in failed


def test_an_error_that_is_no_text_is_shown_as_far_as_it_is(tmp_path):
    (tmp_path / "config.yaml").write_text("")
    (tmp_path / "error.txt").write_bytes(b"Out of \xff luck")
    write_page(tmp_path, tmp_path / "index.html")
    assert "Out of \ufffd luck" in (tmp_path / "index.html").read_text()


def test_evaluations_cut_anywhere_are_damaged(runs, tmp_path):
    path = runs[0] / "evaluations.npz"
    content = path.read_bytes()
    for size in range(0, len(content), 20):
        path.write_bytes(content[:size])
        with pytest.warns(UserWarning, match="evaluations.npz is damaged"):
            assert find_finished(tmp_path)[0].evaluations() is None


def test_a_damaged_sequence_leaves_the_others(tmp_path):
    for seed in (0, 1):
        make_sequence(tmp_path, "wpt", [[800.0], [100.0, 600.0 + seed]], seed)
    damage(tmp_path / "tiny" / "wpt" / "ant_0" / "sequence.json", cut)
    with pytest.warns(UserWarning, match=r"ant_0/sequence\.json is damaged"):
        [(folder, _)] = find_sequences(tmp_path)
    assert folder.name == "ant_1"
    with pytest.warns(UserWarning, match=r"ant_0/sequence\.json is damaged"):
        write_page(tmp_path, tmp_path / "index.html")
    page = (tmp_path / "index.html").read_text()
    assert "sequence.json is damaged" in page[page.index('<section id="unfinished">') :]


@pytest.mark.parametrize(
    ("evaluated", "name", "content"),
    [(True, "evaluations.npz", ""), (False, "0.monitor.csv", "#{}\nr,l,t\n5.0,x,1\n")],
)
def test_a_damaged_curve_of_a_sequence_leaves_those_of_other_seeds(
    evaluated, name, content, tmp_path
):
    for seed in (0, 1):
        make_sequence(tmp_path, "packnet", [[300.0]], seed, evaluated)
    [whole] = figures_4(find_sequences(tmp_path))
    (tmp_path / "tiny" / "packnet" / "ant_0" / TASKS[0] / name).write_text(content)
    with pytest.warns(UserWarning, match=f"ant_0.*{name} is damaged"):
        [figure] = figures_4(find_sequences(tmp_path))
    assert figure.curves == whole.curves  # both seeds had the same episodes
