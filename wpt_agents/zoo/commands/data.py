"""The commands that make data and look at them: collect, import, data ..., retrieve show.

Imports stand inside the commands so that `--help` answers at once.
"""

import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from wpt_agents.zoo.commands.options import Rendering, Spaced, Suite, Tasks, Workers

if TYPE_CHECKING:
    from wpt_agents.data.dataset import TrajectoryDataset

data = typer.Typer(no_args_is_help=True, help="Looks at datasets, checks and joins them.")
retrieve = typer.Typer(no_args_is_help=True, help="Looks at what retrieval finds.")
Store = Annotated[Path, typer.Argument(help="A dataset's folder.")]
Picture = Annotated[Path, typer.Option(help="Where the picture goes.")]


def register(app: typer.Typer) -> None:
    """Adds the commands to the zoo's."""
    app.command("collect", cls=Spaced)(collect_data)
    app.command("import")(import_data)
    data.command("show")(show_data)
    data.command("validate")(validate_data)
    data.command("merge")(merge_data)
    app.add_typer(data, name="data")
    retrieve.command("show", cls=Spaced)(show_retrieval)
    app.add_typer(retrieve, name="retrieve")


def collect_data(
    out: Annotated[Path, typer.Option(help="The dataset's folder; half of one is continued.")],
    suite: Suite = "dmc",
    tasks: Tasks = [],  # noqa: B006  # typer wants a list
    episodes: Annotated[
        int | None, typer.Option(min=1, help="Of each task. None: as many as the paper's.")
    ] = None,
    seed: int = 0,
    workers: Workers = 2,
    behaviour: Annotated[
        str,
        typer.Option(
            help="What plays: noise, random, scripted (Meta-World), policy, explore-state, icm or "
            "plan2explore. By default scripted in metaworld and noise elsewhere."
        ),
    ] = "",
    sigma: Annotated[
        list[float], typer.Option(help="Noise on scripted and saved policies, in turn by episode.")
    ] = [0.1, 0.3, 0.5, 1.0, 2.0],  # noqa: B006
    policy: Annotated[
        str | None, typer.Option(help="For policy: a WPT model file, or SB3's as `sac:FILE`.")
    ] = None,
    rewards: Annotated[bool, typer.Option("--rewards", help="Store the rewards, too.")] = False,
    settings: Annotated[
        list[str],
        typer.Option(
            "--set",
            metavar="KEY=VALUE",
            help="Keywords of WPT for icm and plan2explore; steps=N for explore-state.",
        ),
    ] = [],  # noqa: B006
    rendering: Annotated[Rendering, typer.Option(help="Of the pictures.")] = Rendering.near,
) -> None:
    """Plays tasks and stores the episodes, without rewards unless asked for.

    By default as the paper: in metaworld 50 tasks x 5 strengths of noise x 200 episodes of scripted
    policies, in dmc 2000 episodes of each of 5 robots.

    Example: `python -m wpt_agents.zoo collect --tasks walker-run --behaviour icm --out data`
    """
    from wpt_agents.zoo.collect.collection import collect
    from wpt_agents.zoo.plan.presets import (
        EXPLORATION_KEYWORDS,
        keywords,
        load_preset,
        suite_names,
    )
    from wpt_agents.zoo.tasks import find_tasks

    paper = load_preset(suite, "paper").collect if suite in suite_names() else None
    names = tasks or (paper.tasks if paper else ())
    ids = [row.id for row in find_tasks(suite, names)]
    episodes = episodes or (paper.episodes if paper else 30)
    behaviour = behaviour or (paper.behaviour if paper else "noise")
    valid = EXPLORATION_KEYWORDS if behaviour == "explore-state" else None
    dataset = collect(
        out, ids, episodes, seed, workers, behaviour, {"rendering": str(rendering)},
        rewards=rewards, sigmas=sigma, policy=policy, settings=keywords(settings, valid),
    )  # fmt: skip
    _print_summary(dataset)


def import_data(
    form: Annotated[
        str,
        typer.Argument(
            metavar="FORMAT", help="hdf5, lerobot, minari, npz, official, rlds, sb3 or auto."
        ),
    ],
    source: Annotated[
        str, typer.Argument(metavar="SRC", help="A folder, a file, or a Minari dataset's name.")
    ],
    out: Annotated[
        Path, typer.Argument(metavar="DST", help="The dataset's folder; half of one is continued.")
    ],
    embodiment: Annotated[str | None, typer.Option(help="The robot's name, for all.")] = None,
    task: Annotated[str | None, typer.Option(help="What the behaviour was after, for all.")] = None,
    rewards: Annotated[bool, typer.Option("--rewards", help="Keep the rewards.")] = False,
    image_size: Annotated[int, typer.Option(min=1, help="Resize to this; WPT takes 64.")] = 64,
    image_key: Annotated[str | None, typer.Option(help="Where the images are.")] = None,
    action_key: Annotated[str | None, typer.Option(help="rlds: where the actions are.")] = None,
    camera: Annotated[str | None, typer.Option(help="lerobot: which, if several.")] = None,
    split: Annotated[str | None, typer.Option(help="rlds: only this one, e.g. train.")] = None,
    low: Annotated[
        str | None, typer.Option(help="All but sb3: the actions' limits, `--low=-2,-2`.")
    ] = None,
    high: Annotated[str | None, typer.Option(help="`--high=2,2`.")] = None,
    trust: Annotated[
        bool, typer.Option("--trust", help="sb3: load a pickle, which may run any code.")
    ] = False,
) -> None:
    """Converts other people's data into a dataset, episode by episode; repeat it to go on.

    Example: `python -m wpt_agents.zoo import npz exorl/walker data/walker --embodiment walker`
    """
    from wpt_agents.data.dataset import TrajectoryDataset
    from wpt_agents.data.importers.formats import open_episodes

    given: dict[str, Any] = {
        "image_key": image_key,
        "action_key": action_key,
        "camera": camera,
        "split": split,
        "low": _numbers("--low", low),
        "high": _numbers("--high", high),
        "trust": trust or None,
    }
    options = {name: value for name, value in given.items() if value is not None}
    shared = {"embodiment": embodiment, "task": task, "rewards": rewards, "image_size": image_size}
    with warnings.catch_warnings():
        warnings.simplefilter("default", UserWarning)
        warnings.showwarning = _show_warning
        episodes = open_episodes(source, None if form == "auto" else form, **shared, **options)
        dataset = TrajectoryDataset.from_episodes(episodes, out, progress_bar=True)
    _print_summary(dataset)


