"""Make an agent's keywords and counters its attributes, and its signature and documentation.

They are declared once, in dataclasses; `PixelAgent` calls `declare` for each of its subclasses.
"""

import inspect
import textwrap
from collections.abc import Callable
from dataclasses import fields
from typing import Any

from wpt_agents.training.keywords import Keywords
from wpt_agents.training.progress import Progress


class KeywordAttribute:
    """Reads a keyword of `agent.hyperparameters`; writing goes through `change_hyperparameter`."""

    def __set_name__(self, owner: type, name: str) -> None:
        self.name = name

    def __get__(self, agent: Any, owner: type | None = None) -> Any:
        if agent is None:
            return self
        return agent.hyperparameters.value(self.name)

    def __set__(self, agent: Any, value: Any) -> None:
        agent.change_hyperparameter(self.name, value)


class ProgressAttribute:
    """Reads and writes a counter of `agent.progress`."""

    def __set_name__(self, owner: type, name: str) -> None:
        self.name = name

    def __get__(self, agent: Any, owner: type | None = None) -> Any:
        if agent is None:
            return self
        return getattr(agent.progress, self.name)

    def __set__(self, agent: Any, value: Any) -> None:
        setattr(agent.progress, self.name, value)


def declare(
    agent: type, keywords: type[Keywords], progress: type[Progress], init: Callable[..., None]
) -> None:
    """Give a class the attributes, the signature and the documentation of its keywords."""
    attributes: dict[str, Any] = {item.name: ProgressAttribute() for item in fields(progress)}
    attributes |= {name: KeywordAttribute() for name in keywords.declared()}
    for name, attribute in attributes.items():
        attribute.__set_name__(agent, name)
        setattr(agent, name, attribute)
    agent.__signature__ = signature(keywords, init)  # type: ignore[attr-defined]
    own = agent.__dict__.get("__doc__")
    if own:
        indented = textwrap.indent(keywords.documentation(), "    ")
        agent.__doc__ = f"{own.rstrip()}\n{indented}\n    "


def signature(keywords: type[Keywords], init: Callable[..., None]) -> inspect.Signature:
    """Return the signature of an agent: the parameters of `init` around the keywords."""
    parameters = list(inspect.signature(init).parameters.values())[1:]  # without self
    kinds = inspect.Parameter
    first = [item for item in parameters if item.kind is kinds.POSITIONAL_OR_KEYWORD]
    last = [item for item in parameters if item.kind is kinds.KEYWORD_ONLY]
    return inspect.Signature([*first, *keywords.parameters(), *last])
