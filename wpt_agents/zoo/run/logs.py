"""SB3's logs and evaluations, continued when a run resumes."""

import os
from pathlib import Path

import numpy as np
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.logger import CSVOutputFormat
from stable_baselines3.common.vec_env import VecEnv


class Evaluations(EvalCallback):
    """SB3's EvalCallback, which continues the evaluations of its folder and the best of them."""

    def _init_callback(self) -> None:
        super()._init_callback()
        path = Path(f"{self.log_path}.npz")
        if path.exists():
            with np.load(path) as arrays:
                self.evaluations_timesteps = arrays["timesteps"].tolist()
                self.evaluations_results = arrays["results"].tolist()
                self.evaluations_length = arrays["ep_lengths"].tolist()
                self.evaluations_successes = (
                    arrays["successes"].tolist() if "successes" in arrays else []
                )
            self.best_mean_reward = float(np.mean(self.evaluations_results, 1).max())
        self.n_calls = self.model.num_timesteps // self.model.n_envs

    def _on_step(self) -> bool:
        if self.eval_freq > 0 and self.n_calls % self.eval_freq == 0:
            done = len(self.evaluations_timesteps) * (self.n_eval_episodes + 1)
            go_to_episode(self.eval_env, done)
            return self._evaluated()
        return super()._on_step()

    def _evaluated(self) -> bool:
        """Evaluate and replace `evaluations.npz` whole; SB3 would write into it in place."""
        assert self.log_path is not None
        path = Path(f"{self.log_path}.npz")
        aside = path.with_name(f".{path.name}")
        self.log_path = str(aside.with_suffix(""))
        try:
            go_on = super()._on_step()
        finally:
            self.log_path = str(path.with_suffix(""))
        os.replace(aside, path)
        return go_on


def go_to_episode(venv: VecEnv, number: int) -> None:
    """The next reset of environments under `EpisodeSeeds` begins episode `number`."""
    venv.env_method("go_to_episode", number)


class ContinuedCSV(CSVOutputFormat):
    """SB3's `progress.csv`, which goes on with the rows that are there."""

    def __init__(self, path: Path) -> None:
        before = path.read_text(encoding="utf-8") if path.exists() else ""
        super().__init__(str(path))
        self.file.write(before)
        self.file.flush()
        self.keys = before.partition("\n")[0].split(",") if before else []

    def keep(self, rows: int) -> None:
        """Keep the first `rows` rows and drop the others."""
        self.file.seek(0)
        lines = self.file.readlines()[: 1 + rows]
        self.file.seek(0)
        self.file.truncate()
        self.file.writelines(lines)
