"""Recognise the format of a path, or describe what else it contains."""

import difflib
import os
import re
import warnings
import zipfile
from pathlib import Path

from wpt_agents.data.importers.keys import natural
from wpt_agents.data.importers.minari import local_minari
from wpt_agents.data.importers.npz import is_flat
from wpt_agents.data.importers.official import holds_official
from wpt_agents.files.folders import files_below

IN_FOLDERS = (("*.tfrecord*", "rlds"), ("*.hdf5", "hdf5"), ("*.h5", "hdf5"), ("*.npz", "npz"))
VIDEOS = (".mp4", ".avi", ".mov", ".mkv", ".webm", ".gif")
PICTURES = (".png", ".jpg", ".jpeg", ".bmp")
MAKE = "make a Trajectory(image, action) of each episode, and pass them as a list"
IMPORT = "python -m wpt_agents.zoo import"


def recognise_path(source: str | os.PathLike[str]) -> str | None:
    """Return the recognised format, None if there is none or for our own datasets."""
    path = Path(source)
    if (path / "meta.json").exists():
        return None
    if not path.exists():
        return "minari" if local_minari(os.fspath(source)).exists() else None
    return _folder_format(path) if path.is_dir() else _file_format(path)


def _file_format(path: Path) -> str | None:
    if path.suffix in (".hdf5", ".h5"):
        return "hdf5"
    if ".tfrecord" in path.name:
        return "rlds"
    if path.name.endswith(".zarr.zip"):
        return "zarr"
    return "npz" if path.suffix == ".npz" and is_flat(path) else None


def _folder_format(path: Path) -> str | None:
    if (path / "meta" / "info.json").exists():
        return "lerobot"
    if any(_is_minari(path / part) for part in ("data", ".")):
        return "minari"
    if path.suffix == ".zarr" or any((path / n).exists() for n in (".zgroup", "zarr.json")):
        return "zarr"
    if _model_in(path):
        return None
    if holds_official(path):
        return "official"
    counts: dict[str, int] = {}
    for pattern, form in IN_FOLDERS:
        counts[form] = counts.get(form, 0) + len(list(files_below(path, pattern)))
    there = [form for form, count in counts.items() if count]
    if not there:
        return None
    used, *others = there
    if others:
        left = " and ".join(f"{counts[form]} of format {form}" for form in others)
        warnings.warn(
            f"{path} has files of several formats: those of format {used} are read, and {left} are "
            "left out. Put each format in a folder of its own, and pass a list of the folders",
            stacklevel=4,
        )
    return used


def _is_minari(folder: Path) -> bool:
    """Return whether a folder has the metadata of Minari, and not those of another program."""
    try:
        return '"data_format"' in (folder / "metadata.json").read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError):
        return False


def _model_in(folder: Path) -> Path | None:
    """Return a model file directly in the folder, as in the folder of a run."""
    return next((file for file in sorted(folder.glob("*.zip")) if model_kind(file)), None)


def model_kind(file: Path) -> str | None:
    """Return the library that wrote a model file, None for other files."""
    try:
        with zipfile.ZipFile(file) as archive:
            names = archive.namelist()
    except (OSError, zipfile.BadZipFile):
        return None
    if "about.json" in names:
        return "a model file of wpt_agents"
    return "a model file of Stable-Baselines3" if "policy.pth" in names else None


def refusal(source: str | os.PathLike[str], formats: str) -> ValueError:
    """Return the error for a path that is no dataset and has no known format.

    :param formats: the names of the formats that can be imported
    """
    path = Path(source)
    if "://" in os.fspath(source) or os.fspath(source).startswith("hf:"):
        return ValueError(f"{source} is an address, not a folder; {_download(os.fspath(source))}")
    if not path.exists():
        return ValueError(_missing(path))
    return ValueError(f"{path} {_folder(path, formats) if path.is_dir() else _file(path, formats)}")


