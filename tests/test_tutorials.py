"""The tutorials: every notebook is listed and runs from top to bottom at a small size."""

import ast
import json
import re
from importlib import import_module
from pathlib import Path

import pytest

TUTORIALS = Path(__file__).parents[1] / "docs" / "tutorials"
NOTEBOOKS = sorted(TUTORIALS.glob("*.ipynb"))


def test_every_notebook_is_listed():
    page = (TUTORIALS / "index.md").read_text()
    names = [path.name for path in NOTEBOOKS]
    assert names and sorted(set(re.findall(r"\((\S+\.ipynb)\)", page))) == names
    toctree = re.search(r"```{toctree}\n:hidden:\n(.*?)```", page, re.S)[1].split()
    assert toctree == [name.removesuffix(".ipynb") for name in names]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_what_a_notebook_imports_of_the_library_exists(path):
    cells = [cell for cell in json.loads(path.read_text())["cells"] if cell["cell_type"] == "code"]
    code = re.sub(r"^!.*$", "", "\n".join("".join(cell["source"]) for cell in cells), flags=re.M)
    for node in ast.walk(ast.parse(code)):
        if isinstance(node, ast.ImportFrom) and node.module.startswith("wpt_"):
            for alias in node.names:
                assert hasattr(import_module(node.module), alias.name), (node.module, alias.name)


@pytest.mark.nightly
@pytest.mark.filterwarnings("default")  # Jupyter's own
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs(path, tmp_path, monkeypatch):
    reason = 'needs `pip install -e ".[docs]"`'
    nbformat = pytest.importorskip("nbformat", reason=reason)
    nbclient = pytest.importorskip("nbclient", reason=reason)
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    notebook = nbformat.read(path, as_version=4)
    (parameters,) = [c for c in notebook.cells if "parameters" in c.metadata.get("tags", [])]
    names = set(re.findall(r"^(\w+) =", parameters.source, re.M))
    parameters.source = parameters.metadata["debug"]
    assert set(re.findall(r"^(\w+) =", parameters.source, re.M)) == names
    resources = {"metadata": {"path": str(tmp_path)}}
    nbclient.NotebookClient(notebook, timeout=900, resources=resources).execute()
    printed = "".join(
        output.get("text", "")
        for cell in notebook.cells
        if cell.cell_type == "code"
        for output in cell.outputs
    )
    assert "Traceback" not in printed
