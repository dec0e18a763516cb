"""Pre-train a world model on a folder of recordings, without rewards.

    python examples/pretrain_from_folder.py recordings --steps 20000

`recordings` contains one .npz file per episode, with `image` of (T + 1, 64, 64, 3) uint8 and
`action` of (T + 1, A) in [-1, 1]: row t led to image t, so the first row is a placeholder. Other
formats work as well: see docs/importing.md. Started again, the script continues from the last
checkpoint.
"""

import argparse
from pathlib import Path
from typing import Any

from wpt_agents import WPT


def main(recordings: Path, steps: int, run_dir: Path, size: str, **changes: Any) -> WPT:
    """Pre-train, print the loss every 500 steps, and return the model."""

    def report(step: int, metrics: dict[str, float]) -> None:
        if step % 500 == 0 or step == steps:
            print(f"step {step}: reconstruction {metrics['train/reconstruction_loss']:.1f}")

    model = WPT.pretrain(
        recordings,
        steps=steps,
        size=size,
        run_dir=run_dir,  # model.zip is written here, every 1000 steps and at the end
        seed=0,
        callback=report,
        progress_bar=True,
        **changes,
    )
    print(f"the model is {run_dir / 'model.zip'}")
    return model


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("recordings", type=Path, help="a folder, file or dataset")
    parser.add_argument("--steps", type=int, default=20_000, help="updates")
    parser.add_argument(
        "--run-dir", type=Path, default=Path("runs/pretrained"), help="for model.zip"
    )
    parser.add_argument("--size", default="tiny", help="debug, tiny, small, mid, medium or paper")
    arguments = parser.parse_args()
    main(arguments.recordings, arguments.steps, arguments.run_dir, arguments.size)
