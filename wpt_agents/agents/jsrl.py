"""JSRL-BC (Uchendu et al., 2022): DrQ-v2 with a behaviour clone that begins each episode.

Source: https://arxiv.org/abs/2204.02372 with random horizons, as in appendix G of the ICLR 2026
version of the WPT paper: the clone acts in the first h steps of an episode, h in {0, 10, .., 100}.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from wpt_agents.agents.drqv2 import DrQv2, DrQv2Keywords
from wpt_agents.model.behavior_cloning import BC_VARIANCES
from wpt_agents.model.prior_policy import PriorPolicy, prior_action
from wpt_agents.model.sizes import SIZES
from wpt_agents.training.cloning import Cloning, clone
from wpt_agents.training.keywords import Stage, amount, choice, count
from wpt_agents.training.rollout import Window

HORIZONS = np.arange(0, 101, 10)  # steps that the clone drives, each equally likely


@dataclass(frozen=True, kw_only=True)
class JSRLKeywords(DrQv2Keywords):
    """The keywords of `JSRL`."""

    sizes_own: ClassVar[Mapping[str, str]] = {
        name: name for name in ("num_retrieve", "bc_steps", "bc_batch_size")
    }
    size_keyword: ClassVar[str] = "bc_size"

    bc_size: str = choice("medium", SIZES, "widths of the clone, a size of WPT", Stage.SIZE)
    num_retrieve: int | None = count(
        None,
        "offline trajectories to use at most; those of `bc_size` if None, 500 for `medium`",
        Stage.RETRIEVAL,
    )
    bc_steps: int | None = count(
        None,
        "updates of the clone; those of `bc_size` if None, 150,000 for `medium`",
        Stage.CLONING,
    )
    bc_batch_size: int | None = count(
        None,
        "images and actions in an update of the clone; those of `bc_size` if None, 256 for "
        "`medium`",
        Stage.CLONING,
    )
    bc_learning_rate: float = amount(
        1e-4, "learning rate of the clone, which falls linearly to 0", Stage.CLONING
    )
    bc_shift: int = count(
        3, "largest random shift of the clone's images, in pixels", Stage.CLONING, least=0
    )
    bc_variance: str = choice(
        "fixed",
        BC_VARIANCES,
        'variance of the clone\'s Gaussian: "fixed", or "trajectory", as in WPT',
        Stage.CLONING,
    )
    warmup_steps: int = count(
        0,
        "first steps, in which the clone acts alone; 0, the default, lets DrQ-v2 act and explore",
        Stage.ACTING,
        least=0,
    )


class JSRL(DrQv2, keywords=JSRLKeywords):
    """DrQ-v2 with a behaviour clone that acts in the first steps of each episode.

    Example::

        model = JSRL("CnnPolicy", "wpt/metaworld-hammer-v0", dataset="data/metaworld")
        model.learn(75_000)

    The clone, which is WPT's prior actor, is trained on trajectories of the task or, if there are
    none, of the robot. The agent learns from the steps of the clone as from its own, but not from
    offline data.

    :param policy: "CnnPolicy"
    """

    saved_as = "JSRL"
    uses_data = True
    hyperparameters: JSRLKeywords
    shape_keywords = (*DrQv2.shape_keywords, "bc_size")

    def widths(self) -> dict[str, Any]:
        """Return the keywords of the policy's constructor, from those of the agent."""
        widths = super().widths()
        return widths | {"clone_size": SIZES[widths.pop("bc_size")]}

    @property
    def wants_data(self) -> bool:
        """Whether offline data are needed: until the clone is trained, and again for other data."""
        return not self.progress.cloned or self.outdated

    def prepare(self, progress_bar: bool) -> None:
        """Train the clone on the offline data, once for a task."""
        super().prepare(progress_bar)
        if self.retrieved is None or self.progress.cloned:
            return
        trained = clone(
            self.policy.prior_actor,
            self.retrieved.trajectories,
            self.policy.action_mask,
            Cloning.of(self.hyperparameters),
            self.streams,
            progress_bar,
        )
        self.policy.prior_actor.load_state_dict(trained.state_dict())
        self.progress.cloned = True
        self.retrieved = None  # gigabytes of images, which nothing reads any more

    def too_late(self, stage: Stage) -> str | None:
        """Return the remedy if keywords of this stage can no longer take effect, else None."""
        if stage in (Stage.RETRIEVAL, Stage.CLONING) and not self.wants_data:
            return "the clone is trained; call reset_task() first"
        return super().too_late(stage)

    @property
    def prior(self) -> PriorPolicy | None:
        """The clone, with `predict`; None before it is trained."""
        return PriorPolicy(self.policy) if self.progress.cloned else None

    @property
    def warmup_driver(self) -> str:
        """What chooses the actions in the warm-up, as words for messages."""
        clones = self.progress.cloned or self.dataset is not None
        return "the clone's actions" if clones else super().warmup_driver

    def guidance_window(self, rng: np.random.Generator) -> Window:
        """Return the steps of a new episode at which the clone acts: 0 .. h - 1, as (0, h)."""
        return (0, int(rng.choice(HORIZONS))) if self.progress.cloned else (0, 0)

    def guide(self, frames: np.ndarray) -> np.ndarray:
        """Return the clone's actions, or random ones without it: (k, F, 64, 64, 3) -> (k, A)."""
        return prior_action(self.policy, frames) if self.progress.cloned else super().guide(frames)
