"""Fine-tune a pre-trained model on a task, with rehearsal and guidance from the data.

    python examples/fine_tune.py runs/pretrained/model.zip data/arm --steps 10000

The dataset is the one that the model was pre-trained on. `learn` retrieves trajectories from it
that start like the task, and replays them. The prior actor imitates them and guides early episodes.
"""

import argparse
from pathlib import Path
from typing import Any

import gymnasium as gym
import wpt_envs  # noqa: F401  # registers the ids wpt/...
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor

from wpt_agents import WPT


def main(
    model_file: Path,
    dataset: Path,
    env: gym.Env,
    eval_env: gym.Env,
    steps: int,
    folder: Path,
    **changes: Any,
) -> WPT:
    """Fine-tune, keep the best policy, and compare it with the prior actor."""
    eval_env = Monitor(eval_env)  # records returns and lengths of episodes
    model = WPT.load(model_file, env=env, dataset=dataset, **changes)
    # evaluates every tenth of the run and saves the best model
    callback = EvalCallback(
        eval_env, eval_freq=steps // 10, n_eval_episodes=5, best_model_save_path=str(folder)
    )
    model.learn(steps, callback=callback, progress_bar=True)
    best = WPT.load(folder / "best_model.zip")
    for name, policy in (("policy", best), ("prior actor", model.prior)):
        mean, deviation = evaluate_policy(policy, eval_env, n_eval_episodes=10)
        print(f"{name}: return {mean:.1f} +- {deviation:.1f}")
    return best


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("model", type=Path, help="a model file written by pretrain or save")
    parser.add_argument("dataset", type=Path, help="the dataset that it was pre-trained on")
    parser.add_argument("--task", default="wpt/metaworld-drawer-close-v0", help="an id of wpt_envs")
    parser.add_argument("--steps", type=int, default=10_000, help="calls of env.step")
    parser.add_argument(
        "--folder", type=Path, default=Path("runs/fine-tuned"), help="for best_model.zip"
    )
    arguments = parser.parse_args()
    environments = [gym.make(arguments.task, rendering="fast") for _ in range(2)]
    main(
        arguments.model,
        arguments.dataset,
        *environments,
        arguments.steps,
        arguments.folder,
        num_retrieve=20,
        bc_steps=2000,
        guidance=f"linear(1,0,{arguments.steps // 2})",
        learning_starts=300,
        warmup_steps=300,
    )
