"""Paths that hold no dataset are refused: the error names what is there, and a remedy."""

import pickle
import zipfile

import gymnasium as gym
import numpy as np
import pytest
import torch
from chain import chain

from wpt_agents.data.convert import open_dataset
from wpt_agents.data.images import Resizer
from wpt_agents.data.importers.episodes import as_actions, as_images
from wpt_agents.data.importers.formats import open_episodes


def write(path, content=b"\0" * 64):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content)
    return path


def model(path, member):
    path.parent.mkdir(parents=True, exist_ok=True)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(member, "{}")


FILES = {  # what the folder holds, which path is opened, what the message says
    "mt30/chunk_0.pt": [
        ("mt30/chunk_0.pt", r"\.pt file of torch.* import tdmpc2 .*chunk_0\.pt DST`, with --trust"),
        ("mt30", r"holds \.pt files of torch.* import tdmpc2"),
    ],
    "replay.pkl": [("replay.pkl", r"is a pickle \(\.pkl\).* import sb3 .* --trust`; otherwise")],
    "film.mp4": [("film.mp4", r"is a video \(\.mp4\) without actions; make a Trajectory")],
    "pictures/0.png": [("pictures", "pictures without actions, no format that can be imported")],
    "x.bag": [("x.bag", r"no format that can be imported \(hdf5, lerobot, .*zarr\); make a Traj")],
    "s.hdf": [("s.hdf", r"may be an HDF5 file, .*name the format: `.* import hdf5 .*s\.hdf DST`")],
    "a/b-train.array_record-00000-of-00001": [("a", "array_record files.*file_format=tfrecord")],
    "data/arm/meta.json": [("data", r"folder of datasets, .* their list: \['.*data/arm'\]")],
    "notes/readme.txt": [("notes", r"meta\.json is missing, .* there are: readme\.txt\. You can")],
}


@pytest.mark.parametrize(
    ("file", "path", "words"), [(f, *case) for f, cases in FILES.items() for case in cases]
)
def test_files_of_other_kinds_are_called_by_name(tmp_path, file, path, words):
    write(tmp_path / file)
    with pytest.raises(ValueError, match=words):
        open_dataset(tmp_path / path)


@pytest.mark.parametrize(
    ("member", "words"),
    [("about.json", "model file of wpt_agents"), ("policy.pth", "model file of Stable-Baselines3")],
)
def test_a_model_and_the_folder_of_a_run_are_no_data(tmp_path, member, words):
    model(tmp_path / "run" / "model.zip", member)
    np.savez(tmp_path / "run" / "evaluations.npz", results=np.zeros(3))
    with pytest.raises(ValueError, match=f"model.zip is a {words}, not data"):
        open_dataset(tmp_path / "run" / "model.zip")
    with pytest.raises(ValueError, match=rf"run's folder with a {words} \(model\.zip\)"):
        open_dataset(tmp_path / "run")


def test_an_empty_folder_and_a_typing_error_are_told_apart(tmp_path):
    (tmp_path / "mt30").mkdir()
    with pytest.raises(ValueError, match="mt30 is empty; pass a folder with data"):
        open_dataset(tmp_path / "mt30")
    with pytest.raises(ValueError, match=r"mt3O does not exist\. Did you mean .*mt30\?"):
        open_dataset(tmp_path / "mt3O")


@pytest.mark.parametrize("name", ["lerobot/pusht_image", "hf://datasets/lerobot/pusht_image"])
def test_a_dataset_on_the_hub_is_to_be_downloaded_first(name):
    words = "hf download --repo-type dataset lerobot/pusht_image --local-dir pusht_image"
    with pytest.raises(ValueError, match=words):
        open_dataset(name)


def test_one_episode_in_npz_names_its_folder(tmp_path):
    np.savez(tmp_path / "e.npz", image=np.zeros((3, 8, 8, 3), np.uint8), action=np.zeros((3, 2)))
    with pytest.raises(ValueError, match=f"one .npz file.* folder of all episodes, {tmp_path}"):
        open_dataset(tmp_path / "e.npz")
    assert len(open_episodes(tmp_path / "e.npz", "npz", image_size=8)) == 1


