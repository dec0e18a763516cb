"""The settings of a run: zoo/<suite>.yaml, merged and validated before any work starts."""

import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, field, is_dataclass
from pathlib import Path
from typing import Any, NamedTuple, Self, get_type_hints

import yaml
from stable_baselines3.common.base_class import BaseAlgorithm

from wpt_agents.agents.base import PixelAgent
from wpt_agents.agents.wpt import WPT
from wpt_agents.files.names import unknown_name
from wpt_agents.model.sizes import Size
from wpt_agents.training.hyperparameters import Hyperparameters
from wpt_agents.zoo.collect.behaviours import EXPLORATION_KEYWORDS
from wpt_agents.zoo.plan.methods import AGENTS, check_types, defaults, sections


@dataclass(frozen=True)
class Section:
    """A part of a preset: a dataclass that rejects unknown keys and wrong types."""

    @classmethod
    def of(cls, title: str, values: Mapping[str, Any]) -> Self:
        """Build the section `title` from the content of a YAML file or --set."""
        types = get_type_hints(cls)
        for key, value in values.items():
            if key not in types:
                raise unknown_name(f"{title} key", key, types)
            if not _fits(value, types[key]):
                if types[key] not in (int, float, str, bool):
                    example = f"--set '{title}.{key}=[NAME, NAME]'"
                    raise ValueError(
                        f"{title}.{key} must be a list of names, got {value!r}: write {example}"
                    )
                name = types[key].__name__
                raise ValueError(f"{title}.{key} must be of type {name}, got {value!r}.")
            if types[key] is int and value < 0:
                raise ValueError(f"{title}.{key} must not be negative, got {value}.")
        return cls(**{k: tuple(v) if isinstance(v, list) else v for k, v in values.items()})


def _fits(value: Any, kind: Any) -> bool:
    """Return whether a YAML value is valid for a field of type `kind`."""
    if kind in (int, float):
        return isinstance(value, (int, kind)) and not isinstance(value, bool)
    if kind in (str, bool):
        return isinstance(value, kind)
    return isinstance(value, (list, tuple)) and all(isinstance(v, str) for v in value)


@dataclass(frozen=True)
class EnvSettings(Section):
    """Settings of the simulation, which are keyword arguments of `gym.make`."""

    action_repeat: int = 2
    rendering: str = "near"


@dataclass(frozen=True)
class CollectSettings(Section):
    """The non-curated data: `episodes` of each of `tasks`, played by a behaviour of `collect`.

    `steps` are those of the behaviour "explore-state"; 0 is its default.
    """

    tasks: tuple[str, ...] = ()
    episodes: int = 30
    seed: int = 0
    behaviour: str = "noise"
    steps: int = 0

    def as_dict(self) -> dict[str, Any]:
        """Return the settings that the data depend on, with a list of tasks."""
        values = asdict(self) | {"tasks": list(self.tasks)}
        return {k: v for k, v in values.items() if k != "steps" or v}  # names of older data


@dataclass(frozen=True)
class PretrainSettings(Section):
    """Pre-training of the world model, the same for every seed of a run.

    `model` is a pre-trained model of WPT: the path of a file, or the name of one that comes with
    the library. `model=` (empty) trains a new one with `steps` updates.
    """

    steps: int = 200_000
    seed: int = 0
    model: str = ""


@dataclass(frozen=True)
class LearnSettings(Section):
    """Fine-tuning; frames are simulator frames, `env.step` calls times the action repeat.

    A killed run resumes from the last checkpoint: there is one every `checkpoint_every` frames, and
    every ten minutes if these take longer. 0: only from the end.
    With `train_freq: step` the environment has its own process and steps during the updates;
    `overlap: false` keeps it in the learner's process, with the same results.
    """

    frames: int = 150_000
    checkpoint_every: int = 10_000
    overlap: bool = True


@dataclass(frozen=True)
class EvaluateSettings(Section):
    """Evaluation: `episodes` at the end, and `during_episodes` every `every` frames (0: never).

    With `keep_best`, the best policy of these evaluations and the last one are scored at the end,
    on other episodes.
    """

    episodes: int = 10
    every: int = 0
    during_episodes: int = 5
    keep_best: bool = False


