"""The common base of DrQ-v2, RLPD and MR.Q: stacked frames, n-step batches and offline data."""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import numpy as np
from gymnasium import spaces

from wpt_agents.agents.base import PixelAgent
from wpt_agents.data.bars import shown
from wpt_agents.data.convert import Data
from wpt_agents.data.dataset import TrajectoryDataset
from wpt_agents.data.related import related_trajectories
from wpt_agents.data.replay import ReplayBuffer
from wpt_agents.data.transitions import Transitions, draw_transitions
from wpt_agents.data.units import compare_units, in_units_of
from wpt_agents.model.frame_policy import FramePolicy
from wpt_agents.training.checks import check_images
from wpt_agents.training.keywords import (
    Keywords,
    Stage,
    amount,
    choice,
    count,
    keyword,
    must,
    share,
    with_default,
)
from wpt_agents.training.model_files import optimizers
from wpt_agents.training.progress import Progress
from wpt_agents.training.randomness import Purpose


@dataclass(frozen=True, kw_only=True)
class FrameKeywords(Keywords):
    """The keywords that DrQ-v2, RLPD and MR.Q have in common."""

    learning_rate: float = amount(1e-4, "learning rate of all networks")
    batch_size: int = count(256, "transitions in a batch")
    gamma: float = share(0.99, "discount of one step")
    update_every: int = count(1, "collected steps per update")
    pad: int = count(4, "largest random shift of the images, in pixels", least=0)
    task: str | None = keyword(
        None,
        must("a name", lambda value: isinstance(value, str)),
        "name of the task in the dataset; the environment's id if None. Offline data are the "
        "trajectories of this task, or else of the robot `embodiment`",
        Stage.RETRIEVAL,
    )
    num_retrieve: int | None = count(500, "offline trajectories to use at most", Stage.RETRIEVAL)
    learning_starts: int = with_default(Keywords, "learning_starts", 2_000)
    warmup_steps: int = with_default(Keywords, "warmup_steps", 2_000)
    train_freq: str = choice(
        "step",
        ("episode", "step"),
        "when updates are made: 'step', while the environments take the next step, or 'episode', "
        "at the end of each",
        Stage.ACTING,
    )


@dataclass(kw_only=True)
class FrameProgress(Progress):
    """Counters of a `FrameAgent`, and the offline data that it uses.

    :ivar retrieved_ids: numbers of the offline trajectories
    :ivar retrieved_of: the fingerprint of the dataset that these numbers refer to
    :ivar cloned: whether the prior actor has been trained
    """

    of_weights: ClassVar[tuple[str, ...]] = ("cloned",)

    retrieved_ids: list[int] = field(default_factory=list)
    retrieved_of: str = ""
    cloned: bool = False


