"""Curiosity: data without a task, by ICM (Pathak 2017) or by disagreement (Plan2Explore).

Example::

    explorer = Plan2Explore("WPTPolicy", env, seed=0, **EXPLORE)
    trajectories = list(explorer.explore(40))

Both are WPT from scratch with the task's reward replaced by a measure of surprise. The actor learns
in imagination, in its own world model, to act where the surprise is large.
"""

import sys
import warnings
from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any, ClassVar

import torch
from torch import Generator, Tensor, nn

from wpt_agents.agents.wpt import WPT
from wpt_agents.data.trajectory import Batch, Trajectory
from wpt_agents.model.curiosity import ICM as ICM
from wpt_agents.model.curiosity import MEMBERS as MEMBERS
from wpt_agents.model.curiosity import Ensemble as Ensemble
from wpt_agents.model.curiosity import Scale as Scale
from wpt_agents.model.curiosity import disagreement as disagreement
from wpt_agents.model.curiosity import ensemble_loss as ensemble_loss
from wpt_agents.model.curiosity import forward_error as forward_error
from wpt_agents.model.curiosity import icm_loss as icm_loss
from wpt_agents.model.layers import frozen
from wpt_agents.model.policy import Dream, WPTPolicy
from wpt_agents.model.rssm import Latent
from wpt_agents.training.hyperparameters import Hyperparameters
from wpt_agents.training.learner import Learner
from wpt_agents.training.randomness import Purpose
from wpt_agents.training.world_model_learner import Metrics, StatesLoss

# Keywords of WPT for exploring: nothing to retrieve, nobody to guide, two random episodes first.
EXPLORE: Mapping[str, Any] = {
    "size": "tiny",
    "batch_size": 8,
    "batch_length": 32,
    "train_ratio": 16,  # an update of 8 x 32 replayed steps every 16 collected ones
    "learning_starts": 1000,
    "warmup_steps": 1000,
    "offline_ratio": 0.0,
    "guidance": 0.0,
    "ent_coef": 0.3,  # with Table 2's 1e-4 the actor narrows to one pose within ten episodes
    "gamma": 0.95,  # few updates are made: look less far ahead than Table 2
    "target_fraction": 0.1,  # and let the target critic follow sooner
}


def with_reward(batch: Batch, curiosity: Tensor, within: Tensor) -> Batch:
    """Return a batch (B, T) whose rewards are curiosity; those of first images are unknown.

    :param curiosity: (B, T - 1), about the images 1 .. T - 1
    :param within: (B, T - 1) bool, False where the image before is of another episode
    """
    reward = torch.zeros_like(batch.reward)
    known = torch.zeros_like(batch.is_first)
    reward[:, 1:] = curiosity * within
    known[:, 1:] = within
    return replace(batch, reward=reward, reward_known=known)


class CuriousLearner(Learner):
    """A learner whose reward is curiosity; `policy.curiosity` is one more network to train."""

    def __init__(self, policy: WPTPolicy, hyperparameters: Hyperparameters) -> None:
        super().__init__(policy, hyperparameters)
        assert isinstance(policy.curiosity, nn.Module)
        parts = [list(policy.curiosity.parameters())]
        self.curiosity_optimizer = self.adam(parts, self.model_rate)

    def configure(self, hyperparameters: Hyperparameters) -> None:
        """Use other hyperparameters from now on; the states of the optimisers are kept."""
        super().configure(hyperparameters)
        self.set_rate(self.curiosity_optimizer, self.model_rate)


class ICMLearner(CuriousLearner):
    """A learner whose reward is the forward model's error on real transitions."""

    def update_world_model(
        self,
        batch: Batch,
        generator: Generator,
        learn_reward: bool = False,
        states_loss: StatesLoss | None = None,
    ) -> tuple[Latent, Batch, Metrics]:
        """Train the curiosity on a batch, then the world model with surprise as the reward."""
        icm = self.policy.curiosity
        assert isinstance(icm, ICM)
        within = ~batch.is_first[:, 1:]
        with self.autocast():
            read, surprise = icm(batch.image, batch.action)
            loss = icm_loss(read, batch.action[:, 1:], surprise, within, icm.forward_share)
        self.descend(self.curiosity_optimizer, loss, "curiosity")
        # seen first, so that the reward is in units that include this batch
        icm.scale.see(surprise[within])
        batch = with_reward(batch, icm.scale(surprise.detach()), within)
        post, rewarded, metrics = super().update_world_model(
            batch, generator, learn_reward, states_loss
        )
        return post, rewarded, metrics | {"explore/surprise": surprise.detach().mean()}