def _numbers(option: str, text: str | None) -> list[float] | None:
    if text is None:
        return None
    try:
        return [float(part) for part in text.split(",")]
    except ValueError:
        raise ValueError(f"{option} wants numbers with commas between, got {text!r}") from None


def _show_warning(message: Warning | str, *_: object, **__: object) -> None:
    typer.secho(f"Warning: {message}", fg="yellow", err=True)


def _print_summary(dataset: "TrajectoryDataset") -> None:
    """What the dataset holds, robot by robot, and where it is."""
    from wpt_agents.zoo.pictures.datasets import data_table
    from wpt_agents.zoo.terminal import console

    console.print(data_table(dataset))
    typer.echo(f"Dataset: {dataset.path.resolve()}")


def show_data(
    folder: Store,
    out: Picture = Path("contact-sheet.png"),
    rows: Annotated[int, typer.Option(min=1, help="Trajectories on the picture.")] = 12,
) -> None:
    """Prints what a dataset holds, robot by robot, and draws some of its trajectories.

    Example: `python -m wpt_agents.zoo data show data/two --out two.png`
    """
    from wpt_agents.data.dataset import TrajectoryDataset
    from wpt_agents.zoo.pictures.datasets import contact_sheet

    dataset = TrajectoryDataset.open(folder)
    _print_summary(dataset)
    if len(dataset):
        contact_sheet(out, dataset, rows)
        typer.echo(f"Contact sheet: {out.resolve()}")


def validate_data(
    folder: Store,
    set_aside: Annotated[
        bool, typer.Option("--set-aside", help="Leave the damaged ones out from now on.")
    ] = False,
) -> None:
    """Reads every byte of a dataset and names the trajectories that are damaged.

    Exits with 1 if there are any, unless they are set aside.

    Example: `python -m wpt_agents.zoo data validate data/two`
    """
    from wpt_agents.data.dataset import TrajectoryDataset

    dataset = TrajectoryDataset.open(folder)
    asked = len(dataset)
    damaged = dataset.validate(progress_bar=True, set_aside=set_aside)
    for each in damaged:
        typer.echo(f"trajectory {each.trajectory}: {each.reason}")
    state = "set aside" if set_aside else "damaged"
    typer.echo(f"{asked} trajectories read, {len(damaged)} {state}")
    if damaged and not set_aside:
        raise typer.Exit(1)


def merge_data(
    out: Annotated[Path, typer.Argument(metavar="DST", help="The new dataset's folder.")],
    folders: Annotated[list[Path], typer.Argument(metavar="SRC...", help="Datasets to join.")],
) -> None:
    """Makes a new dataset of all trajectories of others, in their order.

    Example: `python -m wpt_agents.zoo data merge data/all data/noise data/curious`
    """
    from wpt_agents.data.dataset import TrajectoryDataset

    _print_summary(TrajectoryDataset.merge(out, folders))


def show_retrieval(
    folder: Store,
    model: Annotated[Path, typer.Option(help="The model file whose encoder compares.")],
    query: Annotated[
        list[int], typer.Option(help="Trajectories of the dataset to search for, by number.")
    ] = [],  # noqa: B006
    task: Annotated[
        list[str],
        typer.Option(help="Tasks whose first image to search for."),
    ] = [],  # noqa: B006
    suite: Suite = "dmc",
    rendering: Annotated[Rendering, typer.Option(help="Of --task.")] = Rendering.near,
    number: Annotated[int, typer.Option(min=1, help="How many of the nearest.")] = 8,
    own_robot: Annotated[
        bool, typer.Option("--own-robot", help="Only its robot and action width, as WPT does.")
    ] = False,
    out: Picture = Path("retrieval.png"),
) -> None:
    """Draws first images beside the trajectories that begin most like them, with distances.

    Without --query and --task, some trajectories of the dataset are searched for.

    Example: `python -m wpt_agents.zoo retrieve show data/two --model m.zip --task walker-run`
    """
    from wpt_agents.agents.wpt import WPT
    from wpt_agents.zoo.pictures import datasets, retrieval
    from wpt_agents.zoo.tasks import find_tasks

    agent = WPT.load(model, dataset=folder)
    assert agent.dataset is not None
    queries = [retrieval.query_of(agent.dataset, i) for i in query]
    rows = find_tasks(suite, task) if task else []
    queries += [retrieval.query_at(row, {"rendering": str(rendering)}) for row in rows]
    if not queries:
        chosen = datasets.spread(agent.dataset, 6)
        queries = [retrieval.query_of(agent.dataset, i) for i in chosen]
    found = [retrieval.search(agent, each, number, own_robot) for each in queries]
    retrieval.retrieval_sheet(out, agent.dataset, found)
    typer.echo(f"Retrieval sheet: {out.resolve()}")
