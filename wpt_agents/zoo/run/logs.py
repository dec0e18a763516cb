"""SB3's logs and evaluations, continued when a run resumes."""

import os
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.vec_env import VecEnv

from wpt_agents.zoo.learning_curves import Evaluations
from wpt_agents.zoo.result import Metric


class EvaluationCallback(EvalCallback):
    """SB3's EvalCallback, which continues the evaluations in its folder.

    The best policy is the one with the highest mean return; if the task's metric is success, the
    one with the highest success rate, then the highest return. The first of equal ones is kept.

    :param metric: the task's, "return" or "success"
    :param keep: the file for the best model; None: do not save it
    """

    def __init__(
        self, eval_env: VecEnv, metric: Metric = "return", keep: Path | None = None, **keywords: Any
    ) -> None:
        super().__init__(eval_env, **keywords)
        self.metric = metric
        self.keep = keep

    @property
    def scores(self) -> list[tuple[float, ...]]:
        """Return the criterion of each evaluation so far; larger is better."""
        returns = [float(np.mean(episodes)) for episodes in self.evaluations_results]
        if self.metric == "return":
            return [(value,) for value in returns]
        assert len(self.evaluations_successes) == len(returns), "the task reports no successes"
        rates = [float(np.mean(episodes)) for episodes in self.evaluations_successes]
        return list(zip(rates, returns, strict=True))

    def _init_callback(self) -> None:
        super()._init_callback()
        before = Evaluations.read(Path(f"{self.log_path}.npz"))
        if before is not None:
            self.evaluations_timesteps = before.steps.tolist()
            self.evaluations_results = before.returns.tolist()
            self.evaluations_length = before.lengths.tolist()
            if before.successes is not None:
                self.evaluations_successes = before.successes.tolist()
            self.best_mean_reward = float(np.mean(self.evaluations_results, 1).max())
        self.n_calls = self.model.num_timesteps // self.model.n_envs

    def _on_step(self) -> bool:
        if self.eval_freq > 0 and self.n_calls % self.eval_freq == 0:
            done = len(self.evaluations_timesteps) * (self.n_eval_episodes + 1)
            go_to_episode(self.eval_env, done)
            return self._evaluated()
        return super()._on_step()

    def _evaluated(self) -> bool:
        """Evaluate and replace `evaluations.npz` atomically; SB3 would write it in place."""
        assert self.log_path is not None
        path = Path(f"{self.log_path}.npz")
        aside = path.with_name(f".{path.name}")
        self.log_path = str(aside.with_suffix(""))
        try:
            go_on = super()._on_step()
        finally:
            self.log_path = str(path.with_suffix(""))
        os.replace(aside, path)
        *before, now = self.scores
        if self.keep is not None and all(now > score for score in before):
            self.model.save(self.keep)
        return go_on


def go_to_episode(venv: VecEnv, number: int) -> None:
    """Make the next reset of environments in `EpisodeSeeds` start episode `number`."""
    venv.env_method("go_to_episode", number)
