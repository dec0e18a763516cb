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
    assert f"wpt_agents-{PROJECT['version']}-py3-none-any.whl" in (ROOT / "README.md").read_text()


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
def test_the_wheel_contains_presets_references_models_and_templates(built):
    (wheel,) = built.glob("*.whl")
    names = set(zipfile.ZipFile(wheel).namelist())
    zoo = ROOT / "zoo"
    folders = [zoo / name for name in ("references", "models", "sequences")]
    for path in [*zoo.glob("*.yaml"), *(path for folder in folders for path in folder.iterdir())]:
        assert f"wpt_agents/zoo/presets/{path.relative_to(zoo)}" in names
    assert "wpt_agents/zoo/presets/models/metaworld-mid.zip" in names
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
def test_the_shipped_models_load_by_name_from_the_wheel(installed, tmp_path):
    names = sorted(path.stem for path in (ROOT / "zoo" / "models").glob("*.zip"))
    assert {"dmc-mid", "metaworld-mid"} <= set(names)
    code = f"from wpt_agents import WPT; print([WPT.load(n).max_action_dim for n in {names}])"
    ran = outside(installed, tmp_path, "-c", code)
    assert ran.stdout.strip() == "[12, 4]", ran.stdout + ran.stderr


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
    assert ran.returncode == 0 and re.search(r"return: mean -?\d+", ran.stdout), ran.stderr[-2000:]


NEWER = "mujoco>=3.3.3,<4"  # than 3.3.0, which metaworld, in the extra `sims`, pins
BESIDE = """
import sys
import gymnasium, mujoco, numpy
import wpt_envs
from wpt_agents import Trajectory, WPT
assert mujoco.__file__.startswith(sys.argv[1]), mujoco.__file__
assert tuple(map(int, mujoco.__version__.split(".")[:3])) > (3, 3, 0), mujoco.__version__
env = gymnasium.make("InvertedPendulum-v5", max_episode_steps=20)
env = wpt_envs.pixels(env, rendering="fast")
images, actions = [env.reset(seed=0)[0]], []
for _ in range(12):
    actions.append(env.action_space.sample() / 3)
    images.append(env.step(3 * actions[-1])[0])
data = [Trajectory(numpy.stack(images), numpy.stack(actions))]
small = {"size": "debug", "batch_size": 2, "batch_length": 8, "max_action_dim": 1, "seed": 0}
model = WPT.pretrain(data, steps=1, num_retrieve=1, bc_steps=1, **small)
model.set_env(env)
model.learn(20)
print("learnt beside", mujoco.__version__, images[0].std() > 3)
"""


def pip(*words):
    command = [sys.executable, "-m", "pip", "install", "-q", *words]
    return subprocess.run(command, capture_output=True, text=True)


@pytest.mark.nightly
def test_the_plain_wheel_works_beside_a_newer_mujoco_and_only_the_simulators_pin_one(
    built, installed, tmp_path
):
    (wheel,) = built.glob("*.whl")
    fetched = pip("--no-deps", "--target", str(tmp_path / "newer"), NEWER)
    if fetched.returncode:
        pytest.skip(f"pip finds no newer mujoco here: {fetched.stderr.strip().splitlines()[-1]}")
    (tmp_path / "newer").rename(installed / "newer")
    env = os.environ | {"PYTHONPATH": os.pathsep.join(map(str, (installed / "newer", installed)))}
    command = [sys.executable, "-P", "-c", BESIDE, str(installed / "newer")]
    ran = subprocess.run(command, cwd=tmp_path, env=env, capture_output=True, text=True)
    assert re.search(r"learnt beside 3\.\d+\.\d+ True", ran.stdout), ran.stdout + ran.stderr
    plain = pip("--dry-run", str(wheel), NEWER)
    assert plain.returncode == 0, plain.stderr
    simulators = pip("--dry-run", f"{wheel}[sims]", NEWER)  # the resolver does look at the pins
    assert simulators.returncode != 0 and "mujoco" in simulators.stderr
