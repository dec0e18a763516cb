"""The command that converts data in other formats: import."""

import sys
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from wpt_agents.data.dataset import TrajectoryDataset

Form = Annotated[
    str,
    typer.Argument(
        metavar="FORMAT",
        help="hdf5, lerobot, minari, npz, official, rlds, sb3, tdmpc2, zarr, or auto to "
        "recognise it.",
    ),
]
Source = Annotated[
    str,
    typer.Argument(metavar="SRC", help="A folder, a file, or the name of a Minari dataset."),
]
Out = Annotated[
    Path,
    typer.Argument(
        metavar="DST", help="The folder of the dataset; an interrupted conversion is continued."
    ),
]
Embodiment = Annotated[str | None, typer.Option(help="The name of the robot, for all episodes.")]
Task = Annotated[str | None, typer.Option(help="The name of the task, for all episodes.")]
Rewards = Annotated[bool, typer.Option("--rewards", help="Keep the rewards.")]
ImageSize = Annotated[
    int, typer.Option(min=1, help="Resize images to this height and width; WPT needs 64.")
]
Crop = Annotated[
    bool, typer.Option("--crop", help="Cut out the middle square instead of squeezing images.")
]
ImageKey = Annotated[
    str | None, typer.Option(help="The name of the array of images, or of the camera.")
]
ActionKey = Annotated[
    str | None,
    typer.Option(help="The name of the array of actions, or several names separated by commas."),
]
DoneKey = Annotated[str | None, typer.Option(help="The name of the flags at which episodes end.")]
Shifted = Annotated[
    bool | None,
    typer.Option(
        "--shifted/--no-shifted",
        help="For hdf5, npz, tdmpc2 and zarr: the action of a row led to its observation "
        "(--shifted, as in dm_env), or was taken at it (--no-shifted). By default the format "
        "decides.",
    ),
]
Camera = Annotated[
    str | None, typer.Option(help="For lerobot: the name of the camera, the same as --image-key.")
]
Split = Annotated[
    str | None, typer.Option(help="For rlds: read only this split, for example train.")
]
Skip = Annotated[
    str | None,
    typer.Option(help="The numbers of episodes to leave out, counted from 0: `--skip=3,17`."),
]
Low = Annotated[
    str | None,
    typer.Option(
        help="The lowest value of each action dimension, if not -1, or one value for all: "
        "`--low=-2,-2`."
    ),
]
High = Annotated[
    str | None,
    typer.Option(
        help="The highest value of each action dimension, if not 1, or one for all: `--high=2,2`."
    ),
]
Trust = Annotated[
    bool,
    typer.Option("--trust", help="For sb3 and tdmpc2: load a pickle, which may run any code."),
]


def import_data(
    form: Form,
    source: Source,
    out: Out,
    embodiment: Embodiment = None,
    task: Task = None,
    rewards: Rewards = False,
    image_size: ImageSize = 64,
    crop: Crop = False,
    image_key: ImageKey = None,
    action_key: ActionKey = None,
    done_key: DoneKey = None,
    shifted: Shifted = None,
    camera: Camera = None,
    split: Split = None,
    skip: Skip = None,
    low: Low = None,
    high: High = None,
    trust: Trust = False,
) -> None:
    """Convert data in another format into a dataset; the same command continues a conversion.

    Example: `python -m wpt_agents.zoo import npz exorl/walker data/walker --embodiment walker`
    """
    from wpt_agents.data.dataset import TrajectoryDataset
    from wpt_agents.data.importers.formats import open_episodes

    choices: dict[str, Any] = {
        "embodiment": embodiment,
        "task": task,
        "rewards": rewards,
        "image_size": image_size,
        "image_key": image_key,
        "action_key": action_key,
        "done_key": done_key,
        "crop": crop or None,
        "shifted": shifted,
        "camera": camera,
        "split": split,
        "skip": _integers("--skip", skip),
        "low": _numbers("--low", low),
        "high": _numbers("--high", high),
        "trust": trust or None,
    }
    options = {name: value for name, value in choices.items() if value is not None}
    with warnings.catch_warnings():
        warnings.simplefilter("default", UserWarning)
        warnings.showwarning = _show_warning
        episodes = open_episodes(source, None if form == "auto" else form, **options)
        dataset = TrajectoryDataset.from_episodes(episodes, out, progress_bar=True)
    print_summary(dataset)


def _numbers(option: str, text: str | None) -> list[float] | None:
    if text is None:
        return None
    try:
        return [float(part) for part in text.split(",")]
    except ValueError:
        raise ValueError(f"{option} takes numbers separated by commas, got {text!r}") from None


def _integers(option: str, text: str | None) -> list[int] | None:
    numbers = _numbers(option, text)
    if numbers is not None and any(number != int(number) for number in numbers):
        raise ValueError(f"{option} takes whole numbers separated by commas, got {text!r}")
    return None if numbers is None else [int(number) for number in numbers]


def _show_warning(message: Warning | str, *_: object, **__: object) -> None:
    from tqdm.auto import tqdm

    with tqdm.external_write_mode(sys.stderr):  # on a line of its own, above the progress bar
        typer.secho(f"Warning: {message}", fg="yellow", err=True)


def print_summary(dataset: "TrajectoryDataset") -> None:
    """Print the dataset's content for each robot, and its path."""
    from wpt_agents.zoo.pictures.datasets import data_table
    from wpt_agents.zoo.terminal import console

    console.print(data_table(dataset))
    typer.echo(f"Dataset: {dataset.path.resolve()}")
