"""The runner's progress bar with speed and remaining time."""

from contextlib import suppress

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback
from tqdm.auto import tqdm

from wpt_agents.zoo.terminal import progress


class LearningBar(BaseCallback):
    """The progress bar of fine-tuning, which advances once per episode, after its updates.

    Steps are fast and updates come in bursts, so a bar that advances with every step, as SB3's
    does, gives wrong estimates of the remaining time.
    """

    def __init__(self, frames_a_step: int) -> None:
        super().__init__()
        self.frames_a_step = frames_a_step
        self.bar: tqdm[None] | None = None

    def _on_rollout_start(self) -> None:
        if self.bar is None:  # after retrieval and imitation, which have their own bars
            total = self.locals["total_timesteps"] * self.frames_a_step
            done = self.model.num_timesteps * self.frames_a_step
            self.bar = progress(total, "learn", "frames", done)
        self._move()

    def _on_step(self) -> bool:
        frames = self.num_timesteps * self.frames_a_step
        self.logger.record("time/frames", frames, exclude="tensorboard")
        return True

    def _on_training_end(self) -> None:
        if self.bar is not None:
            self._move()
            with suppress(BrokenPipeError):
                self.bar.close()

    def _move(self) -> None:
        assert self.bar is not None
        episodes = list(self.model.ep_info_buffer or [])[-10:]
        if episodes:
            returns = float(np.mean([episode["r"] for episode in episodes]))
            self.bar.set_postfix({"return": f"{returns:.1f}"}, refresh=False)
        # Ctrl-C also ends the program that reads the output, such as `tee`, but not the episode.
        with suppress(BrokenPipeError):
            self.bar.update(self.model.num_timesteps * self.frames_a_step - self.bar.n)
