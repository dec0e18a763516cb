"""The runner's methods: an agent, its keywords, and the shared stages that it needs.

To add a method of WPT, add one entry to `METHODS` with the keywords that differ from the preset.
To add another agent, write it as a file of `wpt_agents/agents/` and name its class here::

    "dreamer-v3": Method(keywords=DREAMER_V3, pretrained=False, needs_data=False),
    "drq-v2": Method(DrQv2, shared=(), policy="CnnPolicy", pretrained=False, needs_data=False),

A name in `AGENTS` gives it a section in the presets, whose keys are its keywords; a subclass also
uses the section of its base.

The stages (`wpt_agents.zoo.run`) need the interface of Stable-Baselines3, so SB3's own algorithms
work too: `agent(policy, env, seed=, device=, **keywords)`, `learn`, `predict`, `save`, `load`. They
also use, if available: keywords `dataset`, `embodiment` and `episode_length` in the signature, a
classmethod `pretrain` (required if `pretrained`), `prior` (the policy scored as "prior actor"),
`build_index`, `open_loop`, `updates`, and a `replay_buffer` of `wpt_agents.data.replay` together
with `episodes`, without which a killed run restarts instead of resuming.
"""

import inspect
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from typing import Any

from stable_baselines3 import SAC
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecEnv, VecFrameStack

from wpt_agents.agents.drqv2 import DrQv2
from wpt_agents.agents.jsrl import JSRL
from wpt_agents.agents.mrq import MRQ
from wpt_agents.agents.packnet import PackNet
from wpt_agents.agents.r3m import R3M
from wpt_agents.agents.rlpd import RLPD
from wpt_agents.agents.wpt import WPT
from wpt_agents.files.names import unknown_name
from wpt_agents.zoo.vec_envs import Wrap, unwrapped

# Keywords that the stages pass to an agent, so presets must not set them.
RESERVED = {
    *("self", "policy", "env", "dataset", "seed", "device", "verbose", "tensorboard_log"),
    *("embodiment", "episode_length", "policy_kwargs"),
}


# The sections of the presets with an agent's keywords, a base before its subclasses.
AGENTS: dict[str, type[BaseAlgorithm]] = {
    "drqv2": DrQv2,
    "jsrl": JSRL,
    "mrq": MRQ,
    "packnet": PackNet,
    "r3m": R3M,
    "rlpd": RLPD,
    "sac": SAC,
}
FRAMES = 3  # stacked images for SB3's agents, as for ours


def stacked(venv: VecEnv) -> VecEnv:
    """Stack the last images of each environment, for agents without memory."""
    return VecFrameStack(venv, FRAMES, channels_order="last")


def sections(agent: type[BaseAlgorithm]) -> list[str]:
    """Return the sections of the presets whose keywords an agent accepts."""
    return [name for name, known in AGENTS.items() if issubclass(agent, known)]


@dataclass(frozen=True)
class Method:
    """One algorithm with its settings.

    :param agent: the class
    :param keywords: keywords of the agent, which override the preset's
    :param pretrained: whether it starts from a pre-trained model
    :param needs_data: whether it uses the collected data
    :param shared: keywords of the preset's section `wpt` that the agent shares; None for all
    :param policy: the first argument of the agent
    :param plus: whether the preset's section `plus` applies, our additions to the paper's algorithm
    :param wrap: the wrapper of the agent's environments; SB3's agents with several frames need
        `VecTransposeImage(VecFrameStack(venv, n))`
    """

    agent: type[BaseAlgorithm] = WPT
    keywords: Mapping[str, Any] = field(default_factory=dict)
    pretrained: bool = True
    needs_data: bool = True
    shared: tuple[str, ...] | None = None
    policy: str = "WPTPolicy"
    wrap: Wrap = unwrapped
    plus: bool = False

    @property
    def section(self) -> str:
        """The section of `config.yaml` with the agent's keywords."""
        return self.agent.__name__.lower()

    def settings(self, wpt: Mapping[str, Any], specific: Mapping[str, Any]) -> dict[str, Any]:
        """Return the agent's keywords.

        :param wpt: the preset's section `wpt`
        :param specific: the keywords of the agent's own sections
        """
        kept = {k: v for k, v in wpt.items() if self.shared is None or k in self.shared}
        return {**kept, **specific, **self.keywords}

    def takes(self, keyword: str) -> bool:
        """Return whether the agent's constructor has this keyword."""
        return keyword in inspect.signature(self.agent).parameters


