"""What `pip install wpt-agents` alone brings is enough to pre-train and to act."""

import resource
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
EXTRAS = (  # import names of what only the extras install
    *("metaworld", "dm_control", "mujoco", "gymnasium_robotics", "labmaze"),
    *("matplotlib", "jinja2", "typer", "rich", "yaml", "imageio", "tensorboard"),
    *("minari", "h5py", "pyarrow", "av", "wpt_envs"),
)
WITHOUT_EXTRAS = f"""
import sys
class Blocked:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {EXTRAS}:
            raise ModuleNotFoundError(f"No module named {{name!r}} (blocked)", name=name)
sys.meta_path.insert(0, Blocked())
"""
SMALL = """
import numpy as np, wpt_agents
rng = np.random.default_rng(0)
trajectories = [
    wpt_agents.Trajectory(
        image=rng.integers(0, 255, (21, 64, 64, 3), np.uint8),
        action=rng.uniform(-1, 1, (20, 2)).astype(np.float32),
    )
    for _ in range(3)
]
model = wpt_agents.WPT.pretrain(
    trajectories, size="debug", steps=1, batch_size=2, batch_length=8, max_action_dim=2, seed=0
)
action, state = model.predict(trajectories[0].image[:1], deterministic=True)
print("action", action.shape)
"""


def python(code, *words):
    return subprocess.run(
        [sys.executable, *(words or ("-c", code))], capture_output=True, text=True, cwd=ROOT
    )


def test_pretraining_and_acting_need_no_extra():
    done = python(WITHOUT_EXTRAS + SMALL)
    assert "action (1, 2)" in done.stdout, done.stderr


@pytest.mark.parametrize(
    ("code", "extra"),
    [("import runpy; runpy.run_module('wpt_agents.zoo', run_name='__main__')", "all")],
)
def test_what_needs_an_extra_says_which_in_one_sentence(code, extra):
    done = python(WITHOUT_EXTRAS + code)
    assert f'pip install "wpt-agents[{extra}]"' in done.stderr
    assert done.returncode == 2 and done.stderr.count("\n") == 1


def test_a_module_of_ours_that_is_missing_is_not_called_a_missing_package():
    broken = "import sys; sys.modules['wpt_agents.zoo.commands.app'] = None; "
    done = python(broken + "import runpy; runpy.run_module('wpt_agents.zoo', run_name='__main__')")
    assert "Traceback" in done.stderr and "pip install" not in done.stderr


def test_importing_the_package_loads_no_torch():
    code = "import sys, wpt_agents; print(sorted({'torch', 'numpy', 'typer'} & {*sys.modules}))"
    assert python(code).stdout == "[]\n"


def test_every_public_name_is_there_and_a_wrong_one_is_an_attribute_error():
    import wpt_agents

    assert all(getattr(wpt_agents, name) is not None for name in wpt_agents.__all__)
    assert set(wpt_agents.__all__) <= set(dir(wpt_agents))
    with pytest.raises(AttributeError, match="no attribute 'wtp'"):
        wpt_agents.wtp  # noqa: B018


def test_the_imports_of_version_0_1_still_work_and_say_what_to_write():
    with pytest.warns(DeprecationWarning, match="from wpt_agents import collect"):
        from wpt_agents.zoo.collect import collect
    with pytest.warns(DeprecationWarning, match="from wpt_agents.zoo.plan.presets import load_p"):
        from wpt_agents.zoo.presets import load_preset
    assert callable(collect) and load_preset("dmc", "debug").wpt["size"] == "debug"


def seconds(*words):
    """The processor seconds of a Python process, the least of three."""
    took = []
    for _ in range(3):
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        python("", *words)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        took.append(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)
    return min(took)


@pytest.mark.slow  # compares times
def test_the_help_takes_little_longer_than_typer_itself():
    """As a ratio, since machines differ. Rich, which draws the help, is two thirds of the rest."""
    assert seconds("-m", "wpt_agents.zoo", "--help") < 5 * seconds("-c", "import typer")


def test_everything_that_a_makefile_or_a_test_installs_is_in_an_extra():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    assert extras["all"] == ["wpt-agents[sims,zoo,data]"]
    assert "wpt-agents[all]" in extras["dev"]
    assert "[all,dev]" in (ROOT / "Makefile").read_text()
