"""Refuse settings that would have no effect, whose runs would be labelled with them in vain."""

from collections.abc import Collection, Iterable, Sequence
from pathlib import Path

from wpt_agents.agents.wpt import WPT
from wpt_agents.data.dataset import TrajectoryDataset
from wpt_agents.files.model_file import read_header
from wpt_agents.training.hyperparameters import Hyperparameters
from wpt_agents.training.model_files import check_class
from wpt_agents.zoo.plan.methods import AGENTS, METHODS, find_method, sections
from wpt_agents.zoo.plan.presets import Preset, wpt_keywords
from wpt_agents.zoo.plan.shared import given_file, given_for, named
from wpt_agents.zoo.result import Change


def check_effects(
    changes: Iterable[Change], methods: Collection[str], preset: Preset, data: Path | None
) -> None:
    """Raise an error for a setting that affects none of the runs.

    :param changes: the user's
    :param preset: with the changes
    :param data: the user's own dataset, None for the preset's
    """
    for change in changes:
        if reason := why_useless(change, methods, preset, data):
            raise ValueError(f"--set {change} would have no effect: {reason}")


def check_changes(name: str, changes: Sequence[Change]) -> None:
    """Raise an error for a setting that the method overrides or its agent does not accept."""
    method = find_method(name)
    for change in changes:
        section, _, keyword = change.key.rpartition(".")
        if section in ("", "plus", *sections(method.agent)) and keyword in method.keywords:
            raise ValueError(
                f"--method {name} sets {keyword}={method.keywords[keyword]}, so --set {change} "
                "would have no effect: leave it out, or take another --method"
            )
        if method.shared is not None and change.key in wpt_keywords().keys() - set(method.shared):
            raise ValueError(
                f"--method {name} takes only {', '.join(method.shared) or 'none'} of WPT's "
                f"keywords, so --set {change} would have no effect: leave it out"
            )


def why_useless(
    change: Change, methods: Collection[str], preset: Preset, data: Path | None
) -> str | None:
    """Return why a setting affects none of the runs, with the remedy; None if it affects one.

    Settings of data and pre-training are allowed for methods without these stages, because runs
    are compared with those of the same settings.
    """
    section, _, keyword = change.key.rpartition(".")
    chosen = [METHODS[name] for name in methods]
    if section in AGENTS and not any(section in sections(one.agent) for one in chosen):
        return f"the section {section} is not used by --method {' '.join(methods)}; leave it out"
    if section == "plus" and not any(one.plus for one in chosen):
        with_plus = " and ".join(name for name, one in METHODS.items() if one.plus)
        of_wpt = all(one.agent is WPT and keyword not in one.keywords for one in chosen)
        instead = f"write --set {keyword}={change.value}" if of_wpt else "leave it out"
        return f"the section plus is only used by --method {with_plus}; {instead}"
    if section == "collect" and data is not None:
        return f"--data {data} takes the place of the preset's data; leave one of them out"
    if section == "pretrain" and keyword != "model" and trains_none(preset, methods):
        return from_given(preset)
    evaluated = keyword == "during_episodes" or (
        keyword == "keep_best" and preset.evaluate.keep_best
    )
    if section == "evaluate" and evaluated and not preset.evaluate.every:
        return "no evaluations are made during fine-tuning; add --set evaluate.every=FRAMES"
    return None


def trains_none(preset: Preset, methods: Collection[str]) -> bool:
    """Return whether nothing is pre-trained, because a pre-trained model takes its place."""
    pretrained = [METHODS[name] for name in methods if METHODS[name].pretrained]
    return bool(preset.pretrain.model) and all(given_for(preset, one.agent) for one in pretrained)


def from_given(preset: Preset) -> str:
    """Return the reason and the remedy if the preset starts from a pre-trained model."""
    return (
        f"the preset starts from {named(preset.pretrain.model)}; add --set pretrain.model= to "
        "pre-train another"
    )


def check_rewards(methods: Collection[str], data: Path | None) -> None:
    """Raise an error for methods of true rewards without data that hold any.

    :param data: the user's own dataset, None for the preset's, which has no rewards
    """
    for name in methods:
        if METHODS[name].keywords.get("label") != "true":
            continue
        if data is None or not TrajectoryDataset.open(data).info()["with_reward"]:
            raise ValueError(
                f"--method {name} learns from the rewards in the data, and there are none in "
                f"{'the data of a preset' if data is None else f'--data {data}'}: use --data with "
                "rewards, as `collect --rewards` makes them, or --method uds or explore"
            )


def check_given_model(preset: Preset, methods: Collection[str]) -> None:
    """Raise an error for a pre-trained model that does not exist or does not fit the preset."""
    chosen = [METHODS[name] for name in methods]
    if not any(one.pretrained and given_for(preset, one.agent) for one in chosen):
        return
    file = given_file(preset.pretrain.model)
    header = read_header(file)
    check_class(header, file, WPT.saved_as)
    stored = Hyperparameters.of(header["hyperparameters"]).as_dict()
    ours = Hyperparameters.of(preset.wpt).as_dict()
    differ = [key for key in WPT.shape_keywords if ours[key] != stored[key]]
    if differ:
        not_possible = ", ".join(f"{key}={ours[key]}" for key in differ)
        instead = " ".join(f"{key}={stored[key]}" for key in differ)
        raise ValueError(
            f"{not_possible} is not possible: {from_given(preset)}, or write --set {instead} as "
            "in this model"
        )