def _download(name: str) -> str:
    name = re.sub(r"^hf:/*(datasets/)?", "", name)
    if not re.fullmatch(r"[\w.-]+/[\w.-]+", name):
        return "download it first and pass the folder"
    folder = name.split("/")[1]
    return (
        "if it is a dataset on the Hugging Face Hub, download it first and pass the folder: "
        f"hf download --repo-type dataset {name} --local-dir {folder}"
    )


def _missing(path: Path) -> str:
    text = f"{path} does not exist"
    there = path.parent
    names = [file.name for file in there.iterdir()] if there.is_dir() else []
    near = difflib.get_close_matches(path.name, names, n=1)
    if near:
        return f"{text}. Did you mean {there / near[0]}?"
    if re.fullmatch(r"[\w.-]+/[\w.-]+", os.fspath(path)):
        return f"{text}; {_download(os.fspath(path))}"
    return (
        f"{text}. A dataset is a folder made by TrajectoryDataset.create, or by "
        "`python -m wpt_agents.zoo collect` or `import`, or data in one of the formats that can be "
        "imported"
    )


def _file(path: Path, formats: str) -> str:
    suffix = path.suffix.lower()
    model = model_kind(path) if suffix == ".zip" else None
    if model:
        return f"is {model}, not data; use WPT.load for models, and dataset= for data"
    if suffix == ".npz":
        return (
            "is one .npz file, so at most one episode; pass the folder of all episodes, "
            f"{path.parent}"
        )
    if suffix in (".pt", ".pth"):
        return (
            "is a .pt file of torch: if it holds TD-MPC2's data with images, convert it by "
            f"`{IMPORT} tdmpc2 {path} DST`, with --trust if you trust it, since it may be a pickle"
        )
    if suffix in (".pkl", ".pickle"):
        return (
            f"is a pickle ({suffix}), and loading it can run any code: if it is a replay buffer "
            f"of SB3 that you trust, convert it by `{IMPORT} sb3 {path} DST --trust`; otherwise "
            "make a Trajectory of each episode"
        )
    if ".array_record" in path.name:
        return _array_record()
    if suffix in VIDEOS:
        return f"is a video ({suffix}) without actions; {MAKE}"
    if suffix in (".hdf", ".he5"):
        return (
            "may be an HDF5 file, but is not recognised by its suffix; if it holds episodes, name "
            f"the format: `{IMPORT} hdf5 {path} DST`"
        )
    return f"is in no format that can be imported ({formats}); {MAKE}"


def _folder(path: Path, formats: str) -> str:
    names = sorted((f.name for f in path.iterdir() if not f.name.startswith(".")), key=natural)
    model = _model_in(path)
    if model is not None:
        return (
            f"is not a dataset: it is a run's folder with {model_kind(model)} ({model.name}); "
            "use dataset= for data, and WPT.load for the model file"
        )
    if not names:
        return f"is empty; pass a folder with data ({formats})"
    datasets = [name for name in names if (path / name / "meta.json").exists()]
    if datasets:
        listed = ", ".join(repr(str(path / name)) for name in datasets)
        return (
            f"is a folder of datasets, not one itself; pass one of them, or their list: [{listed}]"
        )
    if next(files_below(path, "*.pt"), None):
        return (
            "is not a dataset: it holds .pt files of torch; if they are TD-MPC2's data with "
            f"images, convert them by `{IMPORT} tdmpc2 {path} DST`, with --trust if you trust them"
        )
    if next(files_below(path, "*.array_record*"), None):
        return _array_record()
    there = ", ".join(names[:4]) + (", ..." if len(names) > 4 else "")
    what = "pictures without actions, " if Path(names[0]).suffix.lower() in PICTURES else ""
    return (
        f"is not a dataset: meta.json is missing, and it holds {what}no format that can be "
        f"imported ({formats}); there are: {there}. You can {MAKE}"
    )


def _array_record() -> str:
    return (
        "holds array_record files, TFDS's newer default, which is not supported; write TFRecord "
        "files instead: tfds build --file_format=tfrecord"
    )
