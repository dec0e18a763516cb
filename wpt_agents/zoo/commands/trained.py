"""The commands for a trained model: eval, enjoy, diagnose, open-loop, probe, push, pull."""

from pathlib import Path
from typing import Annotated

import typer

from wpt_agents.zoo.commands.options import (
    Device,
    Rendering,
    Suite,
    Tasks,
    model_file,
    print_table,
)

RunFolder = Annotated[
    Path,
    typer.Argument(
        help="A run folder, also one that was moved or downloaded, or a model file (.zip)."
    ),
]


ForTask = Annotated[
    str,
    typer.Option(
        help="The task, e.g. `dmc-walker-run`; required for a file outside its run folder, which "
        "is played with the default rendering and action repeat."
    ),
]


Policy = Annotated[
    str,
    typer.Option(
        help="The policy to play: wpt for the trained agent, prior for its prior actor, and actor "
        "for its actor alone if the prior actor takes part in acting (`residual`, `ibrl`)."
    ),
]

ModelArgument = Annotated[
    str,
    typer.Argument(
        help="A model file, the folder of a run or of a pre-training, or the name of a shipped "
        "model."
    ),
]


def evaluate_model(
    run: RunFolder,
    task: ForTask = "",
    policy: Policy = "wpt",
    episodes: Annotated[int, typer.Option(min=1, help="The number of episodes.")] = 10,
    seed: Annotated[int, typer.Option(min=0, help="The seed of the first initial state.")] = 10_000,
    noise: Annotated[
        float,
        typer.Option(
            min=0,
            help="The standard deviation of Gaussian noise on the actions, which shows how precise "
            "they have to be.",
        ),
    ] = 0.0,
    device: Device = "auto",
) -> None:
    """Play a trained model on its task and show its returns. No dataset is needed.

    Example: `python -m wpt_agents.zoo eval runs/demo/wpt/metaworld-drawer-close_0 --episodes 50`
    """
    from wpt_agents.zoo.judge.trained import find_trained
    from wpt_agents.zoo.numbers import interval_text, number

    trained = find_trained(run, task)
    score = trained.evaluate(trained.load(policy, device), episodes, seed, noise)
    mean, low, high = score.interval
    typer.echo(f"task             {trained.task}")
    typer.echo(f"mean return      {number(mean)}")
    typer.echo(f"95 % interval    {interval_text(low, high)}")
    typer.echo(f"returns          {', '.join(map(number, score.returns))}")
    if score.successes:
        ever = score.success_rate_any
        at_any_step = "" if ever is None else f"; {ever:.2f} at any step"
        typer.echo(f"success          {score.success_rate:.2f} at the last step{at_any_step}")
        failed = [str(seed + i) for i, success in enumerate(score.successes) if not success]
        if failed:
            typer.echo(f"failures         seeds {', '.join(failed)} (enjoy --seed shows one)")


def enjoy_model(
    run: RunFolder,
    task: ForTask = "",
    policy: Policy = "wpt",
    seed: Annotated[int, typer.Option(min=0, help="The seed of the initial state.")] = 10_000,
    out: Annotated[Path, typer.Option(help="The file to write: an .mp4 or a .gif.")] = Path(
        "enjoy.mp4"
    ),
    size: Annotated[
        int, typer.Option(min=64, help="The width of the video, a multiple of 16.")
    ] = 256,
    device: Device = "auto",
) -> None:
    """Record a video of an episode of a trained model.

    With `--out policy.gif` it writes a GIF at half speed. Beside the episode are true images above
    those that the world model predicts from the first five images and all actions.

    Example: `python -m wpt_agents.zoo enjoy runs/demo/wpt/metaworld-drawer-close_0`
    """
    from wpt_agents.zoo.judge.trained import find_trained
    from wpt_agents.zoo.numbers import number

    if size % 16:
        raise ValueError(f"--size {size}: a video's width must be a multiple of 16.")
    trained = find_trained(run, task)
    total = trained.record(out, policy, seed, size, device)
    megabytes = out.stat().st_size / 1e6
    typer.echo(f"Return {number(total)}. Video: {out.resolve()} ({megabytes:.1f} MB)")


def diagnose_model(
    run: RunFolder,
    task: ForTask = "",
    episodes: Annotated[int, typer.Option(min=1, help="The number of episodes.")] = 5,
    horizon: Annotated[int, typer.Option(min=1, help="The number of steps to predict.")] = 20,
    seed: Annotated[int, typer.Option(min=0, help="The seed of the first initial state.")] = 10_000,
    update: Annotated[
        int,
        typer.Option(min=0, help="Show the last values that were logged up to this update."),
    ] = 600,
    device: Device = "auto",
) -> None:
    """Compare the rewards and values that a model predicts with the rewards that it then earns.

    For a run folder, a second table has the last values of reward error and entropy that were
    logged up to --update, the largest difference between imagined and earned reward, and the score
    of the prior actor.

    Example: `python -m wpt_agents.zoo diagnose runs/demo/wpt/metaworld-drawer-close_0`
    """
    from wpt_envs.tasks import TASKS

    from wpt_agents.zoo.judge import diagnosis, readings
    from wpt_agents.zoo.judge.trained import find_trained

    trained = find_trained(run, task)
    made = diagnosis.diagnose(trained, episodes, seed, horizon, device)
    diagnosis.show(made, horizon)
    if run.is_dir():
        actions = TASKS[trained.task].action_dim
        readings.show(readings.readings(run, made.promises, actions, update))