class FrameAgent(PixelAgent, keywords=FrameKeywords, progress=FrameProgress):
    """An agent that learns from transitions of stacked frames."""

    policy: FramePolicy
    hyperparameters: FrameKeywords
    progress: FrameProgress
    retrieved: ReplayBuffer | None = None
    uses_data: ClassVar[bool] = True  # whether there is any use for the keyword `dataset`

    def make_policy(self) -> Any:
        """Make the networks, as wide as the environment's actions."""
        policy: Any = self.policy_class(self.observation_space, self.action_space, **self.widths())
        policy.std = self.std_now
        return policy

    def widths(self) -> dict[str, Any]:
        """Return the keywords of the policy's constructor, from those of the agent."""
        return {name: getattr(self.hyperparameters, name) for name in self.shape_keywords}

    def unbound_action_space(self) -> spaces.Box:
        """Return the action space of an agent without an environment; `set_env` replaces it."""
        return spaces.Box(-1.0, 1.0, (1,), np.float32)

    @property
    def updates_per_step(self) -> float:
        """The number of updates for each collected step."""
        return 1 / self.hyperparameters.update_every

    @property
    def std_now(self) -> float:
        """The standard deviation σ of the noise on actions at the current step, 0 for none."""
        return 0.0

    def before_step(self) -> None:
        """Explore with the noise of this step."""
        self.policy.std = self.std_now

    def restore(self, *args: Any) -> None:
        """Restore a model file, and set the noise of the step at which it was written."""
        super().restore(*args)
        self.policy.std = self.std_now

    @property
    def offline_rewards(self) -> bool:
        """Whether the rewards of offline data are used."""
        return False

    @property
    def wants_data(self) -> bool:
        """Whether offline data are used at all."""
        return False

    def cheaper_updates(self, steps: int) -> str:
        """Return a line of code that makes `steps` collected steps enough for an update."""
        return f"model.update_every = {max(steps, 1)}"

    def check_data(self, dataset: TrajectoryDataset) -> None:
        """Raise a ValueError for an empty dataset, or for images that are not 64 x 64."""
        check_images(dataset)

    def check_units(self) -> None:
        """Warn if the environment's actions are in other units than those of the dataset."""
        if self.wants_data and self.dataset is not None and self.env is not None:
            compare_units(self.dataset, self.action_space, self.hyperparameters.embodiment)

    def set_dataset(self, dataset: Data | None) -> None:
        """Use another dataset; the next call of `learn` chooses the offline data from it.

        Until then, the agent uses those of the previous dataset.

        :param dataset: any kind that the keyword `dataset` takes; None changes nothing
        :raises ValueError: something that is no dataset, or data that the agent cannot learn from
        """
        if dataset is not None and not self.uses_data:
            warnings.warn(
                f"{type(self).__name__} learns from its environment alone, so dataset= has no "
                "effect: leave it out, or take RLPD or JSRL, which use offline data",
                stacklevel=3,
            )
        super().set_dataset(dataset)

    def prepare(self, progress_bar: bool) -> None:
        """Choose and read the offline data, if any are used."""
        if not self.wants_data or (self.retrieved is not None and not self.outdated):
            return
        if self.dataset is None:
            warnings.warn(
                f"{type(self).__name__} learns without offline data: pass dataset=", stacklevel=3
            )
            return
        if self.progress.retrieved_of != self.dataset.fingerprint:
            self.progress.retrieved_ids = self._related()
            self.progress.retrieved_of = self.dataset.fingerprint
            self.progress.cloned = False
            self.retrieved = None  # those of before, also if the reading below is interrupted
        retrieved = ReplayBuffer()
        chosen = self.dataset.subset(self.progress.retrieved_ids)
        read = in_units_of(chosen, self.action_space)
        for trajectory in shown(read, len(chosen), "retrieve", progress_bar):
            if self.offline_rewards and trajectory.reward is None:
                raise ValueError(
                    f"The dataset {self.dataset.path} holds trajectories without rewards, which "
                    "label='true' needs: pass label='zero' or label='optimistic'"
                )
            if not self.offline_rewards:
                # Another task may end elsewhere, so terminations count as little as rewards do.
                trajectory = replace(trajectory, reward=None, terminated=False)
            retrieved.add(trajectory)
        self.retrieved = retrieved  # all of them, or none if reading was interrupted

    @property
    def outdated(self) -> bool:
        """Whether the chosen offline data are of another dataset than the current one."""
        progress = self.progress
        other = self.dataset is not None and self.dataset.fingerprint != progress.retrieved_of
        return bool(progress.retrieved_ids) and other

    @property
    def chosen(self) -> bool:
        """Whether offline data of the current dataset are chosen, read or not."""
        return bool(self.progress.retrieved_ids) and not self.outdated

    def _related(self) -> list[int]:
        assert self.dataset is not None and self.env is not None
        settings, task = self.hyperparameters, self.hyperparameters.task
        if task is None and self.env.has_attr("spec"):
            task = getattr(self.env.get_attr("spec")[0], "id", None)
        return related_trajectories(
            self.dataset,
            task,
            settings.embodiment,
            self.policy.action_dim,
            settings.value("num_retrieve"),
            self.streams.numpy(Purpose.RETRIEVE, 0),
        )

    def seen(self, replay: ReplayBuffer) -> Sequence[np.ndarray] | None:
        """Return what a batch contains instead of the episodes' images, or None for the images."""
        return None

    def draw(
        self,
        replay: ReplayBuffer,
        size: int,
        n_steps: int,
        stream: int = 0,
        tails: bool = False,
    ) -> Transitions:
        """Draw the batch of the next update from some episodes, with randomly shifted images.

        :param replay: the episodes
        :param size: N, the number of transitions
        :param n_steps: n, the number of rewards in a target
        :param stream: another number for each batch of the same update
        :param tails: see `draw_transitions`
        """
        rng = self.batch_rng(stream)
        settings = self.hyperparameters
        shape = size, n_steps, settings.gamma, self.policy.action_dim
        seen = self.seen(replay)
        pad = settings.pad if seen is None else 0  # features cannot be shifted
        batch = draw_transitions(replay.trajectories, *shape, rng, pad=pad, seen=seen, tails=tails)
        return batch.to(self.device)

    def batch_rng(self, stream: int) -> np.random.Generator:
        """Return the random numbers of a batch of the next update.

        :param stream: another number for each batch of the same update
        """
        # Not from `Streams`: RLPD draws two batches in an update, each with a number of its own.
        return np.random.default_rng([self.streams.seed, int(Purpose.UPDATE), self.updates, stream])

    def hyperparameters_changed(self) -> None:
        """Pass the keywords to learner and policy, and the learning rate to the optimisers."""
        self.learner.settings = self.hyperparameters
        self.policy.std = self.std_now
        for optimizer in optimizers(self.learner).values():
            for group in optimizer.param_groups:
                group["lr"] = self.hyperparameters.learning_rate

    def too_late(self, stage: Stage) -> str | None:
        """Return the remedy if keywords of this stage can no longer take effect, else None."""
        if stage is Stage.RETRIEVAL and self.chosen:
            return "the offline data are chosen; call reset_task() first"
        return super().too_late(stage)

    def reset_task(self) -> None:
        """Discard the episodes and the offline data, and initialise all networks again."""
        self.retrieved = None
        self.progress.reset("retrieved_ids", "retrieved_of", "cloned")
        super().reset_task()
