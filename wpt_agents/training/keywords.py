"""Declare each keyword of an agent once: its default, its range, its documentation and its stage.

Example::

    @dataclass(frozen=True, kw_only=True)
    class DrQv2Keywords(Keywords):
        batch_size: int = count(256, "transitions in a batch")
        tau: float = share(0.01, "share by which the target critic moves in an update")

    DrQv2Keywords(tau=2)  # ValueError: tau must be a number in [0, 1], got 2

An agent's signature, attributes, documentation and checks are all derived from these fields, and
its model files hold their values.
"""

import inspect
import math
import textwrap
from collections.abc import Callable, Collection, Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from enum import Enum
from numbers import Integral, Real
from typing import Any, ClassVar, Self

import numpy as np

from wpt_agents.files.names import unknown_name
from wpt_agents.model.sizes import find_size
from wpt_agents.training.guidance import parse_schedule

Check = Callable[[str, Any], None]  # called with a keyword's name and value; raises ValueError


class Stage(Enum):
    """When a keyword is used, and thereby until when it can be changed."""

    SIZE = "size"  # when the networks are made; fixed from then on
    DRAWING = "drawing"  # when weights of heads are drawn: for new networks, and for another task
    PRETRAINING = "pre-training"  # in every update of the world model, also during a task
    RETRIEVAL = "retrieval"  # once for a task, before anything is collected
    CLONING = "cloning"  # once for a task, after retrieval
    TASK = "task"  # in every update for a task
    ACTING = "acting"  # in every step of an environment


@dataclass(frozen=True)
class Keyword:
    """The declaration of a keyword, except its default.

    :param doc: its documentation, without a full stop
    :param stage: when it is used
    :param check: raises ValueError for a value that is not allowed
    """

    doc: str
    stage: Stage
    check: Check


def keyword(default: Any, check: Check, doc: str, stage: Stage = Stage.TASK) -> Any:
    """Declare a keyword by its check. A keyword whose default is None may be None."""
    return field(default=default, metadata={"keyword": Keyword(doc, stage, check)})


def must(words: str, allowed: Callable[[Any], bool]) -> Check:
    """Return a check whose error is "`name` must be `words`, got ..."."""

    def check(name: str, value: Any) -> None:
        if not allowed(value):
            raise ValueError(f"{name} must be {words}, got {value!r}")

    return check


def is_number(value: Any) -> bool:
    """Return whether the value is a finite number; True and False do not count as numbers."""
    return isinstance(value, Real) and not isinstance(value, bool) and math.isfinite(value)


def count(default: int | None, doc: str, stage: Stage = Stage.TASK, least: int = 1) -> Any:
    """Declare a keyword that is a whole number of at least `least`."""

    def allowed(value: Any) -> bool:
        return is_number(value) and isinstance(value, Integral) and int(value) >= least

    return keyword(default, must(f"a whole number of at least {least}", allowed), doc, stage)


def amount(default: float | None, doc: str, stage: Stage = Stage.TASK) -> Any:
    """Declare a keyword that is a number of at least 0."""
    check = must("a number of at least 0", lambda value: is_number(value) and value >= 0)
    return keyword(default, check, doc, stage)


def share(
    default: float | None, doc: str, stage: Stage = Stage.TASK, positive: bool = False
) -> Any:
    """Declare a keyword that is a number from 0 to 1, or above 0 if it must be `positive`."""
    words = "a number above 0 and of at most 1" if positive else "a number in [0, 1]"

    def allowed(value: Any) -> bool:
        return is_number(value) and 0 <= value <= 1 and not (positive and value == 0)

    return keyword(default, must(words, allowed), doc, stage)


def switch(default: bool | None, doc: str, stage: Stage = Stage.TASK) -> Any:
    """Declare a keyword that is True or False."""
    return keyword(
        default, must("True or False", lambda value: isinstance(value, bool)), doc, stage
    )


def choice(default: str, names: Collection[str], doc: str, stage: Stage = Stage.TASK) -> Any:
    """Declare a keyword that is one of several names."""

    def check(name: str, value: Any) -> None:
        if value not in tuple(names):
            raise unknown_name(name, value, names)

    return keyword(default, check, doc, stage)


def schedule(default: str | float | None, most: float, doc: str, stage: Stage = Stage.TASK) -> Any:
    """Declare a keyword that is a number or a schedule of one, as `parse_schedule` reads it."""

    def check(name: str, value: Any) -> None:
        parse_schedule(value, most, name)

    return keyword(default, check, doc, stage)


def plain(value: Any) -> Any:
    """Convert a NumPy number to a Python number, which a model file can store."""
    return value.item() if isinstance(value, np.generic) else value


