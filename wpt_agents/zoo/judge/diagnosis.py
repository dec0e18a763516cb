"""Compare the rewards and values that a model predicts with the actual ones.

If the imagined reward of the actor's actions is far above the actual reward, the actor exploits
errors of the model. If the imagined reward of the executed actions is also too high, the dynamics
are wrong. If only the critic's value is too high, the critic is wrong.
"""

from collections.abc import Sequence
from contextlib import closing
from dataclasses import astuple, dataclass, replace
from functools import partial

import gymnasium as gym
import numpy as np
import torch
from rich.table import Table
from torch import Generator, Tensor

from wpt_agents.agents.wpt import WPT
from wpt_agents.data.trajectory import Trajectory, led_to, stack_windows
from wpt_agents.model.policy import WPTPolicy
from wpt_agents.model.rssm import Latent
from wpt_agents.zoo.collect.episodes import record
from wpt_agents.zoo.judge.evaluation import acting
from wpt_agents.zoo.judge.trained import Trained
from wpt_agents.zoo.terminal import console

SAMPLES = 16  # imagined trajectories from each state
STARTS = 5  # states of an episode, evenly spaced


@dataclass(frozen=True)
class Promise:
    """Predicted and actual rewards from one state of an episode.

    :param start: the step of the state; a mean if episodes differ in length
    :param earned: the actual reward per step over the horizon
    :param same_actions: the reward per step that the model predicts for the executed actions
    :param own_actions: the reward per step that it predicts for the actor's actions
    :param value: the critic's value of the state
    :param discounted: the return that `value` estimates, Eq. (2) to the end of the episode: the
        reward of arriving in the state, and the discounted rewards that follow
    """

    start: float
    earned: float
    same_actions: float
    own_actions: float
    value: float
    discounted: float


@torch.no_grad()
def promises(
    policy: WPTPolicy, trajectory: Trajectory, gamma: float, starts: Sequence[int], horizon: int
) -> list[Promise]:
    """Return predicted and actual rewards at some steps of an episode.

    :param trajectory: with rewards, its actions in [-1, 1]
    :param starts: steps, each at least `horizon` before the end
    """
    assert trajectory.reward is not None
    model = policy.world_model
    generator = Generator(policy.device).manual_seed(0)
    whole = led_to(trajectory, 0, len(trajectory) + 1, policy.max_action_dim)
    batch = stack_windows([whole]).to(policy.device)
    post, _, _ = model.observe(batch, generator)
    value = policy.critic.value(post.feat)[0]
    rows = []
    for start in starts:
        state = Latent(*(x[:, start].repeat_interleave(SAMPLES, 0) for x in post))
        taken = batch.action[:, start + 1 : start + 1 + horizon].expand(SAMPLES, -1, -1)
        same, _ = model.rssm.imagine(state, partial(_taken, taken), horizon, generator)
        replanned, _ = model.rssm.imagine(state, lambda s, _: _mode(policy, s), horizon, generator)
        arriving = float(batch.reward[0, start])
        rest = trajectory.reward[start:]
        rows.append(
            Promise(
                start=start,
                earned=float(rest[:horizon].mean()),
                same_actions=float(model.reward(same.feat)[:, 1:].mean()),
                own_actions=float(model.reward(replanned.feat)[:, 1:].mean()),
                value=float(value[start]),
                discounted=arriving + float(rest @ gamma ** np.arange(1, len(rest) + 1)),
            )
        )
    return rows


def _taken(actions: Tensor, _: Latent, t: int) -> Tensor:
    return actions[:, t]


def _mode(policy: WPTPolicy, state: Latent) -> Tensor:
    return policy.acting_actor.dist(state.feat, policy.action_mask).mode


@dataclass(frozen=True)
class Diagnosis:
    """The result of `diagnose`.

    :param returns: the return of each episode
    :param reward_error: mean absolute error of the reward head per step, on filtered states
    :param promises: a row for each starting step, means over episodes
    :param clone_acts: whether the prior actor takes part in acting (`residual`, `ibrl`), which it
        cannot in imagination
    """

    returns: list[float]
    reward_error: float
    promises: list[Promise]
    clone_acts: bool = False


def diagnose(
    trained: Trained, episodes: int, seed: int, horizon: int, device: str = "auto"
) -> Diagnosis:
    """Play episodes with a trained model and compare its predictions with actual rewards.

    :raises ValueError: if the model is not WPT's, or if an episode is shorter than `horizon`
    """
    model = trained.load(device=device)
    if not isinstance(model, WPT):
        raise ValueError(f"{trained.model} has no world model: diagnose supports only WPT")
    low, high = model.action_space.low, model.action_space.high
    returns, errors, promised = list[float](), list[float](), list[list[Promise]]()
    with closing(gym.make(trained.task, **trained.env)) as env:
        for episode in range(episodes):
            played = record(env, acting(model), seed + episode)
            if len(played) < horizon:
                raise ValueError(f"An episode lasts {len(played)} steps: use a shorter --horizon")
            unit = 2 * (played.action - low) / (high - low) - 1
            played = replace(played, action=unit.astype(np.float32))
            starts = np.linspace(0, len(played) - horizon, STARTS).astype(int).tolist()
            assert played.reward is not None
            returns.append(float(played.reward.sum()))
            errors.append(model.policy.heldout_errors(played, len(played) + 1)["reward"])
            promised.append(promises(model.policy, played, model.gamma, starts, horizon))
    means = [Promise(*np.mean([astuple(p) for p in row], 0)) for row in zip(*promised, strict=True)]
    return Diagnosis(returns, float(np.mean(errors)), means, model.policy.sees_frames)


def show(diagnosis: Diagnosis, horizon: int) -> None:
    """Print a table of the promises, the returns, and the error of the reward head."""
    title = f"From a step on: reward per step over {horizon} steps, and return; means over episodes"
    table = Table(title=title)
    for name in ("step", "earned", "imagined, same actions", "imagined, the actor's"):
        table.add_column(name, justify="right")
    for name in ("critic's value", "discounted return"):
        table.add_column(name, justify="right")
    for row in diagnosis.promises:
        table.add_row(f"{row.start:.0f}", *(f"{x:.2f}" for x in astuple(row)[1:]))
    console.print(table)
    if diagnosis.clone_acts:
        console.print(
            'The prior actor takes part in acting, and not in imagination: "the actor\'s" are the '
            "actions of the actor alone, which are not those that are executed."
        )
    console.print(f"Returns: {', '.join(f'{x:.0f}' for x in diagnosis.returns)}")
    console.print(
        f"Error of the reward head on these images: {diagnosis.reward_error:.2f} per step"
    )
