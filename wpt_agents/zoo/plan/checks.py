"""Refuse a preset, or data, on which the stages of a run would fail."""

from pathlib import Path

from wpt_envs.rendering import QUALITIES

from wpt_agents.data.dataset import TrajectoryDataset
from wpt_agents.files.names import unknown_name
from wpt_agents.training.hyperparameters import Hyperparameters
from wpt_agents.zoo.collect.collection import BEHAVIOURS
from wpt_agents.zoo.collect.episodes import STATE_CURIOSITY
from wpt_agents.zoo.plan.presets import Preset
from wpt_agents.zoo.tasks import find_tasks


def action_widths(suite: str, preset: Preset, data: Path | None) -> set[int]:
    """Return the numbers of actions that occur in the data."""
    if data is not None:
        return set(TrajectoryDataset.open(data).action_dims)
    return {row.action_dim for row in find_tasks(suite, preset.collect.tasks)}


def check_preset(preset: Preset) -> None:
    """Raise an error for values that have the right type but that the stages do not support."""
    Hyperparameters.of(preset.wpt)
    for name, value, known in (
        ("env.rendering", preset.env.rendering, QUALITIES),
        ("collect.behaviour", preset.collect.behaviour, set(BEHAVIOURS) - {"policy"}),
    ):
        if value not in known:
            raise unknown_name(name, value, known)
    if preset.collect.steps and preset.collect.behaviour != STATE_CURIOSITY:
        raise ValueError(
            f"collect.steps belongs to collect.behaviour={STATE_CURIOSITY}, and has no effect on "
            f"{preset.collect.behaviour!r}: leave it out"
        )


def check_pretraining(suite: str, preset: Preset, data: Path | None) -> None:
    """Raise an error for a preset, or for data, with which no world model can be pre-trained."""
    check_preset(preset)
    widest = max(action_widths(suite, preset, data), default=0)
    limit = Hyperparameters.of(preset.wpt).max_action_dim
    if widest > limit:
        raise too_wide("The data have", widest, limit)


def too_wide(whose: str, widest: int, limit: int, more: str = "") -> ValueError:
    """Return the error for more actions than the model takes.

    :param more: further settings that are needed to change it
    """
    return ValueError(
        f"{whose} {widest} actions, the preset's max_action_dim is {limit}: "
        f"--set max_action_dim={widest}{more}"
    )
