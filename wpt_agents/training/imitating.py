"""Let the actor imitate the prior actor from fixed latent states (`imitation_steps`).

In the head start every update of the actor follows one of the world model, which takes far longer.
This stage does not change the world model, computes the latent states of some batches once, and
makes many short updates of the actor on them. Not in the paper.
"""

from collections.abc import Iterable
from copy import deepcopy

import torch
from torch import Tensor
from torch.optim.lr_scheduler import LinearLR

from wpt_agents.data.trajectory import Batch
from wpt_agents.model.actor_critic import Actor
from wpt_agents.model.behavior_cloning import FRAMES, bc_loss
from wpt_agents.training.learner import Learner
from wpt_agents.training.randomness import Purpose, Streams

STEPS_PER_BATCH = 100  # how many updates share the states of a batch


@torch.no_grad()
def states_and_advice(
    learner: Learner, batches: Iterable[Batch], streams: Streams
) -> tuple[Tensor, Tensor]:
    """Return the states of replayed images and the prior actor's actions on them.

    :param batches: (B, T) sequences; states before the third image have no action
    :return: (N, D + S*K), the features of the sampled states, and (N, A)
    """
    feats, advice = [], []
    for number, batch in enumerate(batches):
        generator = streams.torch(Purpose.IMITATE, number, learner.policy.device)
        with learner.autocast():
            post, _, _ = learner.policy.world_model.observe(batch, generator)
        feats.append(post.feat[:, FRAMES - 1 :].flatten(0, 1).float())
        advice.append(learner.advice(batch).float())
    return torch.cat(feats), torch.cat(advice)


def imitate(
    learner: Learner,
    batches: Iterable[Batch],
    steps: int,
    batch_size: int,
    streams: Streams,
) -> tuple[Actor, Tensor]:
    """Train a copy of the actor, so that an interruption leaves nothing half-learned.

    Its learning rate is that of actor and critic and falls linearly to 0.

    :param batches: replayed sequences, from which the states come
    :param steps: number of updates
    :param batch_size: number of states in an update
    :return: the trained copy, and the last loss
    """
    feats, advice = states_and_advice(learner, batches, streams)
    mask = learner.policy.action_mask
    actor = deepcopy(learner.policy.actor)
    optimizer = learner.adam([list(actor.parameters())], learner.actor_critic_rate)
    falling = LinearLR(optimizer, 1.0, 0.0, steps)
    rng = streams.numpy(Purpose.IMITATE, steps)
    loss = torch.zeros(())
    for _ in range(steps):
        chosen = torch.from_numpy(rng.integers(len(feats), size=batch_size)).to(feats.device)
        with learner.autocast():
            loss = bc_loss(actor.dist(feats[chosen], mask).mode, advice[chosen], mask)
        learner.descend(optimizer, loss, "imitation")
        falling.step()
    return actor, loss.detach()
