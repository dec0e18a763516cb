"""Measure how often Meta-World's scripted policies succeed, with the noise of the zoo's data.

    python tests/helpers/scripts.py

Each row is a task. The columns are, for each standard deviation of the noise on the actions, the
share of episodes that are successful at their last step, and at any step, and the mean reward of a
step, of those with success, and of the last steps of episodes: if these differ little, rewards do
not teach to stay. No image is rendered, so all 50 tasks take minutes. Episodes have 200 control
steps, two for each action, as in the zoo.
"""

import argparse
import warnings

import numpy as np
import wpt_envs
from wpt_envs.metaworld import MetaWorld
from wpt_envs.wrappers import RepeatAction

from wpt_agents.zoo.collect.behaviours import scripted_actions
from wpt_agents.zoo.collect.episodes import SIGMAS


def measured(task: str, sigma: float, episodes: int, seed: int) -> str:
    """Return a task's columns: two shares of episodes, and two mean rewards."""
    env = RepeatAction(MetaWorld(wpt_envs.TASKS[task]), times=2)
    outcomes, successful, final = [], [], []
    for episode in range(episodes):
        act, _ = scripted_actions(np.random.default_rng([seed, episode]), task, sigma)
        state, info = env.reset(seed=seed + episode)
        truncated, step = False, 0
        while not truncated:
            action = act(state, {"state": state}, step)
            state, reward, _, truncated, info = env.step(action.astype(np.float32))
            step += 1
            if info["success"]:
                successful.append(reward)
        final.append(reward)
        outcomes.append((info["success"], info["success_any"]))
    env.close()
    last, ever = np.mean(outcomes, axis=0)
    paid = f"{np.mean(successful):.1f}" if successful else "-"
    return f"{last:.2f} | {ever:.2f} | {paid} | {np.mean(final):.1f}"


def main(settings: argparse.Namespace) -> None:
    """Print a row for each task as soon as it is measured."""
    shown = ["success at the last step", "at any step", "reward with success", "at the last step"]
    heads = [f"{sigma}: {head}" for sigma in settings.sigma for head in shown]
    print("|", " | ".join(["task", *heads]), "|")
    print("|---" * (1 + len(heads)) + "|", flush=True)
    for task in settings.tasks:
        name = f"wpt/metaworld-{task}-v0"
        row = [measured(name, sigma, settings.episodes, settings.seed) for sigma in settings.sigma]
        print("|", " | ".join([task, *row]), "|", flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    names = [task.name for task in wpt_envs.TASKS.values() if task.suite == "metaworld"]
    parser.add_argument("--tasks", nargs="+", default=names, choices=names, metavar="TASK")
    parser.add_argument("--sigma", nargs="+", type=float, default=list(SIGMAS[:2]))
    parser.add_argument("--episodes", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    with warnings.catch_warnings():  # some scripts exceed the limits of the actions
        warnings.filterwarnings("ignore", "Constant\\(s\\) may be too high")
        main(parser.parse_args())
