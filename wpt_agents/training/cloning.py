"""Behaviour cloning (Algorithm 1): train the prior actor to imitate trajectories."""

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from copy import deepcopy
from dataclasses import dataclass
from typing import Self

from torch import Tensor
from torch.optim import AdamW
from torch.optim.lr_scheduler import LinearLR

from wpt_agents.data.bars import shown
from wpt_agents.data.trajectory import Trajectory
from wpt_agents.model.behavior_cloning import (
    PriorActor,
    TrajectoryVariances,
    bc_loss,
    draw_pairs,
    random_shift,
)
from wpt_agents.training.descent import descend
from wpt_agents.training.keywords import Keywords
from wpt_agents.training.randomness import Purpose, Streams


@dataclass(frozen=True)
class Cloning:
    """The settings of behaviour cloning.

    :param steps: number of updates
    :param batch_size: number of images and actions in an update
    :param learning_rate: at the first update; it falls linearly to 0
    :param shift: largest shift of the images, in pixels
    :param variance: "fixed", or "trajectory", an estimate for each trajectory
    :param grad_clip: largest norm of the gradient
    """

    steps: int
    batch_size: int
    learning_rate: float
    shift: int
    variance: str
    grad_clip: float = 100.0

    @classmethod
    def of(cls, keywords: Keywords, grad_clip: float = 100.0) -> Self:
        """Read the keywords of an agent whose names begin with `bc_`."""
        names = ("steps", "batch_size", "learning_rate", "shift", "variance")
        return cls(grad_clip=grad_clip, **{name: keywords.value(f"bc_{name}") for name in names})


def clone(
    prior_actor: PriorActor,
    trajectories: Sequence[Trajectory],
    action_mask: Tensor,
    settings: Cloning,
    streams: Streams,
    progress_bar: bool = False,
    autocast: Callable[[], AbstractContextManager[None]] = nullcontext,
) -> PriorActor:
    """Train a copy of a prior actor, so that an interruption leaves nothing half-learned.

    :param prior_actor: the network to start from, which is not changed
    :param trajectories: the trajectories to imitate
    :param action_mask: (A,) bool, False in the padding
    :param settings: the settings
    :param streams: source of the random numbers
    :param progress_bar: show a progress bar
    :param autocast: makes the context of a forward pass
    :return: the trained copy
    """
    actor = deepcopy(prior_actor)
    device = action_mask.device
    # The authors' Adam: without decay AdamW is the same.
    optimizer = AdamW(actor.parameters(), settings.learning_rate, weight_decay=0)
    # A constant rate keeps the noise of the last steps; a fall to 0 averages it out. A deviation
    # from the paper, which prints one rate (docs/paper.md).
    falling = LinearLR(optimizer, 1.0, 0.0, settings.steps)
    estimated = settings.variance == "trajectory"
    variances = TrajectoryVariances(len(trajectories), device) if estimated else None
    for step in shown(range(settings.steps), settings.steps, "clone", progress_bar):
        rng = streams.numpy(Purpose.CLONE, step)
        pairs = draw_pairs(trajectories, settings.batch_size, len(action_mask), rng)
        image, action, chosen = (tensor.to(device) for tensor in pairs)
        with autocast():
            generator = streams.torch(Purpose.CLONE, step, device)
            image = random_shift(image, settings.shift, generator)
            prediction, weight = actor(image), None
            if variances is not None:
                variances.update(prediction, action, action_mask, chosen)
                weight = variances.weights()[chosen]
            loss = bc_loss(prediction, action, action_mask, weight)
        descend(optimizer, loss, "bc", settings.grad_clip)
        falling.step()
    return actor
