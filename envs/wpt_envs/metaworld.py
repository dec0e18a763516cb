"""Meta-World: the 50 Sawyer tasks, with a new goal and object at each reset."""

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.utils import EzPickle

from wpt_envs import tasks
from wpt_envs.rendering import Camera, View  # before metaworld: it chooses the GL backend
from wpt_envs.simulated import Achieved, StepResult
from wpt_envs.wrappers import dress

# isort: split
import mujoco
from metaworld.env_dict import ALL_V3_ENVIRONMENTS
from metaworld.sawyer_xyz_env import SawyerXYZEnv


def make(
    task: str,
    *,
    image_size: int = 64,
    action_repeat: int = 2,
    pad_action_to: int | str | None = None,
    rendering: str = "near",
    camera: Camera = "corner4",
    state_in_info: bool = False,
    seed: int | None = None,
    render_mode: str | None = "rgb_array",
    render_size: int | None = None,
) -> gym.Env:
    """Make a task of Meta-World from pixels, for example `button-press`; see `MetaWorld`."""
    env = MetaWorld(tasks.find("metaworld", task), rendering, camera, seed, render_mode)
    return dress(
        env,
        image_size=image_size,
        action_repeat=action_repeat,
        pad_action_to=tasks.pad_width("metaworld", pad_action_to),
        state_in_info=state_in_info,
        render_size=render_size,
    )


class MetaWorld(Achieved):
    """A task of Meta-World at its control rate; `make` puts the pixels around it.

    ## Description
    The 50 tasks of Meta-World v3 with the Sawyer arm, its dense reward ("v2") and a goal and
    object that are new at each reset. Not the protocol of `Meta-World/MT1`, which has 50 fixed
    goals and 500 control steps.

    ## Action Space
    `Box(-1, 1, (4,), float32)`: the gripper's move along x, y and z, and its closing.

    ## Observation Space
    `Box(0, 255, (image_size, image_size, 3), uint8)`: the image after the last repeat, by the
    camera `corner4`. This camera hangs upside down, and its picture is turned over top to bottom
    (not rotated), as is usual. The state of 39 numbers, with the goal, is in `info["state"]`
    with `state_in_info`.

    ## Rewards
    Meta-World's, 0 to 10 a control step, summed over `action_repeat`.
    `info["success"]` is success at this step, `info["success_any"]` at any step of the episode
    so far, and `info["is_success"]` repeats `success` for Stable-Baselines3.

    ## Starting State
    Drawn at each reset. `reset(seed=s)` restarts the stream exactly; `reset()` continues it.

    ## Episode End
    Truncated after 200 control steps; never terminated, success or not.

    ## Arguments
    Those of `wpt_envs.simulated.Simulated`. `pad_action_to="suite"` is 4.

    ## Version History
    v0: metaworld 3.1.1, mujoco 3.3.0.
    """

    def __init__(
        self,
        task: tasks.Task,
        rendering: str = "near",
        camera: Camera = "corner4",
        seed: int | None = None,
        render_mode: str | None = "rgb_array",
    ) -> None:
        EzPickle.__init__(self, task, rendering, camera, seed, render_mode)
        self.sawyer = _goal_observable(ALL_V3_ENVIRONMENTS[f"{task.name}-v3"]())
        super().__init__(task, seed, render_mode, fps=1 / self.sawyer.dt)
        self.view = View(self.sawyer.model, self.sawyer.data, rendering, camera, upright=True)
        self.action_space = spaces.Box(-1.0, 1.0, (task.action_dim,), np.float32)
        self.observation_space = self._bounds = self.sawyer.sawyer_observation_space

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Draw a new goal and object; a seed restarts their stream."""
        seed = self._seeded(seed)
        if seed is not None:
            self.sawyer.seed(seed)  # its reset ignores one
        mujoco.mj_resetData(self.sawyer.model, self.sawyer.data)  # forget the last episode
        state, _ = self.sawyer.reset()
        mujoco.mj_forward(self.sawyer.model, self.sawyer.data)  # else the goal is drawn elsewhere
        return self._bounded(state), self._began()

    def step(self, action: np.ndarray) -> StepResult:
        """Take one control step; success never ends an episode."""
        state, reward, _, _, info = self.sawyer.step(action)
        return self._bounded(state), float(reward), False, *self._stepped(info["success"])

    def _bounded(self, state: np.ndarray) -> np.ndarray:
        return np.clip(state, self._bounds.low, self._bounds.high)


def _goal_observable(sawyer: SawyerXYZEnv) -> SawyerXYZEnv:
    """Draw goals by the environment's own seed, and show them in the state.

    These are private attributes of metaworld 3.1.1, which no other code uses.
    """
    sawyer._partially_observable = False
    del sawyer.sawyer_observation_space  # cached while the goal was hidden; step() clips to it
    sawyer._freeze_rand_vec = False
    sawyer.seeded_rand_vec = True
    sawyer._set_task_called = True
    return sawyer
