"""How the command line starts, helps and fails."""

import re
import shlex
import tomllib
from pathlib import Path

import pytest
import typer
from typer.main import get_command
from wpt_envs.headless import RenderingError
from zoo_command import call

from wpt_agents.zoo.commands import app as command_line

GROUP = get_command(command_line.app)
COMMANDS = {name: command for name, command in GROUP.commands.items()}
LEAVES = {
    f"{name} {inner}".strip(): leaf
    for name, command in COMMANDS.items()
    for inner, leaf in getattr(command, "commands", {"": command}).items()
}


def test_without_a_command_three_commands_to_start_with_are_shown(monkeypatch, capsys):
    assert call(monkeypatch) == 0
    shown = capsys.readouterr().out
    commands = [line.split()[3] for line in shown.splitlines() if line.startswith("  python -m")]
    assert commands == ["list", "run", "report"] and set(commands) <= COMMANDS.keys()


@pytest.mark.parametrize("name", LEAVES)
def test_each_command_has_an_example_and_describes_every_option(name):
    command = LEAVES[name]
    assert f"Example: `python -m wpt_agents.zoo {name} " in command.help
    for option in command.params:
        assert option.name in ("help", "seed") or option.help, option.name


@pytest.mark.parametrize("name", LEAVES)
def test_the_examples_of_the_help_are_understood(name):
    examples = re.findall(r"`python -m wpt_agents\.zoo (.*?)(?: > \S+)?`", LEAVES[name].help)
    assert examples
    for example in examples:
        words, command = shlex.split(example), GROUP
        while hasattr(command, "commands"):
            _, command, words = command.resolve_command(typer.Context(command), words)
        assert command is LEAVES[name]
        command.make_context(name, words)  # raises on what it does not understand


@pytest.mark.parametrize("name", [name for name in COMMANDS if name not in LEAVES])
def test_a_group_of_commands_has_an_example_of_one(name):
    [example] = re.findall(r"Example: `python -m wpt_agents\.zoo (.*)`", COMMANDS[name].help)
    group, command, *words = shlex.split(example)
    assert group == name
    LEAVES[f"{group} {command}"].make_context(command, words)


@pytest.mark.parametrize("words", ["--tasks a b --set c=1 d=2", "--tasks=a b --set=c=1 d=2"])
def test_an_option_takes_several_values_however_the_first_is_written(words):
    context = COMMANDS["run"].make_context("run", shlex.split(words))
    assert list(context.params["tasks"]) == ["a", "b"]
    assert list(context.params["settings"]) == ["c=1", "d=2"]


def fail(error):
    def load(*_, **__):
        raise error

    return load


@pytest.mark.parametrize(
    ("error", "sentence", "code"),
    [
        (ValueError("no such thing"), "Error: no such thing\n", 2),
        (FileNotFoundError("There is no x"), "Error: There is no x\n", 2),
        (
            ModuleNotFoundError("No module named 'dm_control'", name="dm_control"),
            'Error: dm_control is not installed: pip install "wpt-agents[all]"\n',
            2,
        ),
        (
            ImportError("Reading HDF5 needs h5py: pip install h5py"),
            "Error: Reading HDF5 needs h5py: pip install h5py\n",
            2,
        ),
        (
            ImportError("cannot import name 'x' from 'wpt_agents.y'", name="wpt_agents.y"),
            "Error: ImportError: cannot import name 'x' from 'wpt_agents.y' (add --debug to see "
            "where, and please report it)\n",
            1,
        ),
        (RenderingError("Drawing needs EGL"), "Error: Drawing needs EGL\n", 2),
        (FloatingPointError("The loss is nan"), "Error: The loss is nan\n", 2),
        (
            ModuleNotFoundError("No module named 'wpt_agents.x'", name="wpt_agents.x"),
            "Error: ModuleNotFoundError: No module named 'wpt_agents.x' (add --debug to see where, "
            "and please report it)\n",
            1,
        ),
        (
            KeyError("x"),
            "Error: KeyError: 'x' (add --debug to see where, and please report it)\n",
            1,
        ),
    ],
)
def test_an_error_is_one_sentence_and_debug_shows_where(
    error, sentence, code, monkeypatch, capsys, tmp_path
):
    monkeypatch.setattr("wpt_agents.zoo.judge.trained.find_trained", fail(error))
    assert call(monkeypatch, "eval", tmp_path) == code
    assert capsys.readouterr().err == sentence
    assert call(monkeypatch, "eval", tmp_path, "--debug") == code
    shown = capsys.readouterr().err
    assert shown.startswith("Traceback") and shown.endswith(sentence)


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (
            ["rum"],
            "No such command 'rum'. Did you mean 'run'? (see python -m wpt_agents.zoo --help)",
        ),
        (["run", "--fram", "9"], "(see python -m wpt_agents.zoo run --help)"),
        (["run", "--tasks"], "Option '--tasks' requires an argument (see "),
        (["collect"], "Missing option '--out' (see python -m wpt_agents.zoo collect --help)"),
        (
            ["bench", "--precision", "fp8"],
            "'fp8' is not one of 'fp32', 'bf16' (see python -m wpt_agents.zoo bench",
        ),
        (
            ["data", "shw"],
            "Did you mean 'show'? (see python -m wpt_agents.zoo data --help)",
        ),
    ],
)
def test_a_wrong_word_ends_in_one_sentence(words, sentence, monkeypatch, capsys):
    assert call(monkeypatch, *words) == 2
    printed = capsys.readouterr()
    assert printed.err.startswith("Error: ") and printed.err.count("\n") == 1
    assert sentence in printed.err and printed.out == ""


def test_a_group_without_a_command_shows_its_help(monkeypatch, capsys):
    assert call(monkeypatch, "data") == 2
    printed = capsys.readouterr()
    assert "validate" in printed.out and printed.err == ""


def test_ctrl_c_ends_in_one_sentence(monkeypatch, capsys, tmp_path):
    monkeypatch.setattr("wpt_agents.zoo.judge.trained.find_trained", fail(KeyboardInterrupt()))
    assert call(monkeypatch, "eval", tmp_path) == 130
    sentence = "The same command continues from the finished stages and the last checkpoint."
    assert capsys.readouterr().err == f"Interrupted. {sentence}\n"


def test_ctrl_c_of_a_forced_run_says_that_force_would_begin_again(monkeypatch, capsys):
    monkeypatch.setattr("wpt_agents.zoo.plan.runs.make_plan", fail(KeyboardInterrupt()))
    assert call(monkeypatch, "run", "--force") == 130
    assert capsys.readouterr().err == "Interrupted. The same command continues without --force.\n"


def test_a_simulator_that_this_python_cannot_have_is_named_with_the_newest_that_can(monkeypatch):
    project = tomllib.loads((Path(__file__).parents[3] / "pyproject.toml").read_text())["project"]
    simulators = "\n".join(project["optional-dependencies"]["sims"])
    ends = re.findall(r"^([a-z-]+)[<>=].*python_version < '3\.(\d+)'", simulators, re.M)
    expected = {name.replace("-", "_"): (3, int(minor)) for name, minor in ends}
    assert expected == command_line.UNAVAILABLE_FROM != {}
    monkeypatch.setattr(command_line.sys, "version_info", (3, 13, 1))
    sentence = "dm_control cannot be installed on this version of Python: use 3.12 or older"
    assert command_line.missing("dm_control") == sentence
    assert command_line.missing("metaworld").endswith('pip install "wpt-agents[all]"')
