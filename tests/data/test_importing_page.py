"""Every command in the table of docs/importing.md, run on a file of that format."""

import re
import shlex
from pathlib import Path

import numpy as np
import pytest
from chain import chain
from stable_baselines3.common.save_util import save_to_pkl
from test_importers import (
    example_class,
    png,
    record_minari,
    save_hdf5,
    save_lerobot,
    save_npz,
    sb3_buffer,
)
from test_tables import (
    last,
    rows,
    save,
    save_dm_env,
    save_ogbench,
    save_robomimic,
    save_tdmpc2,
    save_zarr,
)
from zoo_command import call

from wpt_agents.data.dataset import TrajectoryDataset

PAGE = Path(__file__).parents[2] / "docs" / "importing.md"
COMMANDS = re.findall(r"\| `(import .*?)` \|", PAGE.read_text(encoding="utf-8"))
OLD = [chain(30, 0), chain(25, 1)]


def save_aloha(folder):
    folder.mkdir()
    for i, t in enumerate(OLD):
        arrays = {"action": t.action, "observations/images/top": t.image[:-1]}
        save(folder / f"episode_{i}.hdf5", arrays)


def save_oxe(path):
    """A step's action is a dictionary, its instruction is in words."""
    from tensorboard.summary.writer.record_writer import RecordWriter

    path.parent.mkdir(parents=True)
    with open(path, "wb") as file:
        writer = RecordWriter(file)
        for t in OLD:
            example = example_class()()
            feature = example.features.feature
            steps = len(t) + 1
            action = np.concatenate([t.action, np.zeros((1, 2))])
            states = t.image[:, 0, 0, 0]
            pictures = [png(int(state) % 12) for state in states]
            feature["steps/observation/image"].bytes_list.value.extend(pictures)
            feature["steps/action/world_vector"].float_list.value.extend(action[:, 0])
            feature["steps/action/gripper"].float_list.value.extend(action[:, 1])
            feature["steps/language_instruction"].bytes_list.value.extend([b"lift it"] * steps)
            feature["steps/is_first"].int64_list.value.extend([1] + [0] * (steps - 1))
            writer.write(example.SerializeToString())
        writer.flush()


def write_all(folder, monkeypatch):
    """A file for each command of the page, in the current folder."""
    save_robomimic(folder / "robomimic.hdf5", OLD)
    save_aloha(folder / "aloha")
    save_hdf5(folder / "d4rl.hdf5", OLD, scale=2)
    save(folder / "flags.hdf5", rows(OLD) | {"episode_over": last(OLD)})
    save_dm_env(folder / "vd4rl.hdf5", OLD)
    save_ogbench(folder / "ogbench.npz", OLD)
    for i, t in enumerate(OLD):
        save_npz(folder / "exorl" / f"{i}.npz", t)
    record_minari(folder, monkeypatch, OLD, nested=True, jpeg_encoding=False)
    save_lerobot(folder / "pusht", [30, 25], video=False)
    save_oxe(folder / "oxe/1.0.0/toy-train.tfrecord-00000-of-00001")
    save_zarr(folder / "pusht.zarr", OLD, np.float32)
    save_tdmpc2(folder / "chunk.pt", [OLD[0], OLD[0]], pickled=True)
    save_to_pkl(folder / "replay.pkl", sb3_buffer(OLD, 60))


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_the_commands_of_the_page_convert_files_of_their_formats(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    write_all(tmp_path, monkeypatch)
    assert len(COMMANDS) == 14
    for command in COMMANDS:
        words = shlex.split(command)
        assert call(monkeypatch, *words) == 0, (command, capsys.readouterr().err)
        dataset = TrajectoryDataset.open(words[3])
        lengths = [30, 30] if "tdmpc2" in words else [30, 25]
        short = np.array(lengths) - dataset.lengths
        assert len(dataset) == 2 and set(short) <= {0, 1}, (command, dataset.lengths)
        assert np.abs(dataset[0].action).max() <= 1
    labels = TrajectoryDataset.open("data/bridge")
    assert labels.tasks == ["lift it", "lift it"]
    np.testing.assert_allclose(labels[0].action, OLD[0].action, atol=1e-6)
