"""Compare with the DreamerV3 of other libraries: their models and training steps on the same batch.

An adapter builds the peer's model with the peer's own code, with our widths wherever its
configuration has the same options, and imports the peer when it is called.
"""

import runpy
import sys
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np
import torch
from gymnasium.spaces import Box, Dict

from wpt_agents.agents.wpt import WPT
from wpt_agents.data.trajectory import Batch
from wpt_agents.model.sizes import SIZES, Size
from wpt_agents.zoo.bench.model import (
    ACTIONS,
    agent,
    count,
    imagined_states,
    measured_in_turn,
    synthetic_batch,
    whole_step,
    world_model_step,
)
from wpt_agents.zoo.machine import import_extra

REPETITIONS = 3
HORIZON = 15  # imagined steps in the peers' own configurations


class Learner(NamedTuple):
    """A learner: its name, its size, and its training steps.

    The first step trains the world model with the reward head, the second is the whole update.
    """

    name: str
    params: tuple[int, int]
    imagined: int  # imagined states in an update: starts times steps
    steps: tuple[Callable[[], Any], Callable[[], Any]]


def rows(
    peer: str, quick: bool = False, threads: int = 1, precision: str = "fp32"
) -> Iterator[dict[str, Any]]:
    """Measure our steps and the peer's alternately: world model, and whole update.

    :raises ValueError: if the peer is not installed, or for anything but fp32 on a CPU
    """
    if precision != "fp32":
        raise ValueError(f"--peer measures in fp32, not in {precision}: leave --precision out")
    if torch.cuda.is_available():
        raise ValueError("--peer measures on a CPU: hide the GPU by CUDA_VISIBLE_DEVICES=-1")
    torch.set_num_threads(threads)
    size, batch, length = ("debug", 2, 8) if quick else ("small", 16, 64)
    data = synthetic_batch(batch, length)
    learners = ours(agent(size), data), PEERS[peer](SIZES[size], data)
    columns = {"size": size, "batch": batch, "length": length, "dtype": precision}
    for i, what in enumerate(("world model", "whole update")):
        cases = [
            (one.steps[i], columns | {"library": one.name, "what": what, "params": one.params[i]})
            for one in learners
        ]
        measured = measured_in_turn(cases, 1 if quick else REPETITIONS)
        medians = [row["median_s"] for row in measured]
        for one, row, median in zip(learners, measured, medians, strict=True):
            yield row | {"imagined": i * one.imagined, "ratio_to_ours": median / medians[0]}


def ours(model: WPT, batch: Batch) -> Learner:
    """Our learner; the reward head is trained with the world model, as in the peers."""
    nets = model.policy.world_model, model.policy.actor, model.policy.critic
    return Learner(
        "wpt_agents",
        (count(nets[0]), count(*nets)),
        imagined_states(model, batch),
        (world_model_step(model, batch, learn_reward=True), whole_step(model, batch)),
    )


def needed(name: str) -> ModuleType:
    """Import a module of a peer, or of its dependencies."""
    return import_extra(name, "peers")


def sheeprl(size: Size, batch: Batch) -> Learner:
    """The `dreamer_v3` of sheeprl, with the architecture of 2023 and its own training functions."""
    theirs = needed("sheeprl.algos.dreamer_v3.dreamer_v3")
    theirs.MetricAggregator.disabled = True  # without logging statistics
    cfg = sheeprl_config(size)
    fabric = theirs.Fabric(accelerator="cpu", devices=1)
    world, actor, critic, target, _ = theirs.build_agent(
        fabric, (ACTIONS,), True, cfg, Dict({"rgb": Box(0, 255, (3, 64, 64), np.uint8)})
    )
    parts = (world, cfg.algo.world_model), (actor, cfg.algo.actor), (critic, cfg.algo.critic)
    instantiate = needed("hydra.utils").instantiate
    optimizers = fabric.setup_optimizers(
        *(instantiate(c.optimizer, params=net.parameters()) for net, c in parts)
    )
    data = sheeprl_batch(batch)
    nets = world, actor, critic, target
    rest = None, cfg, True, (ACTIONS,), theirs.Moments()
    return Learner(
        f"sheeprl {version('sheeprl')}",
        (count(world), count(world, actor, critic)),
        HORIZON * batch.is_first.numel(),
        (
            lambda: theirs.world_model_learning(fabric, cfg, world, optimizers[0], data),
            lambda: theirs.train(fabric, *nets, *optimizers, data, *rest),
        ),
    )


def sheeprl_config(size: Size) -> Any:
    """Return its defaults with our widths; two layers per head give the closest parameter count."""
    widths = {
        "dense_units": size.units,
        "mlp_layers": 2,
        "horizon": HORIZON,
        "world_model.stochastic_size": size.stoch,
        "world_model.discrete_size": size.classes,
        "world_model.encoder.cnn_channels_multiplier": size.depth,
        "world_model.recurrent_model.recurrent_state_size": size.deter,
        "world_model.recurrent_model.dense_units": size.hidden,
        "world_model.transition_model.hidden_size": size.hidden,
        "world_model.representation_model.hidden_size": size.hidden,
    }
    overrides = ["exp=dreamer_v3", "env=dummy", "algo.mlp_keys.encoder=[]"]
    overrides += [f"algo.{key}={value}" for key, value in widths.items()]
    hydra = needed("hydra")
    with hydra.initialize_config_module("sheeprl.configs", version_base="1.3"):
        cfg = hydra.compose("config", overrides=overrides)
    plain = needed("omegaconf").OmegaConf.to_container(cfg, resolve=True)
    return needed("sheeprl.utils.utils").dotdict(plain)