@dataclass(frozen=True)
class Preset:
    """All settings of a run, except task, method and seed.

    :param wpt: keyword arguments of WPT
    :param plus: additional ones of the methods `wpt+` and `scratch`: additions to the paper
    :param agents: the keyword arguments of other agents, by the names of `methods.AGENTS`
    """

    env: EnvSettings = EnvSettings()
    collect: CollectSettings = CollectSettings()
    pretrain: PretrainSettings = PretrainSettings()
    learn: LearnSettings = LearnSettings()
    evaluate: EvaluateSettings = EvaluateSettings()
    wpt: dict[str, Any] = field(default_factory=dict)
    plus: dict[str, Any] = field(default_factory=dict)
    agents: dict[str, dict[str, Any]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        counts = {
            "env.action_repeat": self.env.action_repeat,
            "collect.episodes": self.collect.episodes,
            "pretrain.steps": self.pretrain.steps,
            "evaluate.episodes": self.evaluate.episodes,
            "evaluate.during_episodes": self.evaluate.during_episodes,
        }
        for name, count in counts.items():
            if count < 1:
                raise ValueError(f"{name} must be at least 1, got {count}.")
        if self.steps < 1:
            raise ValueError(
                "learn.frames / env.action_repeat must be at least 1, got "
                f"{self.learn.frames} / {self.env.action_repeat}."
            )
        for key in {**self.wpt, **self.plus}:
            if key not in wpt_keywords():
                raise unknown_name("WPT keyword", key, wpt_keywords())
        for name, section in self.agents.items():
            for key in section:
                if key not in defaults(AGENTS[name]):
                    raise unknown_name(f"{name} keyword", key, defaults(AGENTS[name]))
            if not issubclass(AGENTS[name], PixelAgent):
                check_types(AGENTS[name], section)

    def of_agent(self, agent: type[BaseAlgorithm]) -> dict[str, Any]:
        """Return the keywords in an agent's sections."""
        return {k: v for name in sections(agent) for k, v in self.agents.get(name, {}).items()}

    @classmethod
    def of(cls, values: Mapping[str, Mapping[str, Any]]) -> Self:
        """Build a preset from the sections of a YAML file."""
        types = get_type_hints(cls)
        for title, section in values.items():
            if title not in {*types, *AGENTS} - {"agents"}:
                raise unknown_name("section", title, {*types, *AGENTS} - {"agents"})
            if not isinstance(section, Mapping):
                raise ValueError(f"Section {title!r} must hold keys and values, got {section!r}.")
        keywords = {t: dict(values.get(t, {})) for t in ("wpt", "plus")}
        agents = {t: dict(s) for t, s in values.items() if t in AGENTS}
        typed = {t: types[t].of(t, s) for t, s in values.items() if t not in {*keywords, *AGENTS}}
        return cls(**typed, wpt=keywords["wpt"], plus=keywords["plus"], agents=agents)

    @property
    def steps(self) -> int:
        """The number of `env.step` calls in `learn.frames` simulator frames."""
        return self.learn.frames // self.env.action_repeat

    @property
    def size(self) -> str | Size | Mapping[str, Any]:
        """The size of WPT's networks."""
        return Hyperparameters.of(self.wpt).size

    def as_dict(self) -> dict[str, Any]:
        """Return plain dictionaries and lists, as in `config.yaml`."""
        values = asdict(self)
        del values["plus"]  # a run's `wpt` contains the part that applies
        del values["agents"]  # a run's own section contains its agent's keywords
        return values | {"collect": self.collect.as_dict()}


def wpt_keywords() -> Mapping[str, Any]:
    """Return the keyword arguments of WPT that a preset may set, with their defaults."""
    return defaults(WPT)


# PyYAML's loader in C, where it was built, is ten times as fast. Both are safe.
_SafeLoader: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


class _Loader(_SafeLoader):  # type: ignore[misc]
    """A safe YAML loader that reads 1e-4 as a number, which YAML 1.1 reads as text."""


_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"^[-+]?[0-9][0-9_]*(\.[0-9_]*)?[eE][-+]?[0-9]+$"),
    list("-+0123456789"),
)


def read_yaml(text: str) -> Any:
    """Return the value of a YAML document without running any code."""
    return yaml.load(text, Loader=_Loader)  # a safe one


