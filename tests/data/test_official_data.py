"""The authors' data folder: labels from its paths, and a conversion that survives a kill."""

import subprocess
import sys
import time
import warnings

import numpy as np
import pytest
from chain import chain, follows
from test_importers import save_npz

from wpt_agents.data.dataset import TrajectoryDataset
from wpt_agents.data.importers.formats import open_episodes, recognise
from wpt_agents.data.importers.official import OfficialEpisodes, is_official


def save(folder, number, trajectory, scale=1.0):
    """Writes an episode as the authors' code does: action t led to image t, channels first."""
    length = len(trajectory)
    width = trajectory.action.shape[1]
    folder.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(
        folder / f"20240101T000000-{number:032x}-{number}-{length}.npz",
        observation=trajectory.image.transpose(0, 3, 1, 2),
        action=scale * np.concatenate([np.zeros((1, width), np.float32), trajectory.action]),
        reward=np.concatenate([[0], trajectory.reward]).astype(np.float32)[:, None],
        discount=np.ones((length + 1, 1), np.float32),
    )


@pytest.fixture
def published(tmp_path):
    """Two episodes of each of two robots, and of two tasks of a third."""
    folder = tmp_path / "ncrl_datasets"
    names = "dmcontrol/acrobot", "dmcontrol/walker", "metaworld/door-open", "metaworld/reach"
    for i, name in enumerate(names):
        for number in range(2):
            save(folder / name, number, chain(20, seed=10 * i + number))
    return folder


def labels(episodes):
    return [(episode.embodiment, episode.task) for episode in episodes]


def test_folders_name_the_robots_of_dmcontrol_and_the_tasks_of_metaworld(published):
    episodes = open_episodes(published / "dmcontrol", image_size=8)
    assert isinstance(episodes, OfficialEpisodes)
    assert labels(episodes) == [("acrobot", None)] * 2 + [("walker", None)] * 2
    episodes = open_episodes(published / "metaworld", image_size=8)
    assert labels(episodes) == [("sawyer", "door-open")] * 2 + [("sawyer", "reach")] * 2


def test_both_suites_and_single_folders_are_recognised_too(published, monkeypatch):
    assert len(open_episodes(published)) == 8
    assert (
        labels(open_episodes(published / "metaworld" / "reach", image_size=8))
        == [("sawyer", "reach")] * 2
    )
    monkeypatch.chdir(published / "dmcontrol")
    assert labels(open_episodes("walker", image_size=8)) == [("walker", None)] * 2


def test_own_episodes_below_a_folder_of_such_a_name_are_not_the_authors(tmp_path):
    for i in range(2):
        save_npz(tmp_path / "metaworld" / "mine" / f"{i}.npz", chain(5, i))
    assert recognise(tmp_path / "metaworld") == "npz"
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for form in ("npz", "official"):  # 0.npz is not an episode of length 0
            assert len(open_episodes(tmp_path / "metaworld", form)) == 2


def test_a_label_that_is_asked_for_comes_before_the_folders(published):
    episodes = open_episodes(published / "dmcontrol" / "walker", embodiment="biped", image_size=8)
    assert labels(episodes) == [("biped", None)] * 2


def test_actions_are_shifted_back_and_clipped(tmp_path):
    old = chain(20)
    save(tmp_path / "dmcontrol" / "walker", 0, old)
    [new] = open_episodes(tmp_path / "dmcontrol", image_size=8, rewards=True)
    state = new.image[:, 0, 0, 0].astype(int)
    assert (follows(state[:-1], new.action[:, 0]) == state[1:]).all()
    np.testing.assert_allclose(new.reward, old.reward)
    assert not new.terminated
    save(tmp_path / "metaworld" / "reach", 0, old, scale=2.0)
    [new] = open_episodes(tmp_path / "metaworld", image_size=8)
    np.testing.assert_allclose(new.action, (2 * old.action).clip(-1, 1))


def test_no_file_is_opened_to_count_the_episodes(published, monkeypatch):
    monkeypatch.setattr(np, "load", lambda *_, **__: pytest.fail("opened"))
    assert len(open_episodes(published)) == 8


def test_other_folders_of_npz_files_are_not_taken_for_the_authors(tmp_path):
    save(tmp_path / "walker", 0, chain(5))
    assert not is_official(tmp_path)
    assert not isinstance(open_episodes(tmp_path), OfficialEpisodes)
    with pytest.raises(ValueError, match=r"neither 'dmcontrol' nor 'metaworld'.* as npz"):
        open_episodes(tmp_path, "official")


@pytest.mark.slow
def test_an_import_that_was_killed_goes_on_where_it_stopped(tmp_path):
    for number in range(60):
        save(tmp_path / "dmcontrol" / "walker", number, chain(20, seed=number, size=64))
    command = [sys.executable, "-m", "wpt_agents.zoo", "import", "official"]
    words = [str(tmp_path / "dmcontrol"), str(tmp_path / "store")]
    running = subprocess.Popen([*command, *words], stdout=subprocess.DEVNULL)
    deadline = time.monotonic() + 60
    while not (stored := sum(f.stat().st_size for f in tmp_path.glob("store/*.bin"))):
        assert running.poll() is None and time.monotonic() < deadline
        time.sleep(0.01)
    running.kill()
    running.wait()
    before = len(TrajectoryDataset.open(tmp_path / "store"))
    assert stored and before < 60  # it was killed on its way
    subprocess.run([*command, *words], check=True, stdout=subprocess.DEVNULL)
    dataset = TrajectoryDataset.open(tmp_path / "store")
    assert len(dataset) == 60 and dataset.validate() == []
    for number in (0, before, 59):
        assert dataset[number].source.endswith(f"-{number}-20.npz")
