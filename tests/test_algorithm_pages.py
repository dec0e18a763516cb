"""Each algorithm has a page in SB3's form; its commands can be planned and its keywords exist."""

import ast
import inspect
import re
import shlex
from pathlib import Path

import pytest
import typer
from typer.core import TyperGroup
from typer.main import get_command

import wpt_agents
from wpt_agents.zoo.commands import app as command_line
from wpt_agents.zoo.plan.methods import METHODS
from wpt_agents.zoo.plan.runs import make_plan
from wpt_agents.zoo.plan.sequences import make_sequences

FOLDER = Path(__file__).parents[1] / "docs" / "algorithms"
PAGES = {path.stem: path.read_text(encoding="utf-8") for path in FOLDER.glob("*.md")}
INDEX = PAGES.pop("index")
PARTS = [
    "Notes",
    "Can I use it?",
    "Example",
    "Results",
    "How to replicate the results",
    "Parameters",
]
RUNS = sorted(
    set(re.findall(r"^python -m wpt_agents\.zoo (run .*)$", "\n".join(PAGES.values()), re.M))
)


@pytest.mark.parametrize("name", PAGES)
def test_every_page_has_the_parts_in_their_order(name):
    headings = re.findall(r"^## (.*)$", PAGES[name], re.M)
    assert [heading for heading in headings if heading in PARTS] == PARTS
    assert f"\n{name}\n" in INDEX and f"({name}.md)" in INDEX


def test_every_method_of_the_zoo_is_on_a_page_or_in_the_zoos_table():
    zoo = (FOLDER.parent / "zoo.md").read_text(encoding="utf-8")
    words = "\n".join([INDEX, zoo])
    assert not [method for method in METHODS if f"`{method}`" not in words]


@pytest.mark.parametrize("command", RUNS)
def test_every_command_of_the_pages_can_be_planned(command, tmp_path):
    parser, words = get_command(command_line.app), shlex.split(command)
    while isinstance(parser, TyperGroup):
        _, parser, words = parser.resolve_command(typer.Context(parser), words)
    options = parser.make_context("zoo", words).params
    settings = list(options["settings"] or [])
    common = options["preset"], options["seeds"], options["method"], settings, tmp_path, 1, "cpu"
    if options["sequence"]:
        assert make_sequences(options["sequence"], *common)
    else:
        assert make_plan(options["suite"], options["tasks"] or [], *common)


def calls(page):
    """(class, method, keywords) of each call of a public class in a page's examples."""
    for block in re.findall(r"```python\n(.*?)```", page, re.S):
        for node in ast.walk(ast.parse(block)):
            if not isinstance(node, ast.Call):
                continue
            at = node.func
            method = "__init__"
            if isinstance(at, ast.Attribute):
                method, at = at.attr, at.value
            if isinstance(at, ast.Name) and at.id in wpt_agents.__all__:
                yield at.id, method, {item.arg for item in node.keywords if item.arg}


@pytest.mark.parametrize("name", sorted(set(PAGES) - {"curiosity"}))  # its example is a command
def test_the_examples_use_keywords_that_exist(name):
    examples = list(calls(PAGES[name]))
    assert examples
    for cls, method, keywords in examples:
        agent = getattr(wpt_agents, cls)
        known = set(inspect.signature(agent).parameters)
        if method != "__init__":
            known |= set(inspect.signature(getattr(agent, method)).parameters)
        assert keywords <= known, (cls, method, keywords - known)
