"""The contributor's pages, the drawing and the make targets agree with the code."""

import re
import runpy
from pathlib import Path
from pkgutil import resolve_name

import pytest
import test_architecture

ROOT = Path(__file__).parents[1]
PAGES = ["CONTRIBUTING.md", "CHANGELOG.md", "SECURITY.md", "docs/architecture.md"]
MAKEFILE = (ROOT / "Makefile").read_text()


def test_the_drawing_shows_the_layers_that_are_enforced():
    script = runpy.run_path(str(ROOT / "docs" / "draw_layers.py"))
    assert [name for name, *_ in script["LAYERS"]] == test_architecture.LAYERS
    assert (ROOT / "docs" / "layers.svg").read_text() == script["draw"]()


@pytest.mark.parametrize("page", PAGES)
def test_files_and_commands_that_are_named_exist(page):
    text = (ROOT / page).read_text()
    for name in re.findall(r"`((?:tests|envs|wpt_agents|docs)/(?!_build)[\w/.]+)`", text):
        assert (ROOT / name).exists(), name
    for target in re.findall(r"`make (\w+)`", text):
        assert re.search(rf"^{target}:", MAKEFILE, re.M), target


def test_help_lists_every_target_for_people():
    listed = set(re.findall(r"^#   make (\w+)", MAKEFILE, re.M))
    targets = set(re.findall(r"^([a-z]+):", MAKEFILE, re.M))
    assert targets - listed == {"help", "install", "rendering", "clean"}
    phony = re.search(r"^\.PHONY: (.*)$", MAKEFILE, re.M)[1].split()
    assert set(phony) == targets


def test_every_module_that_the_migration_page_names_exists():
    table = (ROOT / "docs" / "migrating.md").read_text()
    moved = re.findall(r"^\| `(wpt_agents[\w.]*)` \| `(wpt_agents[\w.]*)` \|$", table, re.M)
    assert len(moved) > 30
    for _, name in moved:
        assert resolve_name(name), name
