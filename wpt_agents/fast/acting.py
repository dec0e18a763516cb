"""`acting_step` with few operators, for a CPU.

At batch size 1 there is little arithmetic. Most of the time is spent on calling operators, on
reading weights against their order in memory, and on copying them into another order. These copies
are cached here, and renewed only when weights have changed: between episodes, unless
`train_freq="step"`.
"""

from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
import torch
from torch import Tensor

from wpt_agents.fast.acting_networks import FastActor, FastEncoder, FastFilter
from wpt_agents.fast.conditions import on_cpu
from wpt_agents.model.actor_critic import Actor
from wpt_agents.model.distributions import Noise
from wpt_agents.model.images import Encoder
from wpt_agents.model.policy import WPTPolicy, acting_step
from wpt_agents.model.rssm import RSSM, Latent


class FastStep:
    """`acting_step` with the current weights of a policy's networks; see `is_current`."""

    def __init__(self, policy: WPTPolicy) -> None:
        self.networks = networks_of(policy)
        encoder, rssm, actor = self.networks
        self.encode = FastEncoder(encoder)
        self.filter = FastFilter(rssm)
        self.outputs = FastActor(actor, rssm.size.classes)
        self.places: list[tuple[dict[str, Any], str]] = [
            (module._parameters, name)
            for network in self.networks
            for module in network.modules()
            for name in module._parameters
        ]
        self.marks = self._marks(policy)
        # keep the current weights alive, so that no other weight gets the same address
        self.memory = [module[name].detach() for module, name in self.places]
        self.samples = [last_entry(weight) for weight in self.memory]
        self.values = [sample.tobytes() for sample in self.samples]

    def is_current(self, policy: WPTPolicy) -> bool:
        """Return whether the weights are unchanged since this was created."""
        same = all(a is b for a, b in zip(self.networks, networks_of(policy), strict=True))
        same = same and self.marks == self._marks(policy)
        return same and self.values == [sample.tobytes() for sample in self.samples]

    def _marks(self, policy: WPTPolicy) -> tuple[int, list[tuple[int, int]]]:
        """Return the policy's count of updates, and each weight's address and version.

        The count detects updates by fused optimisers, which do not increase autograd's versions.
        Addresses and versions detect the changes by `AveragedModel`, `vector_to_parameters`, and
        by hand. What writes into `weight.data`, such as SB3's `polyak_update`, changes neither,
        but it changes the values, of which `is_current` compares one of each weight.
        """
        weights = (module[name] for module, name in self.places)
        return policy.updates, [(weight.data_ptr(), weight._version) for weight in weights]

    def __call__(
        self,
        image: Tensor,
        state: Latent,
        action: Tensor,
        is_first: Tensor,
        generator: Noise,
        sample: bool,
    ) -> tuple[Latent, Tensor]:
        """Return the new state and the actor's outputs (N, 2 A)."""
        if is_first.any():
            keep = (~is_first).float()[:, None]
            state = Latent(state.deter * keep, state.stoch * keep[..., None])
            action = action * keep
        state = self.filter(state, action, self.encode(image), generator, sample)
        return state, self.outputs(state)


def last_entry(weight: Tensor) -> np.ndarray:
    """Return the bytes of a weight's last entry, in the memory of the weight."""
    entry = weight[(slice(-1, None),) * weight.dim()].reshape(1)
    array: np.ndarray = entry.view(torch.uint8).numpy()
    return array


# The fast step of each policy, for as long as the policy exists. It is not an attribute of the
# policy, so that copying, pickling and saving a policy are unaffected.
_fast_steps: WeakKeyDictionary[WPTPolicy, FastStep] = WeakKeyDictionary()


def networks_of(policy: WPTPolicy) -> tuple[Encoder, RSSM, Actor]:
    """Return the networks that act."""
    return policy.world_model.encoder, policy.world_model.rssm, policy.acting_actor


def fast_step(policy: WPTPolicy) -> FastStep:
    """Return the step for the policy's current weights; renew it if they have changed."""
    step = _fast_steps.get(policy)
    if step is None or not step.is_current(policy):
        step = FastStep(policy)
        _fast_steps[policy] = step
    return step


def networks_are_known(policy: WPTPolicy, *_: Any, **__: Any) -> bool:
    """Return whether the networks are exactly these classes, on a CPU, with versioned weights.

    `torch.compile` and users may replace networks with unknown ones. Weights that were created in
    `torch.inference_mode` have no versions.
    """
    encoder, rssm, actor = networks_of(policy)
    # `type` and not `isinstance`: a subclass may compute something else
    known = type(encoder) is Encoder and type(rssm) is RSSM and type(actor) is Actor
    return known and on_cpu(rssm.post_in.bias) and not rssm.post_in.bias.is_inference()


@acting_step.faster(when=networks_are_known)
def acting_step_with_copies(
    policy: WPTPolicy,
    image: Tensor,
    state: Latent,
    action: Tensor,
    is_first: Tensor,
    generator: Noise = None,
    sample: bool = True,
) -> tuple[Latent, Tensor]:
    """`acting_step` with cached copies of the weights in reading order."""
    return fast_step(policy)(image, state, action, is_first, generator, sample)
