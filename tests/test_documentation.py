"""What all pages and tutorials name exists: commands, anchors, imports, keywords and options."""

import ast
import csv
import inspect
import json
import re
import runpy
import shlex
from importlib import import_module
from pathlib import Path

import pytest
import typer
from test_algorithm_pages import calls
from typer.core import TyperGroup
from typer.main import get_command

import wpt_agents
from wpt_agents.zoo.collect.collection import BEHAVIOURS
from wpt_agents.zoo.commands import app as command_line
from wpt_agents.zoo.plan.methods import METHODS
from wpt_agents.zoo.plan.presets import default_preset, load_preset, suite_names
from wpt_agents.zoo.tasks import find_tasks

ROOT = Path(__file__).parents[1]
FILES = [
    *ROOT.glob("*.md"),
    *(path for path in (ROOT / "docs").rglob("*.md") if "_build" not in path.parts),
    *(ROOT / "docs" / "tutorials").glob("*.ipynb"),
    *(ROOT / folder / "README.md" for folder in ("examples", "zoo/models")),
]


def prose(path):
    """A page's Markdown; of a notebook, that of its cells of text."""
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".md":
        return text
    cells = [cell for cell in json.loads(text)["cells"] if cell["cell_type"] == "markdown"]
    return "\n\n".join("".join(cell["source"]) for cell in cells)


PAGES = {str(path.relative_to(ROOT)): prose(path) for path in FILES}


def blocks(text, language):
    return re.findall(rf"```{language}\n(.*?)```", text, re.S)


def commands(text):
    """The words after `python -m wpt_agents.zoo`, in blocks of commands and within sentences."""
    for block in blocks(text, "bash"):
        lines = block.replace("\\\n", " ")
        yield from re.findall(r"-m wpt_agents\.zoo ([^#>\n]*)", lines)
    flat = re.sub(r"```.*?```", "", text, flags=re.S).replace("\n", " ")
    yield from re.findall(r"`python -m wpt_agents\.zoo ([a-z][^`]*)`", flat)


COMMANDS = sorted({command for text in PAGES.values() for command in commands(text)})


def check(command):
    """Raise an error if the command line does not understand a command."""
    words = shlex.split(re.sub(r"\$\([^)]*\)", "FILE", command))
    parser = get_command(command_line.app)
    while isinstance(parser, TyperGroup):
        _, parser, words = parser.resolve_command(typer.Context(parser), words)
    if not words:
        return  # the name of a command, in a sentence
    options = parser.make_context("zoo", words).params
    suite = options.get("suite") or "dmc"
    tasks = [task for task in options.get("tasks") or [] if "$" not in task]
    find_tasks(suite, tasks)
    if "preset" in options and suite in suite_names():
        preset = options["preset"] or default_preset(suite)
        load_preset(suite, preset, options.get("settings") or [])
    assert set(options.get("method") or []) <= set(METHODS)
    behaviour = options.get("behaviour") or []
    assert set([behaviour] if isinstance(behaviour, str) else behaviour) <= set(BEHAVIOURS)


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_is_understood(command):
    check(command)


WRONG = ["rum", "run --taks a", "run --set gama=1", "run --method wtp", "run --tasks rum"]


@pytest.mark.parametrize("command", WRONG)
def test_a_command_with_a_wrong_word_is_not_understood(command):
    usage_error = typer.BadParameter.__base__
    with pytest.raises((usage_error, ValueError, AssertionError)):
        check(command)


@pytest.mark.parametrize("record", ["baselines", "mid", "small-benchmark", "tried"])
def test_the_commands_of_the_records_are_understood(record):
    with open(ROOT / "zoo" / "results" / f"{record}.csv", newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    program = "python -m wpt_agents.zoo "
    said = {re.sub(r"--seeds \S+", "--seeds 1", row["command"]) for row in rows}
    assert said
    for command in said:
        assert command.startswith(program), command
        check(command.removeprefix(program))


def datasets(text):
    """The folders that the examples of a page make datasets in, each with the line that does it."""
    lines = [*commands(text), *re.findall(r"`(import [^`]*)`", text), *blocks(text, "python")]
    made = r"(?:collect .*--out|import \S+ \S+|data merge|\.create\(|\.open_or_create\()"
    for line in lines:
        yield from ((folder, line) for folder in re.findall(made + r' *"?(data/[^\s"$]+)', line))


def test_no_two_examples_make_datasets_in_one_folder():
    made = {}
    for page, text in PAGES.items():
        for folder, line in datasets(text):
            first = made.setdefault(folder, (page, line))
            assert line == first[1], (folder, page, first[0])  # the same command may be repeated
    assert len(made) > 20


def anchors(path):
    """The anchors of a page's headings, as GitHub makes them, and MyST down to the third level."""
    text = re.sub(r"```.*?```", "", prose(path), flags=re.S)
    for heading in re.findall(r"^#{1,3} (.*)$", text, re.M):
        words = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading).lower()
        yield re.sub(r"[^\w\- ]", "", words).replace(" ", "-")