def sheeprl_batch(batch: Batch) -> dict[str, torch.Tensor]:
    """Its layout: time first, channels first, all float32."""
    streams = {
        "rgb": batch.image.permute(0, 1, 4, 2, 3),
        "actions": batch.action.roll(-1, 1),  # it pairs each image with the following action
        "rewards": batch.reward[..., None],
        "terminated": batch.is_terminal[..., None],
        "is_first": batch.is_first[..., None],
    }
    return {key: value.transpose(0, 1).float().contiguous() for key, value in streams.items()}


def torchrl(size: Size, batch: Batch) -> Learner:
    """The DreamerV3 of torchrl's `sota-implementations`, which its wheel includes."""
    cfg = needed("omegaconf").OmegaConf.create(torchrl_config(size))
    with torchrl_example() as example, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        learner = example["_build_learner"](cfg, torch.device("cpu"), 0, ACTIONS, (3, 64, 64))
        update = example["_make_learner_update"](cfg, torch.device("cpu"), learner)
    data = torchrl_batch(size, batch)

    def world_model() -> None:
        losses, _ = learner.model_loss(data.clone(recurse=False))
        learner.optimizer.zero_grad()
        sum(losses.values()).sum().backward()
        learner.optimizer.step()

    trained = [p.numel() for group in learner.optimizer.param_groups for p in group["params"]]
    return Learner(
        f"torchrl {version('torchrl')}",
        (count(learner.world_model), sum(trained)),
        HORIZON * batch.is_first.numel(),
        (world_model, lambda: update.step(None, data.clone(recurse=False))),
    )


@contextmanager
def torchrl_example() -> Iterator[dict[str, Any]]:
    """Return the names that its training script defines; modules beside it can be imported."""
    library = needed("torchrl")
    folder = Path(str(library.__file__)).parents[1] / "sota-implementations" / "dreamer_v3"
    if not (folder / "train.py").exists():
        raise ValueError(
            f"torchrl {version('torchrl')} came without {folder.name}/train.py, the model and "
            'training step to measure; 0.14.1 has it: pip install "wpt-agents[peers]"'
        )
    sys.path.insert(0, str(folder))
    try:
        yield runpy.run_path(str(folder / "train.py"), run_name="bench")
    finally:
        sys.path.remove(str(folder))


def torchrl_config(size: Size) -> dict[str, Any]:
    """Return its `networks`, `optimization` and `env` options, with our widths where possible."""
    networks = {
        "hidden_dim": 2 * size.hidden,  # of heads, too; matches our parameter count
        "rnn_hidden_dim": size.deter,
        "num_categoricals": size.stoch,
        "num_classes": size.classes,
        "image_depth": size.depth,
        "image_mults": [1, 2, 4, 8],
        "image_kernel_size": 5,
        "image_decoder_blocks": size.blocks,
        "recurrent_model": "block_gru",
        "num_blocks": size.blocks,
        **{"dynamics_layers": 1, "prior_layers": 2, "posterior_layers": 1},
        **{"reward_layers": 1, "actor_layers": 3, "value_layers": 3},
        **{"num_reward_bins": 255, "num_value_bins": 255, "unimix": 0.01, "norm_eps": 1e-4},
        **{"policy_min_std": 0.1, "policy_max_std": 1.0},
    }
    optimization = {
        **{"compile": "auto", "compile_train_step": None, "compile_rssm": None},
        **{"cudagraph_train_step": None, "compile_train_step_mode": "default"},
        **{"rssm_scan_unroll": 8, "mixed_precision": False, "separate_policy_rng": False},
        **{"free_bits": 1.0, "dynamic_loss_weight": 1.0, "representation_loss_weight": 0.1},
        **{"imagination_horizon": HORIZON, "continuation_horizon": 333, "lmbda": 0.95},
        **{"gamma": 1 - 1 / 333, "use_reinforce": True, "replay_value_loss_weight": 0.3},
        **{"return_normalization_rate": 0.01, "return_normalization_min_scale": 1.0},
        **{"slow_critic_regularization": 1.0, "slow_critic_tau": 0.02, "lr": 4e-5},
        **{"adaptive_grad_clip": 0.3, "optimizer_eps": 1e-20, "warmup_steps": 1000},
    }
    env = {  # used only for its action width, six
        **{"backend": "gym", "name": "HalfCheetah-v5", "seed": 0, "use_seed": False},
        **{"max_episode_steps": 1000, "vector_key": "observation", "pixels_key": "pixels"},
    }
    return {"networks": networks, "optimization": optimization, "env": env}


def torchrl_batch(size: Size, batch: Batch) -> Any:
    """Its layout: an action beside the image that it led to, channels first."""
    shape = batch.reward.shape
    no = torch.zeros_like(batch.is_first[..., None])
    return needed("tensordict").TensorDict(
        {
            "state": torch.zeros(*shape, size.stoch * size.classes),
            "belief": torch.zeros(*shape, size.deter),
            "action": batch.action,
            "is_init": batch.is_first[..., None],
            "next": {
                "pixels": batch.image.permute(0, 1, 4, 2, 3).contiguous(),
                "reward": batch.reward[..., None],
                **{"done": no, "terminated": no, "truncated": no},
            },
        },
        shape,
    )


PEERS = {"sheeprl": sheeprl, "torchrl": torchrl}