def judge_predictions(
    model: ModelArgument,
    data: Annotated[Path, typer.Argument(help="A dataset that the model was not trained on.")],
    episodes: Annotated[
        int,
        typer.Option(
            min=1,
            help="The largest number of episodes of each robot, evenly spaced in the dataset.",
        ),
    ] = 8,
    out: Annotated[
        Path | None,
        typer.Option(
            help="The folder for `prediction.csv` and pictures; none are written by default."
        ),
    ] = None,
    beside: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=MODEL",
            help="Another model to compare with, and its name in the table and pictures; can be "
            "repeated.",
        ),
    ] = None,
    samples: Annotated[
        int,
        typer.Option(
            min=1,
            help="If more than 1, also measure the mean of this many sampled predictions, which is "
            "the model's best guess of an uncertain future.",
        ),
    ] = 1,
    device: Device = "auto",
) -> None:
    """Measure how well a world model predicts: its error at each horizon, beside simple baselines.

    The model sees five images of an episode, and predicts the others from the actions alone. The
    baselines repeat the last image, or show the mean of all images of the tested episodes, which a
    prediction could not know.

    Example: `python -m wpt_agents.zoo open-loop walker.zip data/unseen --out predictions`
    """
    from wpt_agents.agents.wpt import WPT
    from wpt_agents.data.dataset import TrajectoryDataset
    from wpt_agents.zoo.judge.prediction import RESERVED, judge

    chosen = {"world model": model}
    for words in beside or []:
        name, equals, other = words.partition("=")
        if not equals or not name or name in (*chosen, *RESERVED):
            raise ValueError(f"--beside must be NAME=MODEL with a new name, not {words}")
        chosen[name] = other
    models = {name: WPT.load(model_file(one), device=device) for name, one in chosen.items()}
    rows = judge(models, TrajectoryDataset.open(data), episodes, out, samples)
    print_table("Squared error of an image, as in Eq. (1)", list(rows))
    if out is not None:
        typer.echo(f"Pictures: {out.resolve()}")


def probe_latents(
    model: ModelArgument,
    suite: Suite = "dmc",
    tasks: Tasks = [],  # noqa: B006
    episodes: Annotated[
        int,
        typer.Option(
            min=2,
            help="The number of episodes of each task: half to fit on, half to test on. With few, "
            "positions that change only from episode to episode seem to be missing.",
        ),
    ] = 40,
    seed: Annotated[int, typer.Option(min=0, help="The seed of the episodes.")] = 1000,
    rendering: Annotated[Rendering, typer.Option(help="The quality of the images.")] = (
        Rendering.fast
    ),
    device: Device = "auto",
) -> None:
    """Measure how well the simulator's state can be read from a world model's latent states.

    A ridge regression predicts quantities such as the angle of a pole. R² is 1 if it is perfect and
    0 if it is no better than the mean; beside it is that of an untrained model of the same size.

    Example: `python -m wpt_agents.zoo probe metaworld-mid --suite metaworld --tasks drawer-open`
    """
    from wpt_agents.agents.wpt import WPT
    from wpt_agents.zoo.judge.probes import beside_untrained
    from wpt_agents.zoo.tasks import find_tasks

    ids = [row.id for row in find_tasks(suite, tasks)]
    loaded = WPT.load(model_file(model), device=device)
    rows = beside_untrained(loaded, ids, episodes, seed, str(rendering))
    print_table("R² of linear probes on test episodes", list(rows))


def push_run(
    run: Annotated[Path, typer.Argument(help="The folder of a finished run.")],
    name: Annotated[
        str, typer.Argument(help="The repository on the Hugging Face Hub: `user/name`.")
    ],
    private: Annotated[bool, typer.Option(help="Make a repository that only you can see.")] = False,
) -> None:
    """Upload a run to the Hugging Face Hub: model, configuration, scores, video and a card.

    Log in first: `hf auth login`.

    Example: `python -m wpt_agents.zoo push runs/demo/wpt/metaworld-drawer-close_0 me/drawer`
    """
    from wpt_agents.zoo.report.hub import push

    typer.echo(f"Pushed: {push(run, name, private)}")


def pull_run(
    name: Annotated[
        str, typer.Argument(help="The repository on the Hugging Face Hub: `user/name`.")
    ],
    out: Annotated[
        Path | None, typer.Option(help="The folder to write; by default the repository's name.")
    ] = None,
) -> None:
    """Download a run from the Hugging Face Hub, for `eval`, `enjoy` and `WPT.load`.

    Example: `python -m wpt_agents.zoo pull me/drawer --out drawer`
    """
    from wpt_agents.zoo.report.hub import pull

    folder = pull(name, out or Path(name.rpartition("/")[2]))
    typer.echo(f"Pulled: {folder.resolve()}. Watch it: python -m wpt_agents.zoo enjoy {folder}")