@cache
def defaults(agent: type[BaseAlgorithm]) -> Mapping[str, Any]:
    """Return the keywords of an agent that a preset or a method may set, with their defaults."""
    return {
        name: parameter.default
        for name, parameter in inspect.signature(agent).parameters.items()
        if name not in RESERVED and not name.startswith("_")
    }


def check_types(agent: type[BaseAlgorithm], values: Mapping[str, Any]) -> None:
    """Raise an error for text or nothing in place of a number, which SB3's agents do not check.

    Our agents check their keywords themselves.
    """
    for name, value in values.items():
        usual = defaults(agent)[name]
        if isinstance(usual, int | float) and not isinstance(value, int | float):
            raise ValueError(
                f"{name} of {agent.__name__} must be of type {type(usual).__name__} as its default "
                f"{usual!r}, got {value!r}"
            )


NO_CLONE = {"guidance": 0.0, "kickstart": 0.0, "ibrl": False, "residual": False}
ALONE = {"offline_ratio": 0.0, "adapt_steps": 0, **NO_CLONE}  # no data except the replay buffer
# DreamerV3 from scratch, with the settings of its code for images of DMControl. Differences: its
# optimiser, norms and pooling, the spacing of its bins, and the critic's regulariser on replayed
# states are not used. Its returns bootstrap from the critic, ours from the target critic. The
# continue head has no effect if no episode ends early.
DREAMER_V3 = {
    **ALONE,
    "gamma": 0.997,
    "imagine_horizon": 15,
    "ent_coef": 3e-4,
    "return_norm": True,
    "zero_init_heads": True,
    "free_nats_mode": "element",
    "actor_outscale": 0.01,
    "actor_grad": "reinforce",
    "repval_scale": 0.3,
    "slow_critic_scale": 1.0,
}
MODEL_FREE: dict[str, Any] = {"pretrained": False, "shared": (), "policy": "CnnPolicy"}
METHODS = {
    "wpt": Method(),
    "wpt+": Method(plus=True),
    "kickstart": Method(keywords={"kickstart": 20.0}),
    # Scratch has every addition that needs neither data nor a prior actor.
    "scratch": Method(keywords=ALONE, pretrained=False, needs_data=False, plus=True),
    "pretrain-only": Method(keywords=ALONE),
    "no-guidance": Method(keywords=NO_CLONE),
    "no-rehearsal": Method(keywords={"offline_ratio": 0.0}),
    "no-pretrain": Method(pretrained=False),
    "random-retrieval": Method(keywords={"retrieval": "random"}),
    "dreamer-v3": Method(keywords=DREAMER_V3, pretrained=False, needs_data=False),
    "drq-v2": Method(DrQv2, **MODEL_FREE, needs_data=False),
    "r3m": Method(R3M, shared=(), policy="CnnPolicy"),
    "jsrl-bc": Method(JSRL, **MODEL_FREE),
    # For a sequence of tasks; on a single task it equals DrQ-v2.
    "packnet": Method(PackNet, **MODEL_FREE, needs_data=False),
    "uds": Method(RLPD, {"label": "zero"}, **MODEL_FREE),
    "explore": Method(RLPD, {"label": "optimistic"}, **MODEL_FREE),
    # An upper bound for the previous two: needs --data with rewards (`collect --rewards`).
    "rlpd": Method(RLPD, {"label": "true"}, **MODEL_FREE),
    # Not in the paper: the strongest model-free method that is feasible on a CPU.
    "mrq": Method(MRQ, **MODEL_FREE, needs_data=False),
    # SB3's own algorithm: the alternative without this library.
    "sac": Method(SAC, **MODEL_FREE, needs_data=False, wrap=stacked),
}
# The methods of the ablation in Fig. 5, by their enabled parts.
ABLATION = {
    "scratch": "none",
    "pretrain-only": "P",
    "no-guidance": "P+ER",
    "wpt": "P+ER+G",
}


def find_method(name: str) -> Method:
    """Return the method of this name.

    :raises ValueError: if there is none
    """
    if name not in METHODS:
        raise unknown_name("method", name, METHODS)
    return METHODS[name]
