"""Save checkpoints while learning: after an interruption, start the script again to continue.

    python examples/resume.py --steps 3000

Model and replay buffer are saved together after every block of steps. Files are written beside
their destination and then renamed, so the previous ones survive if saving is interrupted.
"""

import argparse
from pathlib import Path
from typing import Any

from custom_environment import SETTINGS, PushDot

from wpt_agents import WPT


def main(steps: int, folder: Path, block: int = 500, **changes: Any) -> WPT:
    """Learn until `steps` steps are done, in this process and earlier ones together."""
    model_file = folder / "model.zip"
    settings = SETTINGS | changes
    if model_file.exists():
        model = WPT.load(model_file, env=PushDot())
        # each replay buffer is named after the number of steps of its model
        model.load_replay_buffer(folder / f"replay-{model.num_timesteps}.zip")
        print(f"continuing after {model.num_timesteps} steps")
    else:
        folder.mkdir(parents=True, exist_ok=True)
        model = WPT("WPTPolicy", PushDot(), offline_ratio=0, guidance=0, **settings)
    while model.num_timesteps < steps:
        before = folder / f"replay-{model.num_timesteps}.zip"
        model.learn(min(block, steps - model.num_timesteps), reset_num_timesteps=False)
        model.save_replay_buffer(folder / f"replay-{model.num_timesteps}.zip")
        model.save(model_file)  # saved last: from now on, the new replay buffer is loaded
        before.unlink(missing_ok=True)
        print(f"saved after {model.num_timesteps} steps, {model.updates} updates")
    return model


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=3000, help="calls of env.step in total")
    parser.add_argument(
        "--folder", type=Path, default=Path("runs/resume"), help="for the model and the replay"
    )
    arguments = parser.parse_args()
    main(arguments.steps, arguments.folder)
