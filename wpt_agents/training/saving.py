"""Model files of WPT: save, load, and the replay buffer's file. No pickle.

`WPT` inherits `Saving`, so that `wpt.py` holds the algorithm and this module its files.
"""

import inspect
import os
from collections.abc import Callable, Iterable, Mapping
from io import BufferedIOBase
from pathlib import Path
from typing import Any, ClassVar, Self

import torch
from gymnasium import spaces
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.utils import get_system_info
from torch import Tensor

from wpt_agents.data.dataset import TrajectoryDataset
from wpt_agents.data.replay import ReplayBuffer
from wpt_agents.files.model_file import load_optimizer, optimizer_tensors, read_model, write_model
from wpt_agents.files.names import unknown_name
from wpt_agents.model.actions import space_as_dict, space_from_dict
from wpt_agents.model.policy import WPTPolicy

COUNTERS = (  # where a model stands, besides its weights
    "pretrain_steps",
    "num_timesteps",
    "episodes",
    "updates",
    "credit",
    "cloned",
    "retrieved_ids",
    "retrieved_of",
    "_windows_drawn",
    "_seen_length",
    "initialised",
    "task_updates",
)
LATER = {
    "initialised": True,
    "task_updates": 0,
}  # counters that version 0.1 did not write, and their values there


class Saving:
    """What of a model is written to its file, and how it is read back."""

    saved_as: ClassVar[str] = "WPT"  # whose networks a file holds

    __init__: Callable[..., None]
    set_env: Callable[..., None]
    hyperparameters: dict[str, Any]
    action_space: spaces.Box
    dataset: TrajectoryDataset | None
    policy: WPTPolicy
    replay_buffer: ReplayBuffer

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        return ["policy", "model_optimizer", "actor_optimizer", "critic_optimizer"], []

    def save(
        self,
        path: str | os.PathLike[str] | BufferedIOBase,
        exclude: Iterable[str] | None = None,
        include: Iterable[str] | None = None,
    ) -> None:
        """Writes the model file: weights, optimisers, settings and counters; no replay, no data.

        :param path: `.zip` is added when there is no suffix
        :param exclude: accepted for SB3's sake; nothing optional is in the file
        :param include: likewise
        """
        if isinstance(path, str | os.PathLike) and not Path(path).suffix:
            path = Path(path).with_suffix(".zip")
        about = {
            "class": self.saved_as,
            "hyperparameters": self.hyperparameters,
            "action_space": space_as_dict(self.action_space),
            "dataset": str(self.dataset.path) if self.dataset is not None else None,
            "counters": {name: getattr(self, name) for name in COUNTERS},
        }
        optimizers = self._get_torch_save_params()[0][1:]
        weights = self.policy.state_dict()
        tensors = {"policy": {k.replace("_orig_mod.", ""): w for k, w in weights.items()}}
        tensors |= {name: optimizer_tensors(getattr(self, name)) for name in optimizers}
        write_model(path, about, tensors)

    @classmethod
    def load(
        cls,
        path: str | os.PathLike[str] | BufferedIOBase,
        env: GymEnv | str | None = None,
        device: torch.device | str = "auto",
        custom_objects: Mapping[str, Any] | None = None,
        print_system_info: bool = False,
        force_reset: bool = True,
        **kwargs: Any,
    ) -> Self:
        """Reads a model file onto any environment of at most `max_action_dim` actions.

        :param path: as given to `save`
        :param env: the environment to go on with
        :param custom_objects: accepted for SB3's sake
        :param print_system_info: print this system's versions, as SB3 does
        :param kwargs: keywords of `WPT` to change; `dataset=` for rehearsal and guidance
        :raises ValueError: a file that is cut short, damaged or not ours; an unknown keyword
        :raises FileNotFoundError: there is none; in a folder, says which ones it holds
        """
        if isinstance(path, str | os.PathLike):
            path = _model_file(Path(path))
        cls._check_keywords(kwargs)
        if print_system_info:
            get_system_info()
        about, tensors = read_model(path)
        if (kind := about.get("class", cls.saved_as)) != cls.saved_as:
            raise ValueError(
                f"{path} is of {kind}: read it by {kind}.load, not {cls.__name__}.load"
            )
        model: Self = cls(device=device, **{**about["hyperparameters"], **kwargs})
        model.action_space = space_from_dict(about["action_space"])
        model.policy.set_action_space(model.action_space)
        model._take(about, tensors, ("size", "max_action_dim"))
        if env is not None:
            model.set_env(env, force_reset)
        return model

    def _take(
        self,
        about: Mapping[str, Any],
        tensors: Mapping[str, dict[str, Tensor]],
        same: Iterable[str],
    ) -> None:
        for name in same:
            was, now = about["hyperparameters"][name], self.hyperparameters[name]
            if was != now:
                raise ValueError(
                    f"The model was trained with {name}={was!r}, now it is {now!r}; "
                    "give the old value, or another model file or run_dir"
                )
        self.policy.load_state_dict(tensors["policy"])
        for name in self._get_torch_save_params()[0][1:]:
            load_optimizer(getattr(self, name), tensors[name])
        counters = LATER | about["counters"]
        missing = set(COUNTERS) - counters.keys()
        if missing:
            raise ValueError(
                f"The model file lacks {', '.join(sorted(missing))}: it was written by an earlier "
                "wpt_agents; train it again, or load it with the version that wrote it"
            )
        for name in COUNTERS:
            setattr(self, name, counters[name])

    def save_replay_buffer(self, path: str | os.PathLike[str]) -> None:
        """Writes the online episodes to one file."""
        self.replay_buffer.save(path)

    def load_replay_buffer(self, path: str | os.PathLike[str]) -> None:
        """Reads what `save_replay_buffer` wrote."""
        self.replay_buffer = ReplayBuffer.load(path)

    @classmethod
    def _check_keywords(cls, kwargs: Mapping[str, Any]) -> None:
        valid = set(inspect.signature(cls).parameters) - {"_init_setup_model"}
        for name in kwargs:
            if name not in valid:
                raise unknown_name("keyword", name, valid)


def _model_file(path: Path) -> Path:
    """With the suffix that `save` adds where there is none."""
    file = path if path.suffix else path.with_suffix(".zip")
    if path.is_dir() and not file.is_file():
        held = ", ".join(sorted(each.name for each in path.glob("*.zip"))) or "no model file"
        raise FileNotFoundError(f"{path} is a folder, which holds {held}: give the file to load")
    return file