def preset_folder() -> Path:
    """Return the folder of YAML files: zoo/ in a checkout, wpt_agents/zoo/presets in a wheel."""
    here = Path(__file__).resolve().parents[1]
    for folder in (here / "presets", here.parents[1] / "zoo"):
        if any(folder.glob("*.yaml")):
            return folder
    raise ValueError(f"No presets beside {here}: the installation is incomplete, reinstall it.")


def suite_names() -> list[str]:
    """Return the suites that have presets."""
    return sorted(path.stem for path in preset_folder().glob("*.yaml"))


def preset_names(suite: str) -> list[str]:
    """Return the names of a suite's presets, in the order of its file."""
    return list(_read_suite(suite).presets)


def default_preset(suite: str) -> str:
    """Return the preset of a suite's runs if the user names none."""
    return "demo" if "demo" in preset_names(suite) else "tiny"


class SuiteFile(NamedTuple):
    """The content of zoo/<suite>.yaml."""

    default: Mapping[str, Any]
    presets: Mapping[str, Any]


def _read_suite(suite: str) -> SuiteFile:
    if suite not in suite_names():
        raise unknown_name("suite with presets", suite, suite_names())
    path = preset_folder() / f"{suite}.yaml"
    try:
        content = read_yaml(path.read_text(encoding="utf-8"))
    except yaml.YAMLError as error:
        raise ValueError(f"{path} is not valid YAML: {error}") from None
    if not isinstance(content, dict) or set(content) != {"default", "presets"}:
        raise ValueError(f"{path} must have the two sections `default` and `presets`.")
    return SuiteFile(**content)


def load_preset(
    suite: str,
    name: str,
    settings: Sequence[str] = (),
    changes: Sequence[Mapping[str, Mapping[str, Any]]] = (),
) -> Preset:
    """Return the preset `name` of `suite`, changed by `changes` and then by `settings`.

    :param settings: each "section.key=value", or "key=value" for a keyword of WPT, also in `plus`
    :param changes: sections in the form of the YAML files
    """
    content = _read_suite(suite)
    if name not in content.presets:
        raise unknown_name(f"{suite} preset", name, content.presets)
    values: dict[str, dict[str, Any]] = {}
    parts = content.default, content.presets[name] or {}, *changes, *map(_setting, settings)
    for i, part in enumerate(parts):
        for title, section in part.items():
            values[title] = {**values.get(title, {}), **(section or {})}
            if title == "wpt" and i >= len(parts) - len(settings):  # what the user sets comes first
                for key in section:
                    values.get("plus", {}).pop(key, None)
    return Preset.of(values)


def keywords(settings: Sequence[str], valid: Collection[str] | None = None) -> dict[str, Any]:
    """Return keywords from strings "key=value".

    :param valid: valid names; those of WPT if None
    :raises ValueError: if a name is unknown
    """
    names = wpt_keywords() if valid is None else valid
    values: dict[str, Any] = {}
    for title, section in (pair for text in settings for pair in _setting(text).items()):
        for name in section:
            if title != "wpt" or name not in names:
                raise unknown_name("keyword for --set", name, names)
        values |= section
    return values


def _setting(text: str) -> dict[str, dict[str, Any]]:
    """Read 'learn.frames=1000' as {'learn': {'frames': 1000}}; keys without a dot are WPT's."""
    key, equals, value = text.partition("=")
    if not equals or not key.strip():
        raise ValueError(f"--set takes key=value, got {text!r}.")
    title, dot, key = key.strip().rpartition(".")
    if not dot and key not in {*wpt_keywords(), *EXPLORATION_KEYWORDS}:
        types = get_type_hints(Preset)
        dotted = {
            f"{t}.{k}" for t, s in types.items() if is_dataclass(s) for k in get_type_hints(s)
        }
        dotted |= {f"{name}.{k}" for name, agent in AGENTS.items() for k in defaults(agent)}
        # Hundreds of keys would hide the hint; one with a wrong KEY lists those of its section.
        sections = {f"{name.partition('.')[0]}.KEY" for name in dotted}
        valid = wpt_keywords()
        raise unknown_name("key for --set", key, {*valid, *dotted}, {*valid, *sections})
    try:
        return {title or "wpt": {key: read_yaml(value) if value.strip() else ""}}
    except yaml.YAMLError:
        raise ValueError(f"--set {key}: {value!r} is not a valid YAML value.") from None
