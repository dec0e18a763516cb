"""Keywords and counters, declared once in dataclasses, as an agent's attributes and signature."""

import inspect
import re
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
        attribute.__set_name__(agent, name)  # Python calls it only for attributes in a class's body
        setattr(agent, name, attribute)
    agent.__signature__ = signature(keywords, init)  # type: ignore[attr-defined]
    if text := inspect.cleandoc(agent.__dict__.get("__doc__") or ""):
        if ":param policy:" in text and ":param env:" not in text:
            text += f"\n{common_parameters(agent)}"
        gap = "\n" if ":param" in text else "\n\n"  # a list of parameters stands apart
        agent.__doc__ = f"{text}{gap}{keywords.documentation()}\n"


def common_parameters(agent: type) -> str:
    """Return the documentation of the parameters that every agent has, such as `env`."""
    documents = (inspect.cleandoc(base.__doc__ or "") for base in agent.__mro__[1:])
    matches = (re.search(r":param env:.*?:param device:[^\n]*", text, re.S) for text in documents)
    return next(match[0] for match in matches if match)


def signature(keywords: type[Keywords], init: Callable[..., None]) -> inspect.Signature:
    """Return the signature of an agent: the parameters of `init` around the keywords."""
    parameters = list(inspect.signature(init).parameters.values())[1:]  # without self
    kinds = inspect.Parameter
    first = [item for item in parameters if item.kind is kinds.POSITIONAL_OR_KEYWORD]
    last = [item for item in parameters if item.kind is kinds.KEYWORD_ONLY]
    return inspect.Signature([*first, *keywords.parameters(), *last])
