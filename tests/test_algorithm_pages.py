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
from wpt_agents.agents.wpt import WPT
from wpt_agents.zoo.commands import app as command_line
from wpt_agents.zoo.plan.methods import ABLATION, METHODS, defaults
from wpt_agents.zoo.plan.request import Request
from wpt_agents.zoo.plan.runs import make_plan
from wpt_agents.zoo.plan.sequences import make_sequences
from wpt_agents.zoo.report import figure2, figure4
from wpt_agents.zoo.report.aggregates import references

FOLDER = Path(__file__).parents[1] / "docs" / "algorithms"
PAGES = {path.stem: path.read_text(encoding="utf-8") for path in FOLDER.glob("*.md")}
INDEX = PAGES.pop("index")
ZOO = (FOLDER.parent / "zoo.md").read_text(encoding="utf-8")
PARTS = [
    "Notes",
    "Can I use it?",
    "Example",
    "Results",
    "How to replicate the results",
    "Parameters",
]
RUN = re.compile(r"^python -m wpt_agents\.zoo (run [^#\n]*)", re.M)  # without a comment
RUNS = sorted(set(RUN.findall("\n".join([*PAGES.values(), ZOO]))))
# The commands of the figures and tables of the paper, on the zoo's page.
PAPERS = RUN.findall(ZOO.split("\n## Figures and tables of the paper\n")[1].split("\n## ")[0])
OTHERS = {"curiosity", "sac"}  # whose examples are a command and Stable-Baselines3's class


@pytest.mark.parametrize("name", PAGES)
def test_every_page_has_the_parts_in_their_order(name):
    headings = re.findall(r"^## (.*)$", PAGES[name], re.M)
    assert [heading for heading in headings if heading in PARTS] == PARTS
    assert f"\n{name}\n" in INDEX and f"({name}.md)" in INDEX


def test_every_method_of_the_zoo_is_on_a_page_or_in_the_zoos_table():
    words = "\n".join([INDEX, ZOO])
    assert not [method for method in METHODS if f"`{method}`" not in words]


def options_of(command):
    """The options of a command of the zoo, as the command line reads them."""
    parser, words = get_command(command_line.app), shlex.split(command)
    while isinstance(parser, TyperGroup):
        _, parser, words = parser.resolve_command(typer.Context(parser), words)
    return parser.make_context("zoo", words).params


@pytest.mark.parametrize("command", RUNS)
def test_every_command_of_the_pages_can_be_planned(command, tmp_path):
    options = options_of(command)
    settings = list(options["settings"] or [])
    request = Request(options["preset"], options["seeds"], options["method"], settings, tmp_path)
    if options["sequence"]:
        assert make_sequences(options["sequence"], request)
    else:
        assert make_plan(options["suite"], options["tasks"] or [], request)


def test_the_commands_of_the_papers_figures_and_tables_make_all_that_the_report_looks_for():
    runs = [options_of(command) for command in PAPERS]
    figure_2_runs = [one for one in runs if one["tasks"]]
    tasks = {f"{one['suite']}-{task}" for one in figure_2_runs for task in one["tasks"]}
    assert tasks == set(figure2.FIGURE_2)
    assert all(set(one["method"]) == set(figure2.COMPARED) for one in figure_2_runs)
    [sequence] = [one for one in runs if one["sequence"]]
    assert set(sequence["method"]) == set(figure4.COMPARED)
    whole = {(one["suite"], *one["method"]) for one in runs if not one["tasks"]}
    columns = dict.fromkeys(row.method for row in references() if row.method in METHODS)
    for suite in ("dmc", "metaworld"):
        assert (suite, *ABLATION) in whole
        assert any(one[0] == suite and set(one[1:]) == columns.keys() for one in whole)


@pytest.mark.parametrize("command", PAPERS)
def test_the_papers_figures_can_be_made_on_a_cpu_too(command, tmp_path):
    options = options_of(command.replace("--preset paper", "--preset mid"))
    request = Request("mid", options["seeds"], options["method"], out=tmp_path)
    if options["sequence"]:
        assert make_sequences(options["sequence"], request)
    else:
        assert make_plan(options["suite"], options["tasks"] or [], request)


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


@pytest.mark.parametrize("name", sorted(set(PAGES) - OTHERS))
def test_the_examples_use_keywords_that_exist(name):
    examples = list(calls(PAGES[name]))
    assert examples
    for cls, method, keywords in examples:
        agent = getattr(wpt_agents, cls)
        known = set(inspect.signature(agent).parameters)
        if method != "__init__":
            known |= set(inspect.signature(getattr(agent, method)).parameters)
        assert keywords <= known, (cls, method, keywords - known)


def test_the_example_of_dreamer_has_the_keywords_of_its_method():
    [block] = re.findall(r"```python\n(.*?)```", PAGES["dreamer"], re.S)
    nodes = [node for node in ast.walk(ast.parse(block)) if isinstance(node, ast.Call)]
    [made] = [node for node in nodes if isinstance(node.func, ast.Name) and node.func.id == "WPT"]
    shown = {item.arg: ast.literal_eval(item.value) for item in made.keywords}
    assert shown.pop("size") == "small"
    usual = defaults(WPT)
    meant = METHODS["dreamer-v3"].keywords
    assert shown == {key: value for key, value in meant.items() if value != usual[key]}