@pytest.mark.parametrize("page", PAGES)
def test_links_lead_to_files_and_headings(page):
    path = ROOT / page
    text = re.sub(r"```.*?```", "", PAGES[page], flags=re.S)
    for target, anchor in re.findall(r"\]\((?!http)([^)#\s]*)#?([^)\s]*)\)", text):
        there = path.parent / target if target else path
        assert there.exists(), target
        assert not anchor or anchor in set(anchors(there)), (target, anchor)


def code(page):
    """The parsed Python blocks of a page."""
    return [ast.parse(block) for block in blocks(PAGES[page], "python")]


WITH_CODE = [page for page in PAGES if code(page)]


@pytest.mark.parametrize("page", WITH_CODE)
def test_what_a_page_imports_exists(page):
    for node in (node for tree in code(page) for node in ast.walk(tree)):
        if isinstance(node, ast.ImportFrom) and node.module.startswith("wpt_"):
            for alias in node.names:
                assert hasattr(import_module(node.module), alias.name), alias.name


@pytest.mark.parametrize("page", WITH_CODE)
def test_the_keywords_and_methods_of_a_page_exist(page):
    keywords = set(inspect.signature(wpt_agents.WPT).parameters)
    agents = [getattr(wpt_agents, n) for n in wpt_agents.__all__ if n[0].isupper()]
    for cls, method, names in calls(PAGES[page]):
        thing = getattr(wpt_agents, cls)
        known = set(inspect.signature(thing).parameters)
        if method != "__init__":
            known |= set(inspect.signature(getattr(thing, method)).parameters)
        assert names <= known, (cls, method, names - known)
    for node in (node for tree in code(page) for node in ast.walk(tree)):
        if isinstance(node, ast.Call) and ast.unparse(node.func) == "dict":
            assert {item.arg for item in node.keywords} <= keywords
        if isinstance(node, ast.Attribute) and ast.unparse(node.value) == "model":
            assert any(hasattr(agent, node.attr) for agent in agents), node.attr


def test_every_option_of_import_is_on_its_page():
    command = get_command(command_line.app).commands["import"]
    options = {name for item in command.params for name in item.opts if name.startswith("--")}
    page = PAGES["docs/importing.md"]
    assert not {name for name in options - {"--help"} if f"`{name}`" not in page}


def test_the_headings_of_docstrings_are_headings_on_the_site():
    pytest.importorskip("sphinx", reason='needs `pip install -e ".[docs]"`')
    headings = runpy.run_path(str(ROOT / "docs" / "conf.py"))["headings"]
    lines = ["A task.", "", "## Rewards", "0 to 1."]
    headings(None, "class", "wpt_envs.dmc.DMControl", None, None, lines)
    assert lines == ["A task.", "", ".. rubric:: Rewards", "", "0 to 1."]


def undocumented(thing):
    names = (n for n in inspect.signature(thing).parameters if n != "self" and n[0] != "_")
    return [name for name in names if f":param {name}:" not in thing.__doc__]


WPTS = re.search(r"autoclass:: wpt_agents.WPT\n +:members: (.*)", PAGES["docs/api/public.md"])[1]
DATASETS = [name for name in dir(wpt_agents.TrajectoryDataset) if name[0] != "_"]
METHODS_OF = {"WPT": WPTS.split(", "), "TrajectoryDataset": DATASETS}


@pytest.mark.parametrize("name", wpt_agents.__all__)
def test_every_parameter_of_a_public_name_is_documented(name):
    thing = getattr(wpt_agents, name)
    if name != "TrajectoryDataset":  # which is made by `create`, `open` and so on
        assert not undocumented(thing)
    members = {method: getattr(thing, method) for method in METHODS_OF.get(name, [])}
    assert not {n: undocumented(m) for n, m in members.items() if callable(m) and undocumented(m)}