class Plan2ExploreLearner(CuriousLearner):
    """A learner whose reward is the disagreement of an ensemble on where a step leads.

    Rewards belong to the state that a step leads to, as the world model's do: in imagination to the
    states 1 .. H-1, and at the replayed state 0 to the real step that led there, so that the
    critic's value means the same everywhere. The first state of a replayed sequence has reward 0.
    """

    def update_world_model(
        self,
        batch: Batch,
        generator: Generator,
        learn_reward: bool = False,
        states_loss: StatesLoss | None = None,
    ) -> tuple[Latent, Batch, Metrics]:
        """Train the world model without the task's reward, then the ensemble on its states."""
        post, _, metrics = super().update_world_model(batch, generator, states_loss=states_loss)
        ensemble = self.policy.curiosity
        assert isinstance(ensemble, Ensemble)
        within = ~batch.is_first[:, 1:]
        with self.autocast():
            with torch.no_grad():
                embed = self.policy.world_model.encoder(batch.image[:, 1:])
            prediction = ensemble(post.feat[:, :-1], batch.action[:, 1:])
            loss = ensemble_loss(prediction, embed, within)
        self.descend(self.curiosity_optimizer, loss, "curiosity")
        surprise = disagreement(prediction.detach())  # the reward must not train the ensemble
        ensemble.scale.see(surprise[within])
        rewarded = with_reward(batch, ensemble.scale(surprise), within)
        return post, rewarded, metrics | {"explore/surprise": surprise[within].mean()}

    def imagined_reward(self, dream: Dream, arrival: Tensor, step: int) -> Tensor:
        """Return the disagreement of the ensemble on imagined steps, (N, H)."""
        ensemble = self.policy.curiosity
        assert isinstance(ensemble, Ensemble)
        feat = dream.states.feat
        with frozen(ensemble):
            surprise = ensemble.scale(disagreement(ensemble(feat[:, :-2], dream.action[:, :-1])))
        assert len(arrival) == len(surprise), (arrival.shape, surprise.shape)
        return torch.cat([arrival[:, None], surprise], 1)


class Explorer(WPT):
    """WPT from scratch whose reward is curiosity; `policy.curiosity` is saved with the policy."""

    learner_class: ClassVar[type[CuriousLearner]] = CuriousLearner

    def make_policy(self) -> WPTPolicy:
        """Make all networks, the curiosity included."""
        policy = super().make_policy()
        policy.curiosity = self.make_curiosity(policy).to(self.device)
        return policy

    def make_curiosity(self, policy: WPTPolicy) -> nn.Module:
        """Make the network that measures surprise."""
        raise NotImplementedError

    def make_learner(self) -> CuriousLearner:
        """Make the optimisers."""
        return self.learner_class(self.policy, self.hyperparameters)

    def explore(self, episodes: int) -> Iterator[Trajectory]:
        """Collect up to `episodes` episodes in all, learn after each, and yield each.

        An episode depends on the seed and the replay buffer alone. So an explorer continues as if
        it had never stopped after it was loaded and its episodes were added to the replay buffer.
        Episodes end after `max_trajectory_length` steps at the latest.

        :param episodes: the number of episodes in all, including those in the replay buffer
        :return: the episodes with the environment's rewards
        :raises ValueError: no environment, or several
        """
        number = 0 if self.env is None else self.n_envs
        if self.env is None or number != 1:
            raise ValueError(
                f"explore takes one environment, got {number}: call set_env(env) with a single one"
            )
        _, callback = self._setup_learn(
            # no end: `episodes` decides; half, because SB3 adds the steps so far
            sys.maxsize // 2,
            None,
            reset_num_timesteps=False,
            tb_log_name="explore",
        )
        while self.episodes < episodes:
            self.env.seed(self.streams.integer(Purpose.RESET, self.episodes))
            self.begin_episodes()
            with self.operations():
                self.collect(callback, 0)
                self.episodes += self.progress.cut  # the environment is reset here, too
                self.progress.cut = 0
                self.update_models()
            yield self.replay_buffer.trajectories[-1]
        if self.num_timesteps and self.updates_per_step and not self.updates:
            warnings.warn(
                f"explore({episodes}) made no update and so learned nothing: there is none in the "
                f"first learning_starts={self.learning_starts} steps, and it has "
                f"collected {self.num_timesteps}. Explore more episodes, or set "
                "model.learning_starts = 0 and model.warmup_steps = 0 before the call",
                stacklevel=2,
            )


class ICMExplorer(Explorer):
    """Collect data by seeking states that surprise an intrinsic curiosity module (ICM)."""

    saved_as = "ICMExplorer"
    learner_class = ICMLearner

    def make_curiosity(self, policy: WPTPolicy) -> ICM:
        """Make inverse and forward model."""
        return ICM(policy.size, policy.max_action_dim)


class Plan2Explore(Explorer):
    """Collect data by seeking states in which an ensemble of one-step models disagrees."""

    saved_as = "Plan2Explore"
    learner_class = Plan2ExploreLearner

    def make_curiosity(self, policy: WPTPolicy) -> Ensemble:
        """Make the ensemble, which predicts the encoded next image."""
        outputs = policy.world_model.encoder.embed_dim
        return Ensemble(policy.size, policy.max_action_dim, outputs)


EXPLORERS: dict[str, type[Explorer]] = {"icm": ICMExplorer, "plan2explore": Plan2Explore}
