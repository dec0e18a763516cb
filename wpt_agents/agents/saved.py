"""The base of all agents: `ConfiguredAgent`, with model files and copies."""

import warnings
from collections.abc import Iterable, Mapping
from copy import deepcopy
from typing import Any, ClassVar, Self

import torch
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.utils import get_system_info
from torch import Tensor

from wpt_agents.agents.configured import ConfiguredAgent
from wpt_agents.files.model_file import read_model
from wpt_agents.model.actions import space_as_dict, space_from_dict
from wpt_agents.training import model_files
from wpt_agents.training.keywords import Stage


class SavedAgent(ConfiguredAgent):
    """An agent that is saved to model files, loaded from them, and copied."""

    saved_as: ClassVar[str] = ""  # the class that reads the model files, if not the class itself
    shape_keywords: ClassVar[tuple[str, ...]] = ()  # must be equal where weights are loaded

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        optimizers = (f"learner.{name}" for name in model_files.optimizers(self.learner))
        return ["policy", "progress", *optimizers], []

    def save(
        self,
        path: model_files.ModelPath,
        exclude: Iterable[str] | None = None,
        include: Iterable[str] | None = None,
    ) -> None:
        """Write the model file: weights, optimisers, keywords and counters, but no episodes.

        :param path: the file; missing folders are made, and .zip is added where there is no suffix
        :param exclude: ignored; accepted because SB3 has it
        :param include: ignored; accepted because SB3 has it
        :raises OSError: a folder that cannot be written to, or a full disk
        """
        dataset = None if self.dataset is None else str(self.dataset.path)
        header = self.description() | {"dataset": dataset}
        model_files.write(path, header, self.policy, self.learner)

    def description(self) -> dict[str, Any]:
        """Return what a model file says of this agent besides its tensors."""
        return {
            "class": self.saved_as or type(self).__name__,
            "hyperparameters": self.hyperparameters.resolved().as_dict(),
            "action_space": space_as_dict(self.action_space),
            "counters": self.progress.as_dict(),
        }

    @classmethod
    def load(
        cls,
        path: model_files.ModelPath,
        env: GymEnv | str | None = None,
        device: torch.device | str = "auto",
        custom_objects: Mapping[str, Any] | None = None,
        print_system_info: bool = False,
        force_reset: bool = True,
        **kwargs: Any,
    ) -> Self:
        """Read a model file.

        :param path: the path passed to `save`, or the name of a pre-trained world model that comes
            with the library, such as "metaworld-mid"
        :param env: the environment to continue with
        :param device: "auto", "cpu", "cuda", ...
        :param custom_objects: as in SB3, values that replace those in the file; names that are no
            keywords of this agent, such as `lr_schedule`, are ignored
        :param print_system_info: print this system's versions, as SB3 does
        :param force_reset: reset the environment at the next call of `learn`
        :param kwargs: new values for keywords of the constructor, also `dataset`
        :raises ValueError: a file that is cut short, damaged or another agent's; unknown keywords
        :raises FileNotFoundError: no such file; for a folder, the message lists the files in it
        """
        path = model_files.find(path)
        declared = cls.keywords.declared()
        kwargs = {k: v for k, v in (custom_objects or {}).items() if k in declared} | kwargs
        cls.check_keywords(kwargs)
        if print_system_info:
            get_system_info()
        header, tensors = read_model(path)
        model_files.check_class(header, path, cls.saved_as or cls.__name__)
        keywords = {**header["hyperparameters"], **kwargs}
        agent = cls(device=device, _init_setup_model=False, **keywords)
        agent.action_space = space_from_dict(header["action_space"])
        agent._setup_model()
        agent.policy.set_action_space(agent.action_space)
        agent.restore(header, tensors, cls.shape_keywords)
        learner = agent.learner
        if env is not None:
            agent.set_env(env, force_reset)
        if agent.learner is learner:  # no reset, as for actions of another width
            agent.warn_if_late(header, tensors)
        return agent

    def restore(
        self,
        header: Mapping[str, Any],
        tensors: Mapping[str, Mapping[str, Tensor]],
        same: tuple[str, ...],
    ) -> None:
        """Take over the weights, optimisers and counters of a model file, as `read_model` reads it.

        :param same: keywords that must be equal here and in the file
        """
        self._check_same(header, tensors, same)
        progress = self.progress_class.of(header["counters"])
        self._load_tensors(tensors)
        self.progress = progress

    def warn_if_late(
        self, header: Mapping[str, Any], tensors: Mapping[str, Mapping[str, Tensor]]
    ) -> None:
        """Warn of keywords that differ from a model file's and take effect after a reset only."""
        before = self.keywords.of(header["hyperparameters"])
        late = {stage: self.too_late(stage) for stage in (Stage.RETRIEVAL, Stage.CLONING)}
        if model_files.WORLD_MODEL not in tensors:
            late[Stage.DRAWING] = "the weights are loaded; call reset_task() to draw others"
        for name, declared in self.keywords.declared().items():
            value = self.hyperparameters.value(name)
            if value != before.value(name) and (why := late.get(declared.stage)):
                warnings.warn(f"{name}={value!r} has no effect yet: {why}", stacklevel=3)

    def _load_tensors(self, tensors: Mapping[str, Mapping[str, Tensor]]) -> None:
        self.fit_networks(tensors.get("policy", {}))
        model_files.restore(tensors, self.policy, self.learner)

    def fit_networks(self, weights: Mapping[str, Tensor]) -> None:
        """Add or remove the networks that only some models have, before weights are loaded.

        :param weights: by name; none of a file that holds a world model alone
        """

    def _check_same(
        self,
        header: Mapping[str, Any],
        tensors: Mapping[str, Mapping[str, Tensor]],
        names: tuple[str, ...],
    ) -> None:
        if model_files.WORLD_MODEL not in tensors:  # explorers take a world model, too
            kind = self.saved_as or type(self).__name__
            model_files.check_class(header, "The model file", kind)
        # of a `Size` it fills new fields
        trained_with = self.keywords.of(header["hyperparameters"])
        model_files.check_same(trained_with.as_dict(), self.hyperparameters.as_dict(), names)

    def set_parameters(
        self,
        load_path_or_dict: Any,
        exact_match: bool = True,
        device: torch.device | str = "auto",
    ) -> None:
        """Load weights and optimisers in place; counters and keywords stay, also learning rates.

        :param load_path_or_dict: a model file, or what `get_parameters` returns
        :param exact_match: refuse a dictionary that lacks parts of the agent or has others
        :param device: the device of the tensors of a dictionary
        :raises ValueError: a file that is damaged or of another agent, or other parts
        """
        if isinstance(load_path_or_dict, dict):
            self.fit_networks(load_path_or_dict.get("policy", {}))
            # A copy, as torch lets two optimisers share the averages that one hands to the other.
            # Dictionaries of earlier versions lack "progress".
            parameters = {"progress": {}, **deepcopy(load_path_or_dict)}
            super().set_parameters(parameters, exact_match, device)
            self.hyperparameters_changed()  # the optimisers have taken over the dictionary's rates
            return
        header, tensors = read_model(model_files.find(load_path_or_dict))
        self._check_same(header, tensors, self.shape_keywords)
        self._load_tensors(tensors)
        if model_files.WORLD_MODEL not in tensors:
            progress = self.progress_class.of(header["counters"])
            self.progress.load_state_dict(progress.state_dict())

    def __getstate__(self) -> dict[str, Any]:
        """Return what copies and pickles hold: all but environment, open episodes and logger."""
        left_out = {"env", "_vec_normalize_env", "_last_obs", "_resets_seen", "rollout"}
        left_out |= {"after_update"}  # a callback's
        state = {k: None if k in left_out else v for k, v in vars(self).items() if k != "_logger"}
        return state | {"_custom_logger": False}
