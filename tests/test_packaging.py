"""The sdist and the wheel: what they contain, and that the wheel works outside the checkout."""

import os
import re
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def test_the_version_is_the_same_everywhere():
    source = (ROOT / "wpt_agents" / "__init__.py").read_text()
    citation = (ROOT / "CITATION.cff").read_text()
    changelog = (ROOT / "CHANGELOG.md").read_text()
    assert re.search(r'__version__ = "(.*)"', source)[1] == PROJECT["version"]
    assert re.search(r"^version: (.*)$", citation, re.M)[1] == PROJECT["version"]
    assert f"## [{PROJECT['version']}] - 20" in changelog


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """A folder with the sdist and the wheel that was made from it."""
    pytest.importorskip("build", reason='needs `pip install -e ".[docs]"`')
    folder = tmp_path_factory.mktemp("dist")
    subprocess.run([sys.executable, "-m", "build", "-o", str(folder), str(ROOT)], check=True)
    return folder


@pytest.fixture(scope="module")
def installed(built, tmp_path_factory):
    """A folder with the wheel alone; its dependencies are those of this environment."""
    folder = tmp_path_factory.mktemp("installed")
    (wheel,) = built.glob("*.whl")
    command = [sys.executable, "-m", "pip", "install", "-q", "--no-deps", "--target", str(folder)]
    subprocess.run([*command, str(wheel)], check=True)
    return folder


def outside(installed, folder, *words):
    """Run Python on the installed wheel, away from the checkout."""
    env = os.environ | {"PYTHONPATH": str(installed), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-P", *words]
    return subprocess.run(command, cwd=folder, env=env, capture_output=True, text=True, timeout=900)


@pytest.mark.nightly
def test_twine_accepts_both(built):
    pytest.importorskip("twine", reason='needs `pip install -e ".[docs]"`')
    files = [str(path) for path in built.iterdir()]
    assert len(files) == 2
    checked = [sys.executable, "-m", "twine", "check", "--strict", *files]
    assert subprocess.run(checked).returncode == 0


@pytest.mark.nightly
def test_the_wheel_contains_presets_references_and_templates(built):
    (wheel,) = built.glob("*.whl")
    names = set(zipfile.ZipFile(wheel).namelist())
    for path in [*(ROOT / "zoo").glob("*.yaml"), *(ROOT / "zoo" / "references").iterdir()]:
        assert f"wpt_agents/zoo/presets/{path.relative_to(ROOT / 'zoo')}" in names
    for path in (ROOT / "wpt_agents").rglob("*.jinja"):
        assert str(path.relative_to(ROOT)) in names
    assert {"wpt_agents/py.typed", "wpt_envs/py.typed"} <= names
    assert not [name for name in names if name.startswith(("tests/", "docs/", "examples/"))]


@pytest.mark.nightly
def test_the_sdist_contains_tests_and_documentation(built):
    (sdist,) = built.glob("*.tar.gz")
    names = {name.split("/", 1)[-1] for name in tarfile.open(sdist).getnames()}
    assert {"docs/index.md", "examples/resume.py", "tests/conftest.py", "CITATION.cff"} <= names


@pytest.mark.nightly
def test_the_wheel_works_outside_the_checkout(installed, tmp_path):
    where = outside(installed, tmp_path, "-c", "import wpt_agents; print(wpt_agents.__file__)")
    assert where.stdout.startswith(str(installed)), where.stdout + where.stderr
    listed = outside(installed, tmp_path, "-m", "wpt_agents.zoo", "list")
    assert listed.returncode == 0 and "metaworld-drawer-close" in listed.stdout, listed.stderr
    words = "run --tasks walker-run --preset debug --dry-run".split()
    planned = outside(installed, tmp_path, "-m", "wpt_agents.zoo", *words)
    assert planned.returncode == 0, planned.stderr


@pytest.mark.nightly
def test_the_readmes_example_runs_from_the_wheel(installed, tmp_path):
    readme = (ROOT / "README.md").read_text()
    code = re.search(r"## Example\n.*?```python\n(.*?)```", readme, re.S)[1]
    for said, small in {
        "episodes=20": "episodes=1",
        "steps=1500": "steps=2",
        "learn(4000": "learn(400",
        "bc_steps=300": "bc_steps=2",
        "train_ratio=40": "train_ratio=1",
    }.items():
        assert said in code, said
        code = code.replace(said, small)
    (tmp_path / "example.py").write_text(code)
    ran = outside(installed, tmp_path, "example.py")
    assert ran.returncode == 0 and re.search(r"return \d+", ran.stdout), ran.stderr[-2000:]
