"""Gymnasium-Robotics: Fetch, the Shadow hand and Adroit, which are not in the paper."""

from contextlib import redirect_stderr
from io import StringIO
from typing import Any, cast

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.utils import EzPickle

from wpt_envs import tasks
from wpt_envs.rendering import Camera, View  # before gymnasium_robotics: it chooses the GL backend
from wpt_envs.simulated import Achieved, StepResult
from wpt_envs.simulation import fixed_usual_camera
from wpt_envs.wrappers import dress

# isort: split
with redirect_stderr(StringIO()):  # it prints a notice about versions, but ours is pinned
    import gymnasium_robotics

_IDS = {
    "fetch-reach": "FetchReach-v4",
    "fetch-push": "FetchPush-v4",
    "fetch-pick-and-place": "FetchPickAndPlace-v4",
    "fetch-slide": "FetchSlide-v4",
    "shadow-hand-reach": "HandReach-v3",
    "shadow-hand-block": "HandManipulateBlock-v1",
    "shadow-hand-egg": "HandManipulateEgg-v1",
    "shadow-hand-pen": "HandManipulatePen-v1",
    "adroit-door": "AdroitHandDoor-v1",
    "adroit-hammer": "AdroitHandHammer-v1",
    "adroit-pen": "AdroitHandPen-v1",
    "adroit-relocate": "AdroitHandRelocate-v1",
}


def make(
    task: str,
    *,
    image_size: int = 64,
    action_repeat: int = 1,
    pad_action_to: int | str | None = None,
    rendering: str = "near",
    camera: Camera | None = None,
    state_in_info: bool = False,
    seed: int | None = None,
    render_mode: str | None = "rgb_array",
    render_size: int | None = None,
) -> gym.Env:
    """Make a task of Gymnasium-Robotics from pixels, for example `fetch-push`; see `Robotics`."""
    env = Robotics(tasks.find("robotics", task), rendering, camera, seed, render_mode)
    return dress(
        env,
        image_size=image_size,
        action_repeat=action_repeat,
        pad_action_to=tasks.pad_width("robotics", pad_action_to),
        state_in_info=state_in_info,
        render_size=render_size,
    )


class Robotics(Achieved):
    """A task of Gymnasium-Robotics at its control rate; `make` puts the pixels around it.

    ## Description
    Fetch (reach, push, pick-and-place, slide), the Shadow hand (reach, block, egg, pen) and
    Adroit (door, hammer, pen, relocate): further embodiments, not counted among the paper's.

    ## Action Space
    `Box(-1, 1, (n,), float32)`: n is 4 for Fetch (the gripper's move along x, y and z, and its
    opening), 20 for the Shadow hand (its joints), and for Adroit (the arm's and the hand's
    joints) 28 at the door, 26 with the hammer, 24 with the pen, 30 to relocate.

    ## Observation Space
    `Box(0, 255, (image_size, image_size, 3), uint8)`: the image after the last repeat, by the
    environment's usual camera, goal markers included. Its own observation, flattened, with the
    goals, is in `info["state"]` with `state_in_info`.

    ## Rewards
    The environment's, summed over `action_repeat`: for Fetch and the Shadow hand 0 at a control
    step with success and else -1, for Adroit dense. `info["success"]`, `info["success_any"]`
    and `info["is_success"]` are as in Meta-World.

    ## Starting State
    The environment's own; `reset(seed=s)` restarts its stream.

    ## Episode End
    Truncated after 50 (Fetch, hand reach), 100 (Shadow hand) or 200 (Adroit) control steps;
    never terminated.

    ## Arguments
    Those of `wpt_envs.simulated.Simulated`. `action_repeat` is 1 by default;
    `pad_action_to="suite"` is 30.

    ## Version History
    v0: gymnasium-robotics 1.4.2, mujoco 3.3.0.
    """

    def __init__(
        self,
        task: tasks.Task,
        rendering: str = "near",
        camera: Camera | None = None,
        seed: int | None = None,
        render_mode: str | None = "rgb_array",
    ) -> None:
        EzPickle.__init__(self, task, rendering, camera, seed, render_mode)
        gym.register_envs(gymnasium_robotics)
        self.robot = cast(Any, gym.make(_IDS[task.name], disable_env_checker=True).unwrapped)
        super().__init__(task, seed, render_mode, fps=1 / self.robot.dt)
        camera = fixed_usual_camera(self.robot, self.robot.model) if camera is None else camera
        self.view = View(self.robot.model, self.robot.data, rendering, camera)
        self.action_space = spaces.Box(-1.0, 1.0, (task.action_dim,), np.float32)
        self._space = self.robot.observation_space
        size = spaces.flatdim(self._space)
        self.observation_space = spaces.Box(-np.inf, np.inf, (size,), np.float64)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start an episode, with a goal from the robot's own stream."""
        observation, _ = self.robot.reset(seed=self._seeded(seed))
        return self._state(observation), self._began()

    def step(self, action: np.ndarray) -> StepResult:
        """Take one control step; success never ends an episode."""
        observation, reward, _, _, info = self.robot.step(action)
        success = info.get("is_success", info.get("success", False))
        return self._state(observation), float(reward), False, *self._stepped(success)

    def _state(self, observation: Any) -> np.ndarray:
        """Flatten the observation, and move the goal's marker, which only render() would move."""
        show_goal = getattr(self.robot, "_render_callback", None)
        if show_goal is not None:
            show_goal()
        return np.asarray(spaces.flatten(self._space, observation), np.float64)
