"""Predict whether a call of `learn` makes any update, and word the warning if it makes none."""

import math
import warnings
from dataclasses import dataclass
from typing import Any, Self

from wpt_agents.training.ends import time_limit


@dataclass(frozen=True)
class Outlook:
    """The numbers that decide whether a call of `learn` makes updates.

    Steps are calls of `env.step`, counted once for every environment.

    :param start: steps before the call
    :param stop: steps after the call
    :param n_envs: number of environments
    :param replay: whether there is something to replay
    :param opened: steps of the longest open episode, in one environment
    :param longest: steps after which an open episode is stored, `max_trajectory_length`
    :param limit: steps of an episode, if they are known
    :param price: collected steps for each update; infinite if no update is expected
    :param credit: earlier steps for which no update was made
    :param learning_starts: steps before the first update
    :param warmup_pays: whether updates are also made for the steps before `learning_starts`
    :param warmup_steps: in episodes that begin in these first steps, the guide alone acts
    :param cheaper: a line of code that makes the call's steps enough for an update, or ""
    :param driver: what chooses the actions in the warm-up
    """

    start: int
    stop: int
    n_envs: int
    replay: bool
    opened: int
    longest: int
    limit: int | None
    price: float
    credit: float
    learning_starts: int
    warmup_pays: bool
    warmup_steps: int
    cheaper: str
    driver: str = "random actions"

    @classmethod
    def of(cls, agent: Any) -> Self:
        """Return the numbers of a `PixelAgent` whose `learn` ends at `_total_timesteps`."""
        rollout = agent.rollout
        fresh = rollout is None or agent._last_episode_starts.all()
        n_envs = agent.n_envs
        return cls(
            start=agent.num_timesteps,
            stop=math.ceil(agent._total_timesteps / n_envs) * n_envs,
            n_envs=n_envs,
            replay=len(agent.replay_buffer) > 0,
            opened=0 if fresh else rollout.longest_open(),
            longest=agent.max_trajectory_length,
            limit=time_limit(agent.env),
            price=agent.steps_to_update() if agent.updates_per_step else math.inf,
            credit=agent.credit,
            learning_starts=agent.learning_starts,
            warmup_pays=agent.warmup_pays,
            warmup_steps=agent.warmup_steps,
            cheaper=agent.cheaper_updates(agent._total_timesteps - agent.num_timesteps),
            driver=agent.warmup_driver,
        )

    def warn(self, over: bool, learns: bool) -> None:
        """Warn of a call that makes no update, or in which the policy never acts.

        :param over: whether the call is over
        :param learns: whether the agent has made updates, or need not make any
        """
        if not self.steps:  # nobody expects updates of learn(0)
            return
        expected = not learns and self.price < math.inf
        for text in (self.no_update(over) if expected else None, self.warm_up_only()):
            if text is not None:
                warnings.warn(text, stacklevel=5)

    @property
    def steps(self) -> int:
        """The steps of this call."""
        return self.stop - self.start

    @property
    def paid_from(self) -> int:
        """The step from which on updates are made for collected steps."""
        return self.start if self.warmup_pays else max(self.start, self.learning_starts)

    def first_stored(self, over: bool) -> int:
        """Return the steps of this call until something can be replayed, or an estimate.

        :param over: whether the call is over; before that, an episode of unknown length may end at
            any step
        """
        if self.replay:
            return 0
        length = self.limit or (self.longest if over else 1)
        return max(min(length, self.longest) - self.opened, 1) * self.n_envs

    def needed(self, over: bool) -> int:
        """Return the steps that this call would have to last for its first update."""
        first = max(
            self.start + self.first_stored(over),
            self.learning_starts,
            self.paid_from + math.ceil(self.price - self.credit - 1e-9),
        )
        return math.ceil((first - self.start) / self.n_envs) * self.n_envs

    def obstacles(self, over: bool) -> dict[str, str]:
        """Return the reasons why no update is made, each with a line of code that removes it."""
        obstacles = {}
        affordable = self.credit + self.steps >= self.price - 1e-9
        paid = self.credit + self.stop - self.paid_from >= self.price - 1e-9
        if self.stop < self.learning_starts or (affordable and not paid):
            text = f"no update is made in the first learning_starts={self.learning_starts} steps"
            obstacles[text] = "model.learning_starts = 0"
        if self.first_stored(over) > self.steps:
            text = "nothing can be replayed before an episode ends or has max_trajectory_length="
            known = f"; an episode has {self.limit} steps" if self.limit else ""
            shorter = max(1, self.steps // self.n_envs)
            obstacles[f"{text}{self.longest} steps{known}"] = (
                f"model.max_trajectory_length = {shorter}"
            )
        if not affordable:
            obstacles[f"an update is made for every {self.price:g} collected steps"] = self.cheaper
        return obstacles

    def no_update(self, over: bool) -> str | None:
        """Return the warning if the call makes no update, None if it makes some.

        :param over: whether the call is over and has made none
        """
        obstacles = self.obstacles(over)
        if not over and not obstacles:
            return None
        sooner = " unless an episode ends sooner" if self.limit and not self.replay else ""
        verb = "made no update" if over else f"will make no update{sooner}"
        if not obstacles:
            return (
                f"learn({self.steps}) {verb}: it was stopped before the first one. Continue by "
                "learn(..., reset_num_timesteps=False)"
            )
        assignments = " and ".join(text for text in obstacles.values() if text)
        setting = f", or set {assignments} before it" if all(obstacles.values()) else ""
        return (
            f"learn({self.steps}) {verb}: {'; '.join(obstacles)}. Pass at least "
            f"{self.needed(over)} steps{setting}"
        )

    def warm_up_only(self) -> str | None:
        """Return the warning if the policy itself never acts in this call, else None."""
        if self.stop > self.warmup_steps:
            return None
        return (
            f"learn({self.steps}) collects nothing but {self.driver}: warmup_steps="
            f"{self.warmup_steps}. Pass more than {self.warmup_steps - self.start} steps, "
            "or set model.warmup_steps = 0 before it"
        )