@pytest.mark.parametrize(
    ("data", "words"),
    [
        ([], "empty list"),
        ({"image": 1, "action": 2}, r"A dictionary \(image, action\) is not a dataset; make Traj"),
        (np.zeros((3, 4)), r"array of \(3, 4\) is not a dataset"),
        (torch.zeros(3, 4), r"array of \(3, 4\) is not a dataset"),
        ((np.zeros(3), np.zeros(2)), "A tuple of arrays is not a dataset"),
        ([np.zeros(3), np.zeros(2)], "A list of arrays is not a dataset"),
        (b"path", "type bytes is not a dataset"),
        (3, "type int is not a dataset; pass a TrajectoryDataset, a path"),
        (iter([chain(3, size=64), 5]), "Item 1 of the list_iterator is a int"),
        (gym.Env(), r"An environment \(Env\) is not a dataset: pass it as env="),
    ],
)
def test_objects_of_other_kinds_are_called_by_name(data, words):
    with pytest.raises(ValueError, match=words):
        open_dataset(data)


IMAGES = {
    "float": (
        np.full((2, 8, 8, 3), 0.5, np.float32),
        r"float32 from 0\.5 to 0\.5.*rint\(255 ",
    ),
    "nan": (np.full((2, 8, 8, 3), np.nan), "hold NaN or infinity; leave that episode out"),
    "signed": (np.full((2, 8, 8, 3), -1.0), r"from -1 to -1, not uint8 .*\(image - low\)"),
    "rgba": (np.zeros((2, 8, 8, 4), np.uint8), r"4 channels .*RGBA\? .*image\[\.\.\., :3\]"),
    "gray": (np.zeros((2, 8, 8, 1), np.uint8), r"1 channels .*np\.repeat\(image, 3, axis=-1\)"),
    "rgba first": (np.zeros((2, 4, 8, 8), np.uint8), r"RGBA\? Drop .*image\[:, :3\]"),
    "gray first": (np.zeros((2, 1, 8, 8), np.uint8), r"np\.repeat\(image, 3, axis=1\)"),
    "gray and alpha first": (np.zeros((2, 2, 8, 8), np.uint8), r"image\[:, :1\], 3, axis=1\)"),
    "flat": (
        np.zeros((2, 8, 8), np.uint8),
        r"without a channel axis.*image\[\.\.\., None\]",
    ),
    "order": (np.zeros((2, 16, 3, 16), np.uint8), r"axes must be \(N, H, W, 3\) or \(N, 3, H, W\)"),
}
REMEDIES = {  # what the messages say, followed to the letter
    "float": lambda image: np.rint(255 * image).astype(np.uint8),
    "rgba": lambda image: image[..., :3],
    "gray": lambda image: np.repeat(image, 3, axis=-1),
    "rgba first": lambda image: image[:, :3],
    "gray first": lambda image: np.repeat(image, 3, axis=1),
    "gray and alpha first": lambda image: np.repeat(image[:, :1], 3, axis=1),
    "flat": lambda image: np.repeat(image[..., None], 3, axis=-1),
}


@pytest.mark.parametrize("kind", IMAGES)
def test_images_of_another_shape_or_range_are_refused_with_a_remedy_that_works(kind, recwarn):
    image, words = IMAGES[kind]
    with pytest.raises(ValueError, match=words):
        as_images(image, Resizer(8))
    if kind in REMEDIES:
        assert as_images(REMEDIES[kind](image), Resizer(8)).shape == (2, 8, 8, 3)
        assert not recwarn  # none of resizing: the images are as large as before


def test_floats_that_are_bytes_in_fact_are_taken():
    image = np.random.default_rng(0).integers(0, 256, (2, 8, 8, 3))
    new = as_images(image.astype(np.float32), Resizer(8))
    np.testing.assert_array_equal(new, image)


def test_discrete_actions_are_called_so_and_one_actuator_is_taken():
    with pytest.raises(ValueError, match=r"one whole number .*discrete actions"):
        as_actions(np.arange(5))
    assert as_actions(np.linspace(0, 1, 5)).shape == (5, 1)
    with pytest.raises(ValueError, match=r"must be numbers \(T, A\), got \(5, 1\) <U1"):
        as_actions(np.array(list("abcde")))


def test_a_pickle_is_never_loaded_unasked(tmp_path):
    class Bomb:
        def __reduce__(self):
            return (write, (tmp_path / "canary",))

    (tmp_path / "a.pt").write_bytes(pickle.dumps(Bomb()))
    (tmp_path / "a.pkl").write_bytes(pickle.dumps(Bomb()))
    for name, form in (("a.pt", "tdmpc2"), ("a.pkl", "sb3"), ("a.pt", None), ("a.pkl", None)):
        with pytest.raises(ValueError):
            open_episodes(tmp_path / name, form)
    assert not (tmp_path / "canary").exists()
