"""The project is written in plain English: a list of words from its old dialect stays out.

Run `python tests/test_words.py FOLDER ...` to print every finding in some folders.
"""

import ast
import io
import re
import sys
import tokenize
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
BANNED = re.compile(
    r"\b(?i:told|given|held(?!-out)|anew|aloud|the like|so many|(?<!soon )as it is)\b"
    r"|\b(?i:by itself|what no other)\b"
    r"|\bOf each\b"  # a fragment at the start; "of each" within a sentence is fine
)
BANNED_NAMES = {"told", "given", "held", "wanted", "found", "about", "own", "each"}
ALLOWED = {"tests/test_words.py"}  # it has to name the words


def prose(markdown):
    """The lines of a Markdown file outside code blocks, tables and inline code, with numbers."""
    inside = False
    for number, line in enumerate(markdown.splitlines(), 1):
        if line.lstrip().startswith("```"):
            inside = not inside
        elif not inside:
            yield number, re.sub(r"`[^`]*`", "", line)


def strings_and_comments(code):
    """The strings and comments of a Python file, with their line numbers."""
    kinds = {tokenize.COMMENT, tokenize.STRING}
    kinds |= {getattr(tokenize, "FSTRING_MIDDLE", tokenize.STRING)}  # from Python 3.12 on
    for token in tokenize.generate_tokens(io.StringIO(code).readline):
        if token.type in kinds:
            for offset, line in enumerate(token.string.splitlines()):
                yield token.start[0] + offset, line


def names(code):
    """The names that a Python file gives to variables, arguments and functions."""
    for node in ast.walk(ast.parse(code)):
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            yield node.lineno, node.id
        elif isinstance(node, ast.arg):
            yield node.lineno, node.arg
        elif isinstance(node, ast.FunctionDef | ast.ClassDef):
            yield node.lineno, node.name


def findings(path):
    """Every banned word or name in a file, as 'path:line: text'."""
    text, place = path.read_text(), path.relative_to(ROOT)
    read = prose if path.suffix == ".md" else strings_and_comments
    for number, line in read(text):
        if match := BANNED.search(line):
            yield f"{place}:{number}: {match[0]!r} in {line.strip()}"
    if path.suffix == ".py":
        for number, name in names(text):
            if name in BANNED_NAMES:
                yield f"{place}:{number}: the name {name!r}"


def folder(path):
    """The folder that a file is listed under: two levels deep, or the file itself at the root."""
    parts = path.relative_to(ROOT).parts
    if parts[0] == "docs" or len(parts) == 1:
        return "/".join(parts)
    return "/".join(parts[:-1])


FILES = [
    path
    for place in ("wpt_agents", "envs", "tests", "docs", "examples", ".github", ".")
    for pattern in ("*.py", "*.md")
    for path in sorted((ROOT / place).glob(pattern if place == "." else f"**/{pattern}"))
    if str(path.relative_to(ROOT)) not in ALLOWED and "_build" not in path.parts
]
FOLDERS = sorted({folder(path) for path in FILES})


@pytest.mark.parametrize("place", FOLDERS)
def test_no_banned_word_is_written(place):
    files = [path for path in FILES if folder(path) == place]
    assert not [finding for path in files for finding in findings(path)]


def test_banned_words_are_seen_in_comments_strings_and_names():
    code = 'given = "a value"  # told twice\nprint("written anew")\n'
    assert [text for _, text in strings_and_comments(code) if BANNED.search(text)] == [
        "# told twice",
        '"written anew"',
    ]
    assert [name for _, name in names(code)] == ["given"]


def test_code_in_markdown_is_not_prose():
    page = "Words `told` here.\n```python\ngiven = 1\n```\nThe end, told."
    assert [number for number, line in prose(page) if BANNED.search(line)] == [5]


def docstrings(code):
    """The docstrings of a Python file."""
    for node in ast.walk(ast.parse(code)):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef):
            yield ast.get_docstring(node) or ""


def unset(docstring):
    """What the site reads as unfinished markup: a code span that letters follow, or |x|."""
    text = re.sub(r"^ {4}.*$", "", docstring, flags=re.M)  # without indented code
    text = re.sub(r"`[^`]*`", "`", text)
    return re.findall(r"`\w+", text) + re.findall(r"(?<![\w|])\|[^|\s]+\|(?!\|)", text)


def test_the_site_can_set_every_docstring():
    paths = [*ROOT.glob("wpt_agents/**/*.py"), *ROOT.glob("envs/**/*.py")]
    found = {path: [unset(text) for text in docstrings(path.read_text())] for path in paths}
    assert len(found) > 150 and not {path: every for path, every in found.items() if any(every)}
    assert unset("Files of `tf.Example`s.") and unset("The loss is |x|.") and not unset("`|x|`")


if __name__ == "__main__":
    for path in FILES:
        if not sys.argv[1:] or folder(path) in sys.argv[1:]:
            print(*findings(path), sep="\n")
