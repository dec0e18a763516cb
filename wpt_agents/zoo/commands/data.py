"""The commands that make and show data: collect, import, data ..., retrieve ...

Imports are inside the commands so that `--help` answers at once.
"""

from pathlib import Path
from typing import Annotated

import typer

from wpt_agents.zoo.commands.importing import import_data, print_summary
from wpt_agents.zoo.commands.options import Rendering, Spaced, Suite, Tasks, Workers
from wpt_agents.zoo.commands.retrieval import (
    Picture,
    retrieve,
    share_retrieval,
    show_retrieval,
)

HELP = """\
Show, check and join datasets.

Example: `python -m wpt_agents.zoo data show data/two`
"""
data = typer.Typer(no_args_is_help=True, help=HELP)
Store = Annotated[Path, typer.Argument(help="The folder of a dataset.")]


def register(app: typer.Typer) -> None:
    """Add the commands to the zoo's command line."""
    app.command("collect", cls=Spaced)(collect_data)
    app.command("import")(import_data)
    data.command("show")(show_data)
    data.command("validate")(validate_data)
    data.command("merge")(merge_data)
    app.add_typer(data, name="data")
    retrieve.command("show", cls=Spaced)(show_retrieval)
    retrieve.command("share", cls=Spaced)(share_retrieval)
    app.add_typer(retrieve, name="retrieve")


Out = Annotated[
    Path, typer.Option(help="The folder of the dataset; an unfinished collection is continued.")
]
Episodes = Annotated[
    int | None,
    typer.Option(min=1, help="The number of episodes of each task; by default the paper's number."),
]
Behaviour = Annotated[
    str,
    typer.Option(
        help="The source of the actions: noise, random, scripted (Meta-World), policy (a saved "
        "one), explore-state, icm or plan2explore (curious agents). By default scripted in "
        "metaworld and noise elsewhere."
    ),
]
Sigma = Annotated[
    list[float],
    typer.Option(
        help="Standard deviations of the Gaussian noise on scripted and saved policies; episodes "
        "use them in turn."
    ),
]
Policy = Annotated[
    str | None,
    typer.Option(
        help="The model for `--behaviour policy`: a file of WPT or a baseline, or of SB3 as "
        "`sac:FILE`."
    ),
]
Rewards = Annotated[bool, typer.Option("--rewards", help="Store the rewards, too.")]
Settings = Annotated[
    list[str],
    typer.Option(
        "--set",
        metavar="KEY=VALUE",
        help="Keywords of WPT for icm and plan2explore; steps=N for explore-state.",
    ),
]
RenderingOption = Annotated[
    Rendering,
    typer.Option(
        help="The quality of the images: exact, as the simulator's; near, nearly the same; or "
        "fast, without shadows. Learn the task with the same quality."
    ),
]
Seed = Annotated[int, typer.Option(min=0, help="The seed of the episodes.")]


def collect_data(
    out: Out,
    suite: Suite = "dmc",
    tasks: Tasks = [],  # noqa: B006  # typer wants a list
    episodes: Episodes = None,
    seed: Seed = 0,
    workers: Workers = 2,
    behaviour: Behaviour = "",
    sigma: Sigma = [0.1, 0.3, 0.5, 1.0, 2.0],  # noqa: B006
    policy: Policy = None,
    rewards: Rewards = False,
    settings: Settings = [],  # noqa: B006
    rendering: RenderingOption = Rendering.near,
) -> None:
    """Play tasks and store the episodes, without rewards by default.

    The defaults are the paper's: in metaworld 200 episodes of scripted policies for each of 50
    tasks and 5 strengths of noise, in dmc 2000 episodes of each of 5 robots.

    Example: `python -m wpt_agents.zoo collect --tasks walker-run --episodes 30 --out data/noise`
    """
    from wpt_agents.zoo.collect.behaviours import EXPLORATION_KEYWORDS
    from wpt_agents.zoo.collect.collection import collect
    from wpt_agents.zoo.plan.presets import keywords, load_preset, suite_names
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
    print_summary(dataset)


def show_data(
    folder: Store,
    out: Picture = Path("contact-sheet.png"),
    rows: Annotated[
        int, typer.Option(min=1, help="The number of trajectories in the picture.")
    ] = 12,
) -> None:
    """Print what a dataset contains for each robot, and draw some of its trajectories.

    Example: `python -m wpt_agents.zoo data show data/two --out two.png`
    """
    from wpt_agents.data.dataset import TrajectoryDataset
    from wpt_agents.zoo.pictures.datasets import contact_sheet

    dataset = TrajectoryDataset.open(folder)
    print_summary(dataset)
    if len(dataset):
        contact_sheet(out, dataset, rows)
        typer.echo(f"Contact sheet: {out.resolve()}")


def validate_data(
    folder: Store,
    set_aside: Annotated[
        bool, typer.Option("--set-aside", help="Exclude the damaged trajectories from further use.")
    ] = False,
) -> None:
    """Read every byte of a dataset and name the damaged trajectories.

    The exit code is 1 if there are any and they are not excluded.

    Example: `python -m wpt_agents.zoo data validate data/two`
    """
    from wpt_agents.data.dataset import TrajectoryDataset

    dataset = TrajectoryDataset.open(folder)
    asked = len(dataset)
    damaged = dataset.validate(progress_bar=True, set_aside=set_aside)
    for item in damaged:
        typer.echo(f"trajectory {item.trajectory}: {item.reason}")
    state = "set aside" if set_aside else "damaged"
    typer.echo(f"{asked} trajectories read, {len(damaged)} {state}")
    if damaged and not set_aside:
        raise typer.Exit(1)


def merge_data(
    out: Annotated[Path, typer.Argument(metavar="DST", help="The folder of the new dataset.")],
    folders: Annotated[
        list[Path], typer.Argument(metavar="SRC...", help="The folders of the datasets to join.")
    ],
) -> None:
    """Join datasets: copy all their trajectories, in their order, into a new one.

    Example: `python -m wpt_agents.zoo data merge data/all data/noise data/curious`
    """
    from wpt_agents.data.dataset import TrajectoryDataset

    print_summary(TrajectoryDataset.merge(out, folders))
