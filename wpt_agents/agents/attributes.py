"""Keywords and counters, declared once in dataclasses, as an agent's attributes and signature."""

import inspect
import re
from collections.abc import Callable, Mapping
from dataclasses import fields
from typing import TYPE_CHECKING, Any, ClassVar

from stable_baselines3.common.base_class import BaseAlgorithm

from wpt_agents.files.names import unknown_name
from wpt_agents.training.keywords import Keywords, Stage
from wpt_agents.training.progress import Progress
from wpt_agents.training.randomness import Streams


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


class KeywordAgent(BaseAlgorithm):
    """An SB3 algorithm whose keywords are `hyperparameters` and whose counters are `progress`.

    A subclass names their classes: `class DrQv2(PixelAgent, keywords=DrQv2Keywords)`.
    """

    keywords: ClassVar[type[Keywords]] = Keywords
    progress_class: ClassVar[type[Progress]] = Progress
    hyperparameters: Any  # of the class `keywords`
    progress: Any  # of the class `progress_class`
    streams: Streams
    # Counters of `progress`, which are attributes, too.
    num_timesteps: int
    episodes: int
    updates: int
    credit: float

    def __init_subclass__(
        cls,
        keywords: type[Keywords] | None = None,
        progress: type[Progress] | None = None,
        **kwargs: Any,
    ) -> None:
        super().__init_subclass__(**kwargs)
        cls.keywords = keywords or cls.keywords
        cls.progress_class = progress or cls.progress_class
        declare(cls, cls.keywords, cls.progress_class, cls.__init__)

    if TYPE_CHECKING:  # keywords are attributes

        def __getattr__(self, name: str) -> Any: ...

    def __repr__(self) -> str:
        """The keywords that differ from their defaults, those that the size decides, and counts."""
        chosen = ", ".join(f"{k}={v!r}" for k, v in self.hyperparameters.chosen().items())
        counted = f"num_timesteps={self.num_timesteps}, updates={self.updates}"
        return f"<{type(self).__name__}({chosen}), {counted}>"

    def change_hyperparameter(self, name: str, value: Any) -> None:
        """Set a keyword, as `model.gamma = 0.98` does. It takes effect at once and is saved.

        :raises ValueError: a value that is not allowed, or one that can no longer take effect
        """
        changed = self.hyperparameters.changed(**{name: value})
        if changed == self.hyperparameters:
            return
        stage = self.keywords.declared()[name].stage
        if remedy := self.too_late(stage):
            raise ValueError(f"{name}={value!r} can no longer take effect: {remedy}")
        before = self.hyperparameters
        self.hyperparameters = changed
        try:
            self.hyperparameters_changed()
        except ValueError:
            self.hyperparameters = before
            raise
        if name == "seed":
            self.set_random_seed(changed.seed)

    def too_late(self, stage: Stage) -> str | None:
        """Return the remedy if keywords of this stage can no longer take effect, else None."""
        if stage in (Stage.SIZE, Stage.DRAWING):
            return f"the networks are made; make a new {type(self).__name__} with it"
        return None

    def hyperparameters_changed(self) -> None:
        """Bring what was made from `self.hyperparameters` up to date; ValueError refuses them."""

    def set_random_seed(self, seed: int | None = None) -> None:
        """Seed everything that is drawn from now on, and the environment's next reset."""
        if seed is not None:
            self.hyperparameters = self.hyperparameters.changed(seed=seed)
            self.streams = Streams(seed)
        super().set_random_seed(seed)

    @classmethod
    def check_keywords(cls, kwargs: Mapping[str, Any]) -> None:
        """Refuse keywords that the constructor does not have, with the nearest ones."""
        valid = set(inspect.signature(cls).parameters) - {"_init_setup_model"}
        for name in kwargs:
            if name not in valid:
                raise unknown_name("keyword", name, valid)


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
    """Return the documentation of `env` and all else that every agent takes, from a base class."""
    documents = (base.__doc__ or "" for base in agent.__mro__[1:])
    matches = (re.search(r":param env:.*?:param device:[^\n]*", text, re.S) for text in documents)
    return next(match[0] for match in matches if match)


def signature(keywords: type[Keywords], init: Callable[..., None]) -> inspect.Signature:
    """Return the signature of an agent: the parameters of `init` around the keywords."""
    parameters = list(inspect.signature(init).parameters.values())[1:]  # without self
    kinds = inspect.Parameter
    first = [item for item in parameters if item.kind is kinds.POSITIONAL_OR_KEYWORD]
    last = [item for item in parameters if item.kind is kinds.KEYWORD_ONLY]
    return inspect.Signature([*first, *keywords.parameters(), *last])
