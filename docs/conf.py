"""Configuration of the documentation site: `make docs`.

Every page is a Markdown file that can be read in the repository as well. Three things are done
when the site is built: pages such as docs/changelog.md are replaced by the file at the root of the
repository that they point to, pages of the API reference get the documentation of all modules of
their folder, and links that lead out of docs/ become downloads.
"""

import re
import tomllib
from pathlib import Path

from sphinx.application import Sphinx

DOCS = Path(__file__).parent
ROOT = DOCS.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]

project = "wpt_agents"
author = "The wpt_agents authors"
copyright = "2026, " + author
version = release = PROJECT["version"]

extensions = [
    "myst_nb",  # Markdown and notebooks
    "sphinx.ext.autodoc",
    "sphinx_copybutton",
]
exclude_patterns = ["_build", "**/.ipynb_checkpoints"]
myst_enable_extensions = ["colon_fence"]
myst_heading_anchors = 3
nb_execution_mode = "off"  # tests/test_tutorials.py executes the notebooks

default_role = "code"  # docstrings write `name` for code
autodoc_member_order = "bysource"
autodoc_preserve_defaults = True
add_module_names = False
maximum_signature_line_length = 80  # longer signatures have a line for each parameter

html_theme = "furo"
html_title = f"wpt_agents {version}"
html_show_sourcelink = False
templates_path = ["_templates"]  # search.html has a sentence where the theme's is empty

linkcheck_timeout = 30
linkcheck_retries = 2

FROM_ROOT = {
    "contributing": "CONTRIBUTING.md",
    "changelog": "CHANGELOG.md",
    "security": "SECURITY.md",
}
MODULES_OF = {
    "api/agents": ROOT / "wpt_agents" / "agents",
    "api/training": ROOT / "wpt_agents" / "training",
    "api/model": ROOT / "wpt_agents" / "model",
    "api/fast": ROOT / "wpt_agents" / "fast",
    "api/data": ROOT / "wpt_agents" / "data",
    "api/files": ROOT / "wpt_agents" / "files",
    "api/environments": ROOT / "envs" / "wpt_envs",
}
LINK = re.compile(r"(?<!!)\[([^\]]*)\]\(((?!http|#|path:)[^)#\s]+)([^)\s]*)\)")


def from_root(name: str) -> str:
    """A file at the root of the repository, its links relative to docs/."""
    text = (ROOT / name).read_text()
    return LINK.sub(lambda link: f"[{link[1]}](../{link[2]}{link[3]})", text)


def modules_of(folder: Path) -> str:
    """An automodule directive for each module of a package, without private ones."""
    sections = []
    for path in sorted(folder.rglob("*.py")):
        name = ".".join(path.relative_to(folder.parent).with_suffix("").parts)
        name = f"wpt_agents.{name}" if folder.parent.name == "wpt_agents" else name
        if path.stem.startswith("_"):
            continue
        sections.append(
            f"## {name}\n\n```{{eval-rst}}\n.. automodule:: {name}\n   :members:\n"
            "   :show-inheritance:\n```\n"
        )
    return "\n".join(sections)


def outward_links(text: str, folder: Path) -> str:
    """Links to pages at the root lead to their copies, those to other files download them."""

    def outward(link: re.Match[str]) -> str:
        words, target, anchor = link.groups()
        path = (folder / target).resolve()
        for page, name in FROM_ROOT.items():
            if path == ROOT / name:
                return f"[{words}](/{page}.md{anchor})"
        if path.is_relative_to(DOCS):
            return f"[{words}](/{path.relative_to(DOCS)}{anchor})"
        return f"[{words}](path:{target})" if path.is_file() else words

    return LINK.sub(outward, text)


def prepare(app: Sphinx, docname: str, source: list[str]) -> None:
    """Complete the Markdown of a page; see the top of this file."""
    path = Path(app.env.doc2path(docname))
    if path.suffix != ".md":
        return
    text = from_root(FROM_ROOT[docname]) if docname in FROM_ROOT else source[0]
    if docname in MODULES_OF:
        text += "\n" + modules_of(MODULES_OF[docname])
    source[0] = outward_links(text, path.parent)


def headings(
    app: Sphinx, what: str, name: str, thing: object, options: object, lines: list[str]
) -> None:
    """Turn the Markdown headings of a docstring, which are Gymnasium's form, into headings here."""
    text = "\n".join(lines)
    lines[:] = re.sub(r"^## (.*)$", r".. rubric:: \1\n", text, flags=re.M).split("\n")


def setup(app: Sphinx) -> None:
    """Connect the preparation of pages and of docstrings."""
    app.connect("source-read", prepare)
    app.connect("autodoc-process-docstring", headings)
