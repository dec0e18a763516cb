"""What version 0.1 wrote still loads: model files, a checkpoint, run folders (commit 3371e94).

The archive holds a finished debug run with its data and pre-trained model, the same run killed
after its first checkpoint, an explorer's model file, and the actions that version 0.1 predicted.
"""

import json
import shutil
import tarfile
from pathlib import Path

import numpy as np
import pytest
from zoo_command import call

from wpt_agents.agents.curious import Plan2Explore
from wpt_agents.agents.wpt import WPT
from wpt_agents.files.model_file import read_model
from wpt_agents.training.hyperparameters import Hyperparameters
from wpt_agents.zoo.report.folders import find_finished

ARCHIVE = Path(__file__).parent / "fixtures" / "version-0.1.tar.xz"
RUN = "debug/wpt/metaworld-button-press_0"


@pytest.fixture(scope="module")
def earlier(tmp_path_factory):
    folder = tmp_path_factory.mktemp("version-0.1")
    with tarfile.open(ARCHIVE) as archive:
        archive.extractall(folder, filter="data")
    return folder


def predicted(model):
    images = np.random.default_rng(0).integers(0, 256, (6, 2, 64, 64, 3)).astype(np.uint8)
    state, actions = None, []
    for image in images:
        action, state = model.predict(image, state, deterministic=True)
        actions.append(action)
    return np.stack(actions)


def test_the_page_about_migrating_names_every_keyword_that_is_new(earlier):
    header, _ = read_model(earlier / "finished" / RUN / "model.zip")
    page = (Path(__file__).parents[1] / "docs" / "migrating.md").read_text()
    new = Hyperparameters.declared().keys() - header["hyperparameters"].keys()
    assert {"fast", "ibrl"} <= new
    assert not {name for name in new if f"`{name}`" not in page}


@pytest.mark.parametrize(
    ("agent", "path", "name"),
    [
        (WPT, f"finished/{RUN}/model.zip", "wpt"),
        (Plan2Explore, "plan2explore.zip", "plan2explore"),
    ],
)
def test_a_model_file_of_version_0_1_acts_as_it_did(earlier, agent, path, name):
    expected = np.load(earlier / "expected.npz")[name]
    np.testing.assert_allclose(predicted(agent.load(earlier / path)), expected, atol=1e-4)


def test_a_run_folder_of_version_0_1_is_read(earlier):
    results = find_finished(earlier / "finished")
    assert len(results) == 1


@pytest.mark.slow
def test_a_run_killed_in_version_0_1_goes_on_from_its_checkpoint(earlier, monkeypatch, tmp_path):
    for name in ("interrupted", "finished"):
        shutil.copytree(earlier / name, tmp_path / name)
    shutil.copytree(earlier / "finished" / "cache", tmp_path / "interrupted" / "cache")
    monkeypatch.chdir(tmp_path)
    words = "run --suite metaworld --tasks button-press --preset debug --method wpt"
    words += " --set learn.checkpoint_every=400 --out interrupted"
    assert call(monkeypatch, *words.split()) == 0
    done = json.loads((tmp_path / "interrupted" / RUN / "result.json").read_text())
    before = json.loads((tmp_path / "finished" / RUN / "result.json").read_text())
    assert done["steps"] == before["steps"]
    clone = done["scores"]["prior actor"]["mean"]  # cloned in version 0.1, before the checkpoint
    assert clone == pytest.approx(before["scores"]["prior actor"]["mean"], rel=1e-3)
