"""The command line of the zoo: all commands, and the handling of errors.

Imports are inside the commands so that `--help` answers at once.
"""

import sys
import traceback
import warnings
from typing import Annotated

import typer

from wpt_agents.zoo.commands import data, models, runs, trained
from wpt_agents.zoo.commands.bench import bench
from wpt_agents.zoo.commands.options import Spaced
from wpt_agents.zoo.commands.report import report

HELP = """\
Collect data, pre-train world models, fine-tune them on tasks, and compare the results.

Start with `python -m wpt_agents.zoo list`, then
`python -m wpt_agents.zoo run --suite metaworld --tasks drawer-close --preset demo`.
"""
FIRST_STEPS = """\
Three commands to start with:

  python -m wpt_agents.zoo list --suite metaworld
      shows the tasks, the presets and the methods

  python -m wpt_agents.zoo run --suite metaworld --tasks drawer-close --preset demo
      collects data, fine-tunes the shipped world model on a task and films the result, in minutes

  python -m wpt_agents.zoo report runs
      writes a page about all runs

All commands: python -m wpt_agents.zoo --help. One command: python -m wpt_agents.zoo run --help.
"""
PROGRAM = "python -m wpt_agents.zoo"
FORMAT = warnings.formatwarning  # Python's own, with the file and the line of code
DEBUG = "--debug"
INTERRUPTED = 130  # the exit code of a command that Ctrl-C ended; typer returns it, too
# Errors whose messages say what to do: wrong values, files, a loss that is not finite.
OF_USERS = (ValueError, OSError, FloatingPointError)
# The first versions of Python without the simulators, as in pyproject.toml.
UNAVAILABLE_FROM = {"dm_control": (3, 13), "metaworld": (3, 14), "gymnasium_robotics": (3, 14)}

app = typer.Typer(
    add_completion=False,
    invoke_without_command=True,
    rich_markup_mode="markdown",
    pretty_exceptions_enable=False,
    help=HELP,
)


@app.callback()
def start(
    context: typer.Context,
    debug: Annotated[bool, typer.Option(DEBUG, help="Show the traceback of an error.")] = False,
) -> None:
    """Show the first steps if there is no command."""
    if context.invoked_subcommand is None:
        typer.echo(FIRST_STEPS, nl=False)


data.register(app)
app.command("import-model")(models.import_model)
app.command("list")(runs.list_tasks)
app.command("pretrain", cls=Spaced)(runs.pretrain_model)
app.command("run", cls=Spaced)(runs.run_benchmark)
app.command("eval")(trained.evaluate_model)
app.command("enjoy")(trained.enjoy_model)
app.command("diagnose")(trained.diagnose_model)
app.command("open-loop")(trained.judge_predictions)
app.command("probe", cls=Spaced)(trained.probe_latents)
app.command("push")(trained.push_run)
app.command("pull")(trained.pull_run)
app.command("report")(report)
app.command("bench")(bench)
start.__doc__ = HELP  # what `--help` shows


def main() -> None:
    """Run a command. Errors are printed as one sentence, with a traceback if `--debug` is set.

    Warnings that are meant for users are printed without the line of code. The exit code is 2 for
    errors that the user can fix, 1 for bugs, and 130 for an interruption.
    """
    words = [word for word in sys.argv[1:] if word != DEBUG]
    warnings.formatwarning = sentence
    try:
        code = app(words, prog_name=PROGRAM, standalone_mode=False)  # typer raises its errors
    except KeyboardInterrupt:
        code = INTERRUPTED
    except Exception as error:
        if len(words) < len(sys.argv) - 1:
            traceback.print_exc()
        message, code = explain(error)
        if message:  # empty if typer has printed the help of a group such as `data`
            typer.secho(f"Error: {message}", fg="red", err=True)
    if code == INTERRUPTED:
        kept = "from the finished stages and the last checkpoint"
        again = "without --force" if "--force" in words else kept
        typer.echo(f"Interrupted. The same command continues {again}.", err=True)
    sys.exit(code or 0)


def sentence(
    message: Warning | str,
    category: type[Warning],
    filename: str,
    lineno: int,
    line: str | None = None,
) -> str:
    """Return what is printed for a warning: the message alone, if it is meant for users."""
    if category is UserWarning:
        return f"Warning: {message}\n"
    return FORMAT(message, category, filename, lineno, line)


def explain(error: Exception) -> tuple[str, int]:
    """Return the sentence that describes an error, and the exit code."""
    if isinstance(error, ModuleNotFoundError) and error.name and not error.name.startswith("wpt_"):
        return missing(error.name), 2
    if hasattr(error, "format_message"):  # typer's error for a wrong option or value
        context = getattr(error, "ctx", None)
        command = context.command_path if context else PROGRAM
        sentence = error.format_message().replace("Value error, ", "").rstrip(".")
        return sentence and f"{sentence} (see {command} --help)", 2
    kind = type(error)
    # An import that fails sets the name of the module. An ImportError without one was raised on
    # purpose, by us or by another library, and says which package to install.
    remedy = isinstance(error, ImportError) and error.name is None
    if remedy or isinstance(error, OF_USERS) or kind.__module__.startswith("wpt_envs."):
        return str(error), 2
    return f"{kind.__name__}: {error} (add {DEBUG} to see where, and please report it)", 1


def missing(package: str) -> str:
    """Return the sentence that says how to get a package that is not installed."""
    end = UNAVAILABLE_FROM.get(package)
    if end is not None and sys.version_info[:2] >= end:
        newest = f"{end[0]}.{end[1] - 1}"
        return f"{package} cannot be installed on this version of Python: use {newest} or older"
    return f'{package} is not installed: pip install "wpt-agents[all]"'
