"""The command line of the zoo: every command under its name, and how errors end.

Imports stand inside the commands so that `--help` answers at once.
"""

import sys

import typer

from wpt_agents.zoo.commands import data, models, runs, trained
from wpt_agents.zoo.commands.bench import bench
from wpt_agents.zoo.commands.options import Spaced
from wpt_agents.zoo.commands.report import report

app = typer.Typer(
    add_completion=False,
    no_args_is_help=True,
    rich_markup_mode="markdown",
    pretty_exceptions_enable=False,
    help="Collect data, pre-train world models, fine-tune them on tasks, compare the results.\n\n"
    "Start with `python -m wpt_agents.zoo list`, then "
    "`python -m wpt_agents.zoo run --suite metaworld --tasks drawer-close --preset demo`.",
)
data.register(app)
app.command("import-model")(models.import_model)
app.command("list")(runs.list_tasks)
app.command("pretrain", cls=Spaced)(runs.pretrain_model)
app.command("run", cls=Spaced)(runs.run_benchmark)
app.command("eval")(trained.evaluate_model)
app.command("enjoy")(trained.enjoy_model)
app.command("diagnose")(trained.diagnose_model)
app.command("open-loop")(trained.judge_predictions)
app.command("push")(trained.push_run)
app.command("pull")(trained.pull_run)
app.command("report")(report)
app.command("bench")(bench)


def main() -> None:
    """Run a command; a user's mistake ends in one line and exit code 2."""
    try:
        app()
    except (ValueError, FileNotFoundError) as error:
        typer.secho(f"Error: {error}", fg="red", err=True)
        sys.exit(2)
    except KeyboardInterrupt:
        typer.echo("Interrupted. The same command goes on from the finished stages.", err=True)
        sys.exit(130)
