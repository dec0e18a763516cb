"""The commands that show the results of retrieval: retrieve show, share."""

from pathlib import Path
from typing import Annotated

import typer

from wpt_agents.zoo.commands.options import Rendering, Suite, model_file

HELP = """\
Show or measure what retrieval finds.

Example: `python -m wpt_agents.zoo retrieve show data/two --model model.zip`
"""
retrieve = typer.Typer(no_args_is_help=True, help=HELP)


Picture = Annotated[Path, typer.Option(help="The file of the picture.")]
Encoder = Annotated[
    str,
    typer.Option(
        help="The model whose encoder compares the images: a file, the folder of a run or of a "
        "pre-training, or the name of a shipped model."
    ),
]
TaskRendering = Annotated[
    Rendering | None,
    typer.Option(
        help="The quality of the images of --task; by default that with which `collect` or `run` "
        "made the data, or near for other data.",
        show_default=False,
    ),
]


def show_retrieval(
    folder: Annotated[Path, typer.Argument(help="The folder of a dataset.")],
    model: Encoder,
    query: Annotated[
        list[int],
        typer.Option(help="Numbers of trajectories whose first images are the queries."),
    ] = [],  # noqa: B006
    task: Annotated[
        list[str],
        typer.Option(help="Tasks whose first images are the queries."),
    ] = [],  # noqa: B006
    suite: Suite = "dmc",
    rendering: TaskRendering = None,
    number: Annotated[
        int, typer.Option(min=1, help="The number of nearest trajectories to show.")
    ] = 8,
    own_robot: Annotated[
        bool,
        typer.Option(
            "--own-robot",
            help="Search only trajectories of the query's robot and action width, as WPT does.",
        ),
    ] = False,
    out: Picture = Path("retrieval.png"),
) -> None:
    """Draw first images beside the trajectories that start most like them, with distances.

    Without --query and --task, the first images of some trajectories are the queries.

    Example: `python -m wpt_agents.zoo retrieve show data/two --model m.zip --task walker-run`
    """
    from wpt_agents.agents.wpt import WPT
    from wpt_agents.zoo.pictures import datasets, retrieval
    from wpt_agents.zoo.tasks import find_tasks

    agent = WPT.load(model_file(model), dataset=folder)
    assert agent.dataset is not None
    queries = [retrieval.query_of(agent.dataset, i) for i in query]
    rows = find_tasks(suite, task) if task else []
    look = _look(folder, rendering)
    queries += [retrieval.query_at(row, look) for row in rows]
    if not queries:
        chosen = datasets.spread(agent.dataset, 6)
        queries = [retrieval.query_of(agent.dataset, i) for i in chosen]
    results = [retrieval.search(agent, item, number, own_robot) for item in queries]
    retrieval.retrieval_sheet(out, agent.dataset, results)
    typer.echo(f"Retrieval sheet: {out.resolve()}")


def share_retrieval(
    folder: Annotated[Path, typer.Argument(help="The folder of a dataset that names its tasks.")],
    model: Encoder,
    task: Annotated[list[str], typer.Option(help="Tasks whose first images are the queries.")],
    suite: Suite = "metaworld",
    rendering: TaskRendering = None,
    number: Annotated[int, typer.Option(min=1, help="The number of retrieved trajectories.")] = 40,
    images: Annotated[
        list[int], typer.Option(min=1, help="The number of first images of the task to compare.")
    ] = [1, 5, 10, 20, 40],  # noqa: B006
    seed: Annotated[int, typer.Option(min=0, help="The seed of the first episode.")] = 0,
) -> None:
    """Print the share of retrieved trajectories that are of the right task.

    There is a column for each number of first images that are compared (--images).

    Example: `python -m wpt_agents.zoo retrieve share data/mw --model metaworld-mid --task reach`
    """
    from wpt_agents.agents.wpt import WPT
    from wpt_agents.zoo.judge.retrieved import own_task_shares
    from wpt_agents.zoo.tasks import find_tasks

    agent = WPT.load(model_file(model), dataset=folder)
    look = _look(folder, rendering)
    typer.echo(f"{'first images':28}" + "".join(f"{count:7}" for count in images))
    for name, shares in own_task_shares(agent, find_tasks(suite, task), images, number, look, seed):
        typer.echo(f"{name:28}" + "".join(f"{share:7.2f}" for share in shares))


def _look(folder: Path, rendering: Rendering | None) -> dict[str, str]:
    """Return the keyword arguments of `gymnasium.make` for images like those of a dataset."""
    from wpt_agents.zoo.collect.collection import read_label

    if rendering is not None:
        return {"rendering": str(rendering)}
    return {"rendering": read_label(folder).get("env", {}).get("rendering", "near")}
