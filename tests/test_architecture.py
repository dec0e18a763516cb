"""The layers: a folder imports only from those below it, and nobody imports the package root."""

import ast
import re
import sys
import tomllib
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
# Read it as a sentence: the zoo runs agents, agents train models, models eat data, data are files.
LAYERS = ["zoo", "agents", "training", "fast", "model", "data", "files"]
# The folders of the zoo, from the top down; its single modules are below all of them.
ROOMS = ["commands", "bench", "run", "report", "judge", "pictures", "plan", "collect"]
ENTRANCES = {"wpt_agents.zoo.__main__", "wpt_agents.zoo.presets"}  # the second for version 0.1


def modules(package):
    """Each module's dotted name and path, tests and presets apart."""
    folder = {"wpt_agents": ROOT / "wpt_agents", "wpt_envs": ROOT / "envs" / "wpt_envs"}[package]
    paths = sorted(folder.rglob("*.py"))
    parts = [path.relative_to(folder.parent).with_suffix("").parts for path in paths]
    return [(".".join(p).removesuffix(".__init__"), f) for p, f in zip(parts, paths, strict=True)]


def imports(name, path):
    """Every module that `path` imports anywhere, in functions and type checks too."""
    package = name.split(".") if path.stem == "__init__" else name.split(".")[:-1]
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            source = ".".join(base + ([node.module] if node.module else []))
            yield source
            yield from (f"{source}.{alias.name}" for alias in node.names)


@cache
def within(package):
    """The imports of each module of `package` that stay inside it."""
    names = {name for name, _ in modules(package)}
    return {n: {i for i in imports(n, p) if i in names - {n}} for n, p in modules(package)}


def folder(module):
    part = module.removeprefix("wpt_agents.").split(".")[0]
    assert part in LAYERS, f"{module} stands in no layer: give it one in LAYERS"
    return part


AGENT = [n for n, _ in modules("wpt_agents") if n != "wpt_agents"]


@pytest.mark.parametrize("module", AGENT)
def test_each_module_imports_only_from_its_own_folder_and_those_below(module):
    room = folder(module)
    others = {folder(other) for other in within("wpt_agents")[module] - {"wpt_agents"}}
    above = {other for other in others if LAYERS.index(other) < LAYERS.index(room)}
    assert not {(room, other) for other in above}


def zoo_room(module):
    part = module.removeprefix("wpt_agents.zoo.").split(".")[0]
    return part if part in ROOMS else None


@pytest.mark.parametrize("module", [name for name in AGENT if name.startswith("wpt_agents.zoo.")])
def test_each_folder_of_the_zoo_imports_only_from_those_below(module):
    ours = zoo_room(module)
    others = {zoo_room(other) for other in within("wpt_agents")[module]} - {ours, None}
    below = ROOMS if module in ENTRANCES else ROOMS[ROOMS.index(ours) + 1 :] if ours else []
    assert others <= set(below)


@pytest.mark.parametrize("package", ["wpt_agents", "wpt_envs"])
def test_no_module_imports_itself_through_others_not_even_lazily(package):
    graph = {n: {i for i in imported if i != package} for n, imported in within(package).items()}
    TopologicalSorter(graph).prepare()  # raises CycleError with the cycle


@pytest.mark.parametrize("module", AGENT)
def test_nobody_inside_imports_the_package_root(module):
    path = dict(modules("wpt_agents"))[module]
    roots = [
        node
        for node in ast.walk(ast.parse(path.read_text()))
        if (isinstance(node, ast.ImportFrom) and node.module == "wpt_agents")
        or (isinstance(node, ast.Import) and "wpt_agents" in [a.name for a in node.names])
    ]
    assert not roots


@pytest.mark.parametrize(("module", "path"), modules("wpt_envs"))
def test_the_tasks_know_neither_torch_nor_the_agent(module, path):
    assert not {i.split(".")[0] for i in imports(module, path)} & {"torch", "wpt_agents"}


def test_only_the_zoo_knows_both_agent_and_tasks():
    knows = {n for n, p in modules("wpt_agents") if any("wpt_envs" in i for i in imports(n, p))}
    assert all(name.startswith("wpt_agents.zoo") for name in knows)


def test_the_reader_of_imports_sees_lazy_and_relative_ones(tmp_path):
    path = tmp_path / "rssm.py"
    path.write_text("def f():\n    from ..agents.wpt import WPT\n    import wpt_agents.zoo\n")
    seen = set(imports("wpt_agents.model.rssm", path))
    assert {"wpt_agents.agents.wpt", "wpt_agents.zoo"} <= seen


PYPROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
NAMES = {"faiss_cpu": "faiss", "pyyaml": "yaml", "pillow": "PIL"}  # what packages are imported as
SIMULATORS = {"mujoco", "lxml", "dm_env", "glfw"}  # what comes with them


def declared(*extras):
    """The import names of what the package and these extras install."""
    lines = [*PYPROJECT["dependencies"]]
    for extra in extras:
        lines += PYPROJECT["optional-dependencies"][extra]
    packages = {re.split("[<>=;\\[ ]", line)[0].replace("-", "_") for line in lines}
    return {NAMES.get(name, name) for name in packages} | (
        SIMULATORS if "sims" in extras else set()
    )


@pytest.mark.parametrize(
    ("package", "part", "extras"),
    [
        ("wpt_agents", lambda name: not name.startswith("wpt_agents.zoo"), ()),
        ("wpt_agents", lambda name: name.startswith("wpt_agents.zoo"), ("zoo", "sims")),
        ("wpt_envs", lambda name: True, ("sims",)),
    ],
    ids=["agents", "zoo", "tasks"],
)
def test_every_third_party_import_is_declared_where_it_is_needed(package, part, extras):
    inside = {"wpt_agents", "wpt_envs", ""} | set(sys.stdlib_module_names)
    every = {i.split(".")[0] for n, p in modules(package) if part(n) for i in imports(n, p)}
    assert every - inside <= declared(*extras)
