"""The command line as a user calls it, without a process of its own."""

import sys
import warnings

from wpt_agents.zoo.commands import app as command_line


def call(monkeypatch, *words):
    """What `python -m wpt_agents.zoo WORDS` ends with: its exit code."""
    monkeypatch.setattr(sys, "argv", ["zoo", *map(str, words)])
    monkeypatch.setattr(warnings, "formatwarning", warnings.formatwarning)  # which `main` changes
    try:
        command_line.main()
    except SystemExit as stopped:
        return stopped.code
    return 0
