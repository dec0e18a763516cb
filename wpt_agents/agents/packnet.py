"""PackNet (Mallya and Lazebnik, 2018): one network for a sequence of tasks, by pruning.

Source: https://arxiv.org/abs/1711.05769, with the equal shares and the frozen biases of Continual
World (https://arxiv.org/abs/2105.10919). After each task the smallest weights are freed for the
tasks to come, and the others are trained a little more and then never changed again.
"""

from collections import defaultdict
from collections.abc import Iterator, Mapping
from copy import deepcopy
from dataclasses import dataclass
from math import inf
from typing import Any, ClassVar

import torch
from stable_baselines3.common.policies import BasePolicy
from torch import Tensor, nn
from torch.optim import Optimizer

from wpt_agents.agents.drqv2 import Critic, DrQv2, DrQv2Keywords, DrQv2Learner, DrQv2Policy
from wpt_agents.agents.frame_agent import FrameProgress
from wpt_agents.data.bars import shown
from wpt_agents.data.replay import ReplayBuffer
from wpt_agents.model.frames import orthogonal
from wpt_agents.training.descent import take_step
from wpt_agents.training.keywords import Stage, count, share
from wpt_agents.training.randomness import Purpose

FREE = -1  # the owner of weights that the present task trains


def prune(weight: Tensor, owner: Tensor, task: int, tasks_left: int) -> Tensor:
    """Give the largest free weights to a task: a share of 1 / (tasks_left + 1) of them.

    All tasks of a sequence get equally many weights of each layer, up to rounding.

    :param weight: the weights of one layer, of any shape
    :param owner: the task that owns each weight, or FREE, in the shape of `weight`
    :param task: the task that gets weights
    :param tasks_left: tasks that come after this one
    :return: the owners afterwards
    """
    free = (owner == FREE).flatten().nonzero().squeeze(1)
    kept = round(len(free) / (tasks_left + 1))
    order = weight.detach().abs().flatten()[free].argsort(descending=True, stable=True)
    after = owner.clone()
    after.view(-1)[free[order[:kept]]] = task
    return after


class PackNetPolicy(DrQv2Policy):
    """DrQ-v2's networks with an owner for each weight of the encoder and the actor.

    Layer norms and biases have no owners; they are frozen when the first task ends. The critic is
    that of the current task.
    """

    def build(self) -> None:
        """Initialise the networks; all weights are free."""
        super().build()
        for name, weight in self.managed():
            self.register_buffer(_owner(name), torch.full(weight.shape, FREE, dtype=torch.int8))

    def managed(self) -> Iterator[tuple[str, Tensor]]:
        """The weights that have owners: convolutions and linear layers of encoder and actor."""
        for part in ("encoder", "actor"):
            for name, module in getattr(self, part).named_modules():
                if isinstance(module, nn.Conv2d | nn.Linear):
                    yield f"{part}.{name}.weight", module.weight

    def owner(self, name: str) -> Tensor:
        """The task that owns each weight of a layer, or FREE."""
        return self.get_buffer(_owner(name))

    def freeze_rest(self, frozen: bool = True) -> None:
        """Freeze the biases and layer norms of encoder and actor, or let them learn."""
        managed = {id(weight) for _, weight in self.managed()}
        for parameter in (*self.encoder.parameters(), *self.actor.parameters()):
            parameter.requires_grad_(id(parameter) in managed or not frozen)

    @torch.no_grad()
    def prune(self, task: int, tasks_left: int) -> None:
        """Give the largest free weights to a task and set the others to zero."""
        for name, weight in self.managed():
            owner = self.owner(name)
            owner.copy_(prune(weight, owner, task, tasks_left))
            weight[owner == FREE] = 0  # so that the retraining learns without them

    @torch.no_grad()
    def redraw(self) -> None:
        """Initialise the free weights and the critic again, for the next task."""
        fresh = dict(deepcopy(self).apply(orthogonal).managed())
        for name, weight in self.managed():
            free = self.owner(name) == FREE
            weight[free] = fresh[name][free]
        widths = self.widths
        shape = self.encoder.embed_dim, widths.feature_dim, widths.hidden_dim, self.action_dim
        # A critic belongs to one task's rewards; the paper re-initialises it, too.
        self.critic = Critic(*shape).apply(orthogonal).to(self.device)
        self.target_critic = deepcopy(self.critic).requires_grad_(False)

    @torch.no_grad()
    def as_task(self, task: int) -> "PackNetPolicy":
        """Return a copy that acts as it did at the end of a task: later weights are zero."""
        policy = deepcopy(self)
        for name, weight in policy.managed():
            owner = policy.owner(name)
            weight[(owner == FREE) | (owner > task)] = 0
        return policy


def _owner(name: str) -> str:
    return "owner_" + name.replace(".", "_")  # buffers' names have no dots


class PackNetLearner(DrQv2Learner):
    """The update of DrQ-v2 that changes no weight of another owner.

    Make a new one for each task: with moments of an earlier task, Adam would change weights whose
    gradient is zero.

    :param trains: the owner whose weights are trained: FREE, or a task that is being retrained
    """

    policy: PackNetPolicy

    def __init__(self, policy: PackNetPolicy, settings: DrQv2Keywords, trains: int = FREE) -> None:
        super().__init__(policy, settings)
        self.trains = trains

    def descend(self, optimizer: Optimizer, loss: Tensor, name: str) -> None:
        """Take a step whose gradient is zero at the weights of all other owners."""
        optimizer.zero_grad()
        torch.autograd.backward(loss)
        # Not by hooks on the weights: copies of a parameter lose them.
        for layer, weight in self.policy.managed():
            if weight.grad is not None:
                weight.grad.mul_(self.policy.owner(layer) == self.trains)
        take_step(optimizer, loss, name, inf)