@dataclass(frozen=True, kw_only=True)
class Keywords:
    """The keywords of every `PixelAgent`. Subclasses add their own and may change defaults.

    :cvar sizes_own: keywords that take a value of the size if they are None, and the fields of
        `Size` with these values
    :cvar size_keyword: the keyword that names the size
    """

    sizes_own: ClassVar[Mapping[str, str]] = {}
    size_keyword: ClassVar[str] = "size"

    embodiment: str | None = keyword(
        None,
        must("a name", lambda value: isinstance(value, str)),
        "name of the robot, which labels the episodes that are collected",
        Stage.ACTING,
    )
    image_key: str | None = keyword(
        None,
        must("a name", lambda value: isinstance(value, str)),
        "the entry of Dict observations that is the image; their only image if None",
        Stage.ACTING,
    )
    learning_starts: int | None = count(
        1_000, "steps that are collected before the first update", Stage.ACTING, least=0
    )
    warmup_steps: int | None = count(
        1_000,
        "number of first steps, in which actions are uniformly random; it ends with an episode",
        Stage.ACTING,
        least=0,
    )
    max_trajectory_length: int = count(
        1_000,
        "steps after which an unfinished episode is stored as a trajectory of its own, so that "
        "long and endless episodes are replayed while they go on. Each part has a guidance window",
        Stage.ACTING,
    )
    train_freq: str = choice(
        "episode",
        ("episode", "step"),
        "when updates are made: 'episode', at the end of each episode, or 'step', while the "
        "environments take the next step. With `SubprocVecEnv`, environments and updates then run "
        "at the same time; the results are the same with `DummyVecEnv`",
        Stage.ACTING,
    )
    seed: int | None = count(
        None, "seed of all random numbers; None: a random seed", Stage.PRETRAINING, least=0
    )

    def __post_init__(self) -> None:
        for item in fields(self):
            value = plain(getattr(self, item.name))
            object.__setattr__(self, item.name, value)  # the dataclass is frozen
            if value is not None or item.default is not None:
                item.metadata["keyword"].check(item.name, value)
        for name in self.sizes_own:
            self.declared()[name].check(name, self.value(name))

    @classmethod
    def declared(cls) -> dict[str, Keyword]:
        """Return the declarations of the keywords by name."""
        return {item.name: item.metadata["keyword"] for item in fields(cls)}

    @classmethod
    def of(cls, values: Mapping[str, Any]) -> Self:
        """Make an instance of keywords by name.

        :raises ValueError: an unknown name, or a value that is not allowed
        """
        for name in values:
            if name not in cls.declared():
                raise unknown_name("keyword", name, cls.declared())
        return cls(**values)

    @classmethod
    def of_stages(cls, *stages: Stage) -> frozenset[str]:
        """Return the names of the keywords that are used at these stages."""
        return frozenset(n for n, declared in cls.declared().items() if declared.stage in stages)

    @classmethod
    def parameters(cls) -> list[inspect.Parameter]:
        """Return the keywords as the parameters of a signature."""
        kind = inspect.Parameter.KEYWORD_ONLY
        return [
            inspect.Parameter(item.name, kind, default=item.default, annotation=item.type)
            for item in fields(cls)
        ]

    @classmethod
    def documentation(cls) -> str:
        """Return a line ":param name: ..." for each keyword, as docstrings have them."""
        lines = [f":param {name}: {declared.doc}" for name, declared in cls.declared().items()]
        return "\n".join(textwrap.fill(line, 96, subsequent_indent="    ") for line in lines)

    def value(self, name: str) -> Any:
        """Return a keyword's value, or that of the size if it is None."""
        value = getattr(self, name)
        if value is None and name in self.sizes_own:
            return getattr(find_size(getattr(self, self.size_keyword)), self.sizes_own[name])
        return value

    def resolved(self) -> Self:
        """Return a copy in which the values of the size replace None."""
        return self.changed(**{name: self.value(name) for name in self.sizes_own})

    def chosen(self) -> dict[str, Any]:
        """Return the keywords that differ from their defaults or depend on the size."""
        chosen = {}
        for item in fields(self):
            value = self.value(item.name)
            if value != item.default or item.name in self.sizes_own:
                chosen[item.name] = value
        return chosen

    def changed(self, **changes: Any) -> Self:
        """Return a copy in which some keywords have other values, which are checked."""
        return replace(self, **changes)

    def as_dict(self) -> dict[str, Any]:
        """Return the values by name, as model files hold them."""
        return asdict(self)


def with_default(keywords: type[Keywords], name: str, default: Any) -> Any:
    """Declare a keyword of a base class again, with another default."""
    declared = keywords.declared()[name]
    return keyword(default, declared.check, declared.doc, declared.stage)
