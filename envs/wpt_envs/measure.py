"""Compare the three renderings: similarity to `exact`, speed, and appearance."""

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from wpt_envs.rendering import QUALITIES, View
from wpt_envs.simulated import Simulated
from wpt_envs.tasks import Task

THE_FOUR = (  # the tasks on which speed is reported
    "wpt/dmc-walker-run-v0",
    "wpt/dmc-quadruped-run-v0",
    "wpt/metaworld-button-press-v0",
    "wpt/metaworld-assembly-v0",
)


def psnr(image: np.ndarray, reference: np.ndarray) -> float:
    """Return the peak signal-to-noise ratio in dB, infinite for equal pictures.

    :param image: (H, W, 3) uint8
    :param reference: (H, W, 3) uint8
    """
    error = np.mean((image.astype(np.float64) - reference) ** 2)
    return float(10 * np.log10(255**2 / error)) if error else float("inf")


def visit_states(env: Simulated, count: int, seed: int = 0) -> Iterator[int]:
    """Take the simulator through `count` states of random episodes, ten control steps apart."""
    rng = np.random.default_rng(seed)
    for index in range(count):
        if index % 5 == 0:
            env.reset(seed=seed + index)
        for _ in range(10):
            env.step(rng.uniform(-1, 1, env.action_space.shape).astype(np.float32))
        yield index


def views(env: Simulated) -> dict[str, View]:
    """Return a view by the same camera for each rendering."""
    return {rendering: env.view.at(rendering) for rendering in QUALITIES}


def likeness(task: Task, states: int = 20, size: int = 64) -> dict[str, float]:
    """Return the mean PSNR in dB of `near` and `fast` against `exact`."""
    env = _bare(task)
    looks = views(env)
    ratios: dict[str, list[float]] = {"near": [], "fast": []}
    for _ in visit_states(env, states):
        exact = looks["exact"].look(size)
        for rendering, values in ratios.items():
            values.append(psnr(looks[rendering].look(size), exact))
    for view in looks.values():
        view.close()
    env.close()
    return {rendering: float(np.mean(values)) for rendering, values in ratios.items()}


def speed(task: Task, rounds: int = 5, steps: int = 10) -> dict[str, float]:
    """Return the CPU time of a step in ms for each rendering and for the suite's own renderer.

    They alternate every `steps` steps, and the median over rounds is returned, so that other
    load on the machine affects all of them equally.
    """
    envs = {rendering: gym.make(task.id, rendering=rendering) for rendering in QUALITIES}
    envs["usual"] = gym.make(task.id)
    bare: Any = envs["usual"].unwrapped
    usual, free = usual_renderer(bare)
    bare.look = lambda size: usual()
    for env in envs.values():
        env.reset(seed=0)
        env.action_space.seed(0)
        _step_cost(env, 2)  # opens the GL context
    costs = [{name: _step_cost(env, steps) for name, env in envs.items()} for _ in range(rounds)]
    free()
    for env in envs.values():
        env.close()
    return {name: float(np.median([cost[name] for cost in costs])) for name in envs}


def _step_cost(env: gym.Env, steps: int) -> float:
    """Return the CPU time of a step in ms, summed over the threads of the process."""
    actions = [env.action_space.sample() for _ in range(steps)]
    start = time.process_time()
    for action in actions:
        env.step(action)
    return (time.process_time() - start) / steps * 1000


def usual_renderer(env: Any) -> tuple[Callable[[], np.ndarray], Callable[[], None]]:
    """Return two functions for the suite's own renderer: one draws, the other frees it."""
    camera = env.view.camera
    if hasattr(env, "dm_env"):
        physics = env.dm_env.physics
        return lambda: physics.render(64, 64, camera_id=camera), physics.free
    from gymnasium.envs.mujoco.mujoco_rendering import MujocoRenderer

    simulator = env.sawyer if hasattr(env, "sawyer") else env.robot
    placed: dict[str, Any] = {"camera_name": camera}
    if isinstance(camera, dict):
        placed = {"default_cam_config": camera}
    renderer = MujocoRenderer(simulator.model, simulator.data, width=64, height=64, **placed)
    upright = slice(None, None, -1 if hasattr(env, "sawyer") else 1)  # corner4 hangs
    return lambda: renderer.render("rgb_array")[upright], renderer.close


def _bare(task: Task) -> Simulated:
    """Make a task without the wrappers that show pixels."""
    env = gym.make(task.id).unwrapped
    assert isinstance(env, Simulated), env
    return env


def montage(tasks: list[Task], path: Path, size: int = 64, columns: int = 6) -> None:
    """Write an image with the three renderings of one state of each task, side by side."""
    import imageio.v3

    cells = []
    for task in tasks:
        env = _bare(task)
        looks = views(env)
        for _ in visit_states(env, 1):
            cells.append(np.concatenate([view.look(size) for view in looks.values()], axis=1))
        for view in looks.values():
            view.close()
        env.close()
    border = [(2, 2), (4, 4), (0, 0)]
    cells = [np.pad(cell, border, constant_values=255) for cell in cells]
    cells += [np.full_like(cells[0], 255)] * (-len(cells) % columns)
    rows = [np.concatenate(cells[i : i + columns], 1) for i in range(0, len(cells), columns)]
    imageio.v3.imwrite(path, np.concatenate(rows, axis=0))