@dataclass(frozen=True, kw_only=True)
class PackNetKeywords(DrQv2Keywords):
    """The keywords of `PackNet`."""

    tasks: int = count(6, "tasks in the sequence; each gets an equal share of the weights")
    retrain: float = share(
        0.1, "updates after the pruning, as a share of those before it", Stage.TASK
    )


@dataclass(kw_only=True)
class PackNetProgress(FrameProgress):
    """Counters of a `PackNet` agent in its sequence of tasks.

    :ivar task: the current task's number, from 0 on
    :ivar updates_before: updates that were made for earlier tasks
    """

    task: int = 0
    updates_before: int = 0


class PackNet(DrQv2, keywords=PackNetKeywords, progress=PackNetProgress):
    """DrQ-v2 on a sequence of tasks; pruning assigns a part of the weights to each task.

    Example::

        model = PackNet("CnnPolicy", "wpt/dmc-quadruped-stand-v0", tasks=2)
        model.learn(150_000)
        model.next_task("wpt/dmc-quadruped-walk-v0")
        model.learn(150_000)
        model.policy_of(0).predict(obs, deterministic=True)  # still stands

    :param policy: "CnnPolicy"
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"CnnPolicy": PackNetPolicy}
    saved_as = "PackNet"
    policy: PackNetPolicy
    learner: PackNetLearner
    hyperparameters: PackNetKeywords
    progress: PackNetProgress

    def make_learner(self) -> PackNetLearner:
        """Make the optimisers, and mask the gradients of weights that earlier tasks own."""
        return PackNetLearner(self.policy, self.hyperparameters)

    def fit_networks(self, weights: Mapping[str, Tensor]) -> None:
        """Continue with the task of these weights; from the second on, biases are frozen."""
        owners = [owner for name, owner in weights.items() if name.startswith(_owner(""))]
        if owners:
            self.progress.task = 1 + max(int(owner.max()) for owner in owners)
            self.policy.freeze_rest(self.progress.task > 0)
            self.learner = self.make_learner()  # its optimisers leave out what is frozen

    def policy_of(self, task: int) -> PackNetPolicy:
        """Return the policy of a task, as it was when the task ended.

        :param task: the number of the task, from 0 to the current one

        :raises ValueError: a task that has not begun
        """
        if not 0 <= task <= self.progress.task:
            raise ValueError(
                f"There is no policy of task {task} yet: pass a number from 0 to "
                f"{self.progress.task}, the present task"
            )
        return self.policy if task == self.progress.task else self.policy.as_task(task)

    def reset_task(self) -> None:
        """Forget the whole sequence: episodes, all networks and the owners of their weights."""
        self.progress.task = 0
        self.progress.updates_before = self.updates
        super().reset_task()

    def next_task(self, env: Any, progress_bar: bool = False) -> None:
        """Prune and retrain the weights of the current task, then begin another one.

        The collected episodes are discarded, since another task has other rewards. The schedules
        start again.

        :param env: the environment of the next task, in any form that `set_env` takes
        :param progress_bar: show a progress bar

        :raises ValueError: the sequence has no further task, the actions have another width, or the
            episodes to retrain on are missing; the current task then continues
        """
        tasks_left = self.hyperparameters.tasks - 1 - self.progress.task
        if tasks_left < 1:
            raise ValueError(f"tasks={self.hyperparameters.tasks}: there is no further task")
        checked = self._checked(env)
        if checked.action_space.shape != self.action_space.shape:
            raise ValueError(
                f"The tasks of a sequence have actions of one width, here {self.action_space.shape}"
                f" and {checked.action_space.shape}"
            )
        before = self.policy, self.learner, self.updates
        self.policy = deepcopy(self.policy)
        try:
            self.policy.prune(self.progress.task, tasks_left)
            self.policy.freeze_rest()
            self._retrain(progress_bar)
        except BaseException:  # the task goes on as if it had not been ended
            self.policy, self.learner, self.updates = before
            raise
        with self.streams.weights(Purpose.REDRAW, self.progress.task, self.device):
            self.policy.redraw()
        self.replay_buffer = ReplayBuffer()
        self.progress.reset("credit", "seen_length")
        self.progress.task += 1
        self.progress.restart_steps()
        self.progress.updates_before = self.updates
        self.learner = self.make_learner()
        self._use_env(checked)

    def _retrain(self, progress_bar: bool) -> None:
        """Train the weights that the current task keeps, on its replay buffer."""
        self.learner = PackNetLearner(self.policy, self.hyperparameters, self.progress.task)
        made = self.updates - self.progress.updates_before
        updates = round(made * self.hyperparameters.retrain)
        if updates and not self.replay_buffer.trajectories:
            raise ValueError(
                "The weights that the task keeps are trained on its episodes, and there are none: "
                "call load_replay_buffer() first, or set model.retrain = 0"
            )
        for _ in shown(range(updates), updates, "retrain", progress_bar):
            self.update(defaultdict(list))
