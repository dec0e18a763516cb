"""`acting_step` in few operators, for a CPU.

At batch 1 there is little arithmetic. The time goes into calling operators, into reading weights
across their order in memory, and into copying them into another order. Here these copies are kept,
and are made again only when weights have changed: between two episodes, not between two steps.
"""

from typing import Any
from weakref import WeakKeyDictionary

from torch import Tensor

from wpt_agents.fast.acting_networks import FastActor, FastEncoder, FastFilter
from wpt_agents.fast.conditions import on_cpu
from wpt_agents.model.actor_critic import Actor
from wpt_agents.model.distributions import Noise
from wpt_agents.model.images import Encoder
from wpt_agents.model.policy import WPTPolicy, acting_step
from wpt_agents.model.rssm import RSSM, Latent


class FastStep:
    """`acting_step` with the weights that a policy's networks have now; see `is_current`."""

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
        # keep the memory of the present weights, so that no other weight gets the same address
        self.memory = [module[name].detach() for module, name in self.places]

    def is_current(self, policy: WPTPolicy) -> bool:
        """Return whether no weight has changed since this was made."""
        same = all(a is b for a, b in zip(self.networks, networks_of(policy), strict=True))
        return same and self.marks == self._marks(policy)

    def _marks(self, policy: WPTPolicy) -> tuple[int, list[tuple[int, int]]]:
        """Return the policy's count of updates, and each weight's address and version.

        The count is for fused optimisers, which do not raise the versions that autograd keeps.
        Addresses and versions are for changes that nobody counts: by `AveragedModel`, by
        `polyak_update`, by `vector_to_parameters`, or by hand.
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
        """Return the new state, and the actor's outputs (N, 2 A) there."""
        if is_first.any():
            keep = (~is_first).float()[:, None]
            state = Latent(state.deter * keep, state.stoch * keep[..., None])
            action = action * keep
        state = self.filter(state, action, self.encode(image), generator, sample)
        return state, self.outputs(state)


# A policy's fast step, as long as the policy exists. It is not an attribute of the policy, so that
# copying, pickling and saving a policy need not know of it.
_fast_steps: WeakKeyDictionary[WPTPolicy, FastStep] = WeakKeyDictionary()


def networks_of(policy: WPTPolicy) -> tuple[Encoder, RSSM, Actor]:
    """Return the networks that act."""
    return policy.world_model.encoder, policy.world_model.rssm, policy.acting_actor


def fast_step(policy: WPTPolicy) -> FastStep:
    """Return the step for the policy's present weights, made again if they have changed."""
    step = _fast_steps.get(policy)
    if step is None or not step.is_current(policy):
        step = FastStep(policy)
        _fast_steps[policy] = step
    return step


def networks_are_known(policy: WPTPolicy, *_: Any, **__: Any) -> bool:
    """Return whether these classes act, not subclasses, on a CPU, with weights that have versions.

    `torch.compile` and users replace networks by others, of which nothing is known here. Weights
    that were made in `torch.inference_mode` have no versions.
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
    """`acting_step` with copies of the weights in the order in which they are read."""
    return fast_step(policy)(image, state, action, is_first, generator, sample)
