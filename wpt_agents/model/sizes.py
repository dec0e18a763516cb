"""The widths of all networks, by name."""

import math
from collections.abc import Mapping
from dataclasses import MISSING, asdict, dataclass, fields
from typing import Any

from wpt_agents.files.names import unknown_name

NORM_EPS = 1e-3  # as in DreamerV3; torch's default is 1e-5
GATES = ("within", "across")


@dataclass(frozen=True)
class Size:
    """The widths of all networks, and the learning rates and budgets that suit them.

    The defaults of learning rates and budgets are those of Table 2, also for a `Size` with other
    widths.

    :param deter: width of h
    :param hidden: width of the layers inside the RSSM
    :param stoch: number of groups of z
    :param classes: number of classes in each group of z
    :param depth: channels of the first convolution
    :param units: width of the heads: actor, critic and reward
    :param learning_rate: for the world model and the reward head
    :param actor_critic_learning_rate: for the actor and the critic
    :param stabilised: whether heads start at zero and returns are normalised, as in DreamerV3
    :param blocks: number of blocks of the block-diagonal layers
    :param gates: how the GRU's last layer orders its gates: "within" each block, as in DreamerV3,
        or "across" the blocks, as in the weights that the paper's authors publish
    :param norm_eps: eps of every layer norm except those over a convolution's channels (1e-3)
    :param imagine_starts: states from which imagination starts in an update; 0 for all of them
    :param pretrain_steps: updates of the world model in pre-training
    :param num_retrieve: trajectories to retrieve for a task
    :param bc_steps: updates of the prior actor
    :param bc_batch_size: images and actions in an update of the prior actor
    :param learning_starts: steps that are collected before the first update
    :param warmup_steps: steps in which the prior actor alone acts
    :param guidance: schedule of the probability that an episode is guided
    """

    deter: int
    hidden: int
    stoch: int
    classes: int
    depth: int
    units: int
    learning_rate: float = 1e-4  # Table 2
    actor_critic_learning_rate: float = 8e-5  # Table 2
    stabilised: bool = True  # not in the paper, but in every size below its own (docs/paper.md)
    blocks: int = 8  # as in DreamerV3
    gates: str = "within"  # as in DreamerV3; "across", a block decides over units of others
    norm_eps: float = NORM_EPS
    imagine_starts: int = 0
    pretrain_steps: int = 200_000  # Table 2, as all that follow
    num_retrieve: int = 500
    bc_steps: int = 150_000
    bc_batch_size: int = 256
    learning_starts: int = 5_000
    warmup_steps: int = 7_500
    guidance: str | float = "linear(1,0,50000)"

    def __post_init__(self) -> None:
        widths = ("deter", "hidden", "stoch", "classes", "depth", "units", "blocks")
        for name in (*widths, "pretrain_steps"):
            value = getattr(self, name)
            if not isinstance(value, int) or isinstance(value, bool) or value < 1:
                raise ValueError(f"Size.{name} must be a whole number of at least 1, got {value!r}")
        for name, factor in (("deter", 1), ("hidden", 2), ("units", 2)):
            value = getattr(self, name)
            if value * factor % self.blocks:
                raise ValueError(f"Size.{name}={value} cannot be divided into {self.blocks} blocks")
        if self.gates not in GATES:
            raise unknown_name("gate layout", self.gates, GATES)
        for name in ("norm_eps", "learning_rate", "actor_critic_learning_rate"):
            value = getattr(self, name)
            if not isinstance(value, int | float) or not 0 < value < math.inf:
                raise ValueError(f"Size.{name} must be a number above 0, got {value!r}")


#: The sizes by name. Table 2 prints 12288 as hidden and 1536 as deterministic for `paper`. Only the
#: other way round does the world model have the 280 M parameters of the text, as a test counts
#: (tests/model/test_world_model.py). The others are ours: small enough for a CPU, with rates that
#: grow as widths shrink, and with the budgets of the presets in the folder `zoo`, rounded.
#:
#: :meta hide-value:
SIZES = {
    # deter, hidden, stoch, classes, depth, units; learning rates of world model and of actor-critic
    "debug": Size(
        *(64, 32, 8, 8, 4, 32, 1e-3, 1e-3),
        pretrain_steps=200,
        num_retrieve=5,
        bc_steps=200,
        bc_batch_size=32,
        learning_starts=200,
        warmup_steps=200,
        guidance="linear(1,0,1000)",
    ),
    "tiny": Size(
        *(128, 64, 8, 8, 8, 128, 1e-3, 4e-4),
        pretrain_steps=2_500,
        num_retrieve=20,
        bc_steps=2_000,
        bc_batch_size=64,
        learning_starts=500,
        warmup_steps=500,
        guidance="linear(1,0,4000)",
    ),
    # `mid` has more groups of z and a wider h, in proportion, as DreamerV3's smallest preset does.
    "mid": Size(
        *(512, 128, 32, 8, 16, 256, 6e-4, 3e-4),
        imagine_starts=128,
        pretrain_steps=7_000,
        num_retrieve=40,
        bc_steps=4_000,
        bc_batch_size=64,
        learning_starts=1_000,
        warmup_steps=1_000,
        guidance="linear(1,0.1,12000)",
    ),
    "small": Size(
        *(256, 128, 16, 16, 16, 256, 6e-4, 3e-4),
        pretrain_steps=20_000,
        num_retrieve=200,
        bc_steps=20_000,
    ),
    "medium": Size(1024, 512, 32, 32, 32, 512, 2e-4, 1e-4, pretrain_steps=100_000),
    "paper": Size(12288, 1536, 32, 96, 96, 512, 1e-4, 8e-5, stabilised=False),
}


def find_size(size: str | Size | Mapping[str, Any]) -> Size:
    """Return the size of this name, or with these fields.

    :raises ValueError: an unknown name or field, a missing field, a value that makes no sense
    """
    if isinstance(size, Size):
        return size
    if not isinstance(size, Mapping):
        if not isinstance(size, str) or size not in SIZES:
            raise unknown_name("size", size, SIZES)
        return SIZES[size]
    known = {field.name: field.default is MISSING for field in fields(Size)}
    for name in size:
        if name not in known:
            raise unknown_name("field of Size", name, known)
    lacking = [name for name, required in known.items() if required and name not in size]
    if lacking:
        raise ValueError(f"size={dict(size)} lacks {', '.join(lacking)}")
    return Size(**size)


def plain_size(size: str | Size | Mapping[str, Any]) -> str | dict[str, Any]:
    """Return the name of a size, or its fields if it has no name, as a model file stores it."""
    widths = find_size(size)
    return next((name for name, known in SIZES.items() if known == widths), asdict(widths))
