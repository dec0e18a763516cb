"""Counters of agents: the content of a model file besides weights and keywords."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from typing import Any, ClassVar, Self

RENAMED = {"_windows_drawn": "windows_drawn", "_seen_length": "seen_length"}  # since version 0.1


@dataclass(kw_only=True)
class Progress:
    """Counters of an agent. Subclasses add what their algorithm needs to continue exactly.

    A field that is added later needs `field(metadata={"earlier": value})`, the value for model
    files that were written without it.

    :cvar of_weights: counters that are loaded together with the weights
    :ivar num_timesteps: calls of `env.step`, counted once for every environment
    :ivar episodes: episodes that were collected
    :ivar updates: updates that were made for a task
    :ivar credit: collected steps for which no update was made yet
    :ivar windows_drawn: trajectories for which a guidance window was drawn
    :ivar seen_length: steps of the longest trajectory so far
    :ivar cut: trajectories that were stored before their episode ended
    :ivar earlier_steps: steps before `num_timesteps` began at 0 again
    """

    of_weights: ClassVar[tuple[str, ...]] = ()

    num_timesteps: int = 0
    episodes: int = 0
    updates: int = 0
    credit: float = 0.0
    windows_drawn: int = 0
    seen_length: int | None = None
    cut: int = field(default=0, metadata={"earlier": 0})
    earlier_steps: int = field(default=0, metadata={"earlier": 0})

    @classmethod
    def of(cls, saved: Mapping[str, Any]) -> Self:
        """Read the counters of a model file, also of one that version 0.1 wrote.

        :raises ValueError: counters are missing; the message names them
        """
        counters = {RENAMED.get(name, name): value for name, value in saved.items()}
        names = {item.name for item in fields(cls)}
        earlier = {i.name: i.metadata["earlier"] for i in fields(cls) if "earlier" in i.metadata}
        counters = earlier | {name: value for name, value in counters.items() if name in names}
        if missing := names - counters.keys():
            raise ValueError(
                f"The model file lacks {', '.join(sorted(missing))}: it was written by an earlier "
                "version of wpt_agents. Train the model again, or load it with that version"
            )
        return cls(**counters)

    def as_dict(self) -> dict[str, Any]:
        """Return the counters by name, as model files hold them."""
        return asdict(self)

    def state_dict(self) -> dict[str, Any]:
        """Return the counters of the weights, for `get_parameters` of Stable-Baselines3."""
        return {name: getattr(self, name) for name in self.of_weights}

    def load_state_dict(self, state: Mapping[str, Any], strict: bool = True) -> None:
        """Load the result of `state_dict`; counters that it lacks do not change."""
        for name in state.keys() & set(self.of_weights):
            setattr(self, name, state[name])

    def restart_steps(self) -> None:
        """Count the steps from 0 again, without repeating random numbers."""
        self.earlier_steps += self.num_timesteps
        self.num_timesteps = 0

    def reset(self, *names: str) -> None:
        """Set some counters back to their defaults."""
        new = type(self)()
        for name in names:
            setattr(self, name, getattr(new, name))


@dataclass(kw_only=True)
class WorldModelProgress(Progress):
    """Counters of an agent with WPT's networks.

    :ivar pretrain_steps: updates of the world model in pre-training
    :ivar task_updates: updates for the current task
    :ivar initialised: whether a new world model was adapted to its data
    :ivar cloned: whether the prior actor is trained
    """

    of_weights: ClassVar[tuple[str, ...]] = ("cloned",)

    pretrain_steps: int = 0
    task_updates: int = field(default=0, metadata={"earlier": 0})
    initialised: bool = field(default=False, metadata={"earlier": True})
    cloned: bool = False


@dataclass(kw_only=True)
class WPTProgress(WorldModelProgress):
    """Counters of WPT.

    :ivar retrieved_ids: numbers of the retrieved trajectories in the dataset
    :ivar retrieved_of: fingerprint of this dataset
    :ivar adapted: updates of the world model on the retrieved trajectories alone
    :ivar imitated: whether the actor has imitated the prior actor from fixed latent states
    """

    of_weights: ClassVar[tuple[str, ...]] = (*WorldModelProgress.of_weights, "adapted", "imitated")

    retrieved_ids: list[int] = field(default_factory=list)
    retrieved_of: str = ""
    adapted: int = field(default=0, metadata={"earlier": 0})
    imitated: bool = field(default=False, metadata={"earlier": False})
