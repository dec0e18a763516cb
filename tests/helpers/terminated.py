"""Pre-trains under torchrun; in the first attempt rank 1 gets a SIGTERM in its fifth update.

python terminated.py DATA RUN_DIR; rank 0 writes the updates of each attempt beside the model.
"""

import json
import os
import signal
import sys
from pathlib import Path

import torch
from two_processes import train

from wpt_agents.training import pretraining
from wpt_agents.training.learner import Learner


def terminate_at_the_fifth_update():
    step, taken = Learner.take_step, []

    def terminated(self, *args):
        taken.append(0)
        if len(taken) == 5:
            os.kill(os.getpid(), signal.SIGTERM)
        return step(self, *args)

    Learner.take_step = terminated


if __name__ == "__main__":
    torch.set_num_threads(1)
    pretraining.SAVE_EVERY = 2
    attempt = int(os.environ["TORCHELASTIC_RESTART_COUNT"])
    if attempt == 0 and os.environ["RANK"] == "1":
        terminate_at_the_fifth_update()
    data, run_dir = map(Path, sys.argv[1:])
    _, seen = train(data, run_dir=run_dir)
    if os.environ["RANK"] == "0":
        (run_dir / f"attempt-{attempt}.json").write_text(json.dumps(list(seen)))
