"""The package's root is imported without torch, and version 0.1's import paths still work."""

import importlib
import subprocess
import sys

import pytest

import wpt_agents
from wpt_agents.files import moved


def python(code):
    return subprocess.run(
        [sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, check=True
    ).stdout


def test_importing_the_package_imports_nothing_heavy():
    loaded = python("import sys, wpt_agents; print(*sys.modules)").split()
    heavy = {"torch", "numpy", "gymnasium", "stable_baselines3", "faiss", "rich", "matplotlib"}
    assert not heavy & set(loaded)


def test_the_public_names_are_there_when_they_are_asked_for():
    assert {"WPT", "Trajectory", "TrajectoryDataset"} <= set(dir(wpt_agents))
    for name in wpt_agents.__all__:
        assert getattr(wpt_agents, name).__name__ == name
    assert set(wpt_agents.__all__) == set(wpt_agents.PUBLIC)
    with pytest.raises(AttributeError, match="no attribute 'WTP'"):
        wpt_agents.WTP  # noqa: B018


@pytest.mark.parametrize("old", sorted(moved.MOVED))
def test_an_import_path_of_version_0_1_works_with_a_warning(old):
    new = importlib.import_module(moved.MOVED[old])
    sys.modules.pop(old, None)
    with pytest.warns(DeprecationWarning, match=rf"{old} has moved to {new.__name__}\.") as caught:
        module = importlib.import_module(old)
    assert {w.filename for w in caught if old in str(w.message)} != {moved.__file__}
    public = [name for name in vars(new) if not name.startswith("_")]
    assert all(getattr(module, name) is getattr(new, name) for name in public)


@pytest.mark.parametrize(
    ("old", "names"),
    [
        ("wpt", ["WPT"]),
        ("policy", ["WPTPolicy", "PriorPolicy", "to_images"]),
        ("dataset", ["TrajectoryDataset"]),
        ("trajectory", ["Trajectory", "Batch", "led_to"]),
        ("exploration", ["ICM", "ICMExplorer", "Plan2Explore", "Explorer", "EXPLORE", "EXPLORERS"]),
        ("retrieval", ["Retriever"]),
        ("replay", ["ReplayBuffer", "mix"]),
        ("rssm", ["Latent", "RSSM"]),
        ("networks", ["SIZES", "Size", "Encoder", "interleaved", "cpu_model", "in_bfloat16"]),
        ("acting", ["FastStep", "FastConv", "in_blocks"]),
        ("checks", ["check_dataset", "check_spaces"]),
        ("scan", ["FilterScan", "Tape"]),
        ("updates", ["torch_seed"]),
        ("world_model", ["WorldModel"]),
        ("actor_critic", ["lambda_return", "Actor", "Critic"]),
        ("behavior_cloning", ["PriorActor", "bc_loss"]),
        ("guidance", ["parse_schedule", "linear"]),
    ],
)
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_public_names_of_version_0_1_are_at_their_old_paths(old, names):
    module = importlib.import_module(f"wpt_agents.{old}")
    assert all(hasattr(module, name) for name in names)


def test_the_warning_names_the_line_that_imports():
    code = "import warnings; warnings.simplefilter('always')\nfrom wpt_agents.names import counted"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "<string>:2: DeprecationWarning" in done.stderr


def test_other_names_are_not_found():
    with pytest.raises(ModuleNotFoundError, match=r"wpt_agents\.nowhere"):
        importlib.import_module("wpt_agents.nowhere")
