"""DrQ-v2's learner balances a pole whose state it sees, which takes far fewer updates than pixels.

It tells a wrong update from an encoder that has not learned enough. For other keywords:
`python tests/agents/test_drqv2_on_states.py learning_rate=1e-4`.
"""

import sys
from copy import deepcopy
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from dm_control import suite
from torch import nn

from wpt_agents.agents.drqv2 import Actor, Critic, DrQv2Keywords, DrQv2Learner, noisy_action
from wpt_agents.data.transitions import Transitions
from wpt_agents.model.frames import orthogonal
from wpt_agents.training.guidance import parse_schedule

START = 1000  # steps of random actions before the first update
SETTINGS = DrQv2Keywords(
    batch_size=64,
    learning_rate=3e-4,
    tau=0.02,
    gamma=0.98,
    pre_activation=1e-2,
    std="linear(1,0.1,20000)",
)


def load_pole(seed: int) -> Any:
    return suite.load("cartpole", "balance", task_kwargs={"random": seed})


def state(time_step: Any) -> np.ndarray:
    seen = time_step.observation
    return np.concatenate([seen["position"], 0.3 * seen["velocity"]]).astype(np.float32)


def act_twice(pole: Any, action: np.ndarray) -> tuple[Any, float]:
    first, second = pole.step(action), pole.step(action)
    return second, first.reward + second.reward


def make_policy(hidden: int) -> Any:
    actor, critic = Actor(5, 50, hidden, 1), Critic(5, 50, hidden, 1)
    for network in (actor, critic):
        network.apply(orthogonal)
    target = deepcopy(critic).requires_grad_(False)
    return SimpleNamespace(encoder=nn.Identity(), actor=actor, critic=critic, target_critic=target)


@torch.no_grad()
def evaluate(policy: Any, pole: Any) -> float:
    total = 0.0
    for _ in range(3):
        now = pole.reset()
        while not now.last():
            action = policy.actor(torch.from_numpy(state(now))[None])[0].numpy()
            now, reward = act_twice(pole, action)
            total += reward
    return total / 3


class Memory:
    """Steps in the order in which they were made, and where n-step transitions begin."""

    def __init__(self, steps: int) -> None:
        rows = steps + steps // 500 + 2  # each episode of 500 steps has one more state
        self.state = np.zeros((rows, 5), np.float32)
        self.action = np.zeros((rows, 1), np.float32)
        self.reward = np.zeros(rows, np.float32)
        self.starts: list[int] = []

    def draw(self, rng: np.random.Generator, settings: DrQv2Keywords) -> Transitions:
        n, size, gamma = settings.n_steps, settings.batch_size, settings.gamma
        start = np.array(self.starts)[rng.integers(0, len(self.starts), size)]
        reward = sum(gamma**i * self.reward[start + i] for i in range(n))
        return Transitions(
            torch.from_numpy(self.state[start]),
            torch.from_numpy(self.action[start]),
            torch.from_numpy(np.asarray(reward, np.float32)),
            torch.full((size,), gamma**n),
            torch.from_numpy(self.state[start + n]),
        )


def learn(steps: int, settings: DrQv2Keywords = SETTINGS, hidden: int = 128) -> list[float]:
    """The mean return of three episodes after each 1,000 updates, one for each step."""
    torch.manual_seed(0)
    rng, pole, other_pole = np.random.default_rng(0), load_pole(0), load_pole(99)
    policy = make_policy(hidden)
    learner = DrQv2Learner(policy, settings)
    std_at = parse_schedule(settings.std, np.inf, "std")
    memory, now, returns = Memory(steps), pole.reset(), []
    row, began = 0, 0
    memory.state[0] = state(now)
    for step in range(steps):
        if step < START:
            action = rng.uniform(-1, 1, 1).astype(np.float32)
        else:
            with torch.no_grad():
                mean = policy.actor(torch.from_numpy(memory.state[row])[None])
            action = noisy_action(mean, std_at(step))[0].numpy()
        now, memory.reward[row] = act_twice(pole, action)
        memory.action[row] = action
        row += 1
        memory.state[row] = state(now)
        if row - began >= settings.n_steps:
            memory.starts.append(row - settings.n_steps)
        if now.last():  # a time limit: the last state is bootstrapped from
            row += 1
            now, began = pole.reset(), row
            memory.state[row] = state(now)
        if step >= START:
            learner.update(memory.draw(rng, settings), std_at(step))
            if (step + 1) % 1000 == 0:
                returns.append(evaluate(policy, other_pole))
    return returns


@pytest.mark.nightly
def test_the_learner_balances_a_pole_from_its_state():
    assert max(learn(5000)[-2:]) > 820  # doing nothing has 747, pushing one way 136


if __name__ == "__main__":
    words = (word.split("=", 1) for word in sys.argv[1:])
    kinds = {name: type(getattr(SETTINGS, name)) for name in ("std", "batch_size", "n_steps")}
    changes = {name: kinds.get(name, float)(value) for name, value in words}
    print([round(value) for value in learn(5000, replace(SETTINGS, **changes))])
