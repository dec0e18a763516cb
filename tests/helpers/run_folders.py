"""Run folders as the runner leaves them, made up in no time, for what reads them."""

import json

import numpy as np
import yaml
from imageio.v3 import imwrite

from wpt_agents.zoo.report.summary import Summary
from wpt_agents.zoo.result import Result, Score, Variant, write_result

PIXELS = np.zeros((8, 24, 3), np.uint8)


def make_run(out, task, seed=0, method="wpt", returns=(10.0, 20.0), frames=1000, preset="debug"):
    """Writes a finished run's folder and returns its path."""
    folder = out / preset / method / f"{task}_{seed}"
    folder.mkdir(parents=True)
    metric = "return" if task.startswith("dmc") else "success"
    played = {"nothing": (0.0, 0.0), "random": (1.0, 2.0)}
    if method == "wpt":
        played["prior actor"] = 4.0, 5.0
    played["last"] = returns
    result = Result(
        suite=task.split("-")[0],
        task=task,
        method=method,
        variant=Variant.parse(preset),
        seed=seed,
        frames=frames,
        steps=frames // 2,
        metric=metric,
        scores={name: score(values, metric) for name, values in played.items()},
        seconds={"learn": 1.5, "evaluate": 0.5},
        commit="0123456789ab",
    )
    env = {"action_repeat": 2, "rendering": "near"}
    config = {"task": f"wpt/{task}-v0", "seed": seed, "env": env}
    (folder / "config.yaml").write_text(yaml.safe_dump(config))
    (folder / "command.txt").write_text(f"python -m wpt_agents.zoo run --tasks {task}\n")
    (folder / "system.json").write_text(json.dumps({"commit": "0123456789ab"}))
    evaluations = np.linspace(0, 1, 3)[:, None] * np.array(returns)
    arrays = {"timesteps": np.array([100, 300, 500]), "results": evaluations}
    if metric == "success":
        arrays["successes"] = evaluations > 5
    np.savez(folder / "evaluations.npz", **arrays, ep_lengths=np.full((3, 2), 50))
    rows = [f"{episode}.0,125,{episode}.5,{episode > 2}" for episode in range(1, 5)]
    head = ["#" + json.dumps({"t_start": 0, "env_id": task}), "r,l,t,is_success"]
    (folder / "0.monitor.csv").write_text("\n".join([*head, *rows, ""]))
    imwrite(folder / "predictions.png", PIXELS)
    if method != "scratch":
        imwrite(folder / "retrieval.png", PIXELS)
    (folder / "policy.mp4").write_bytes(b"not really a video")
    write_result(folder, result)
    return folder


def score(returns, metric):
    """A policy's score; an episode whose return is above 5 is a success."""
    successes = tuple(value > 5 for value in returns) if metric == "success" else ()
    return Score(tuple(map(float, returns)), successes)


def write_page(folder, page, media="first"):
    """Writes the page about the runs below a folder, and the tables beside it."""
    Summary.of(folder).write(page, media)
