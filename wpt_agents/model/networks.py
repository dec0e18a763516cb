"""The old place of sizes, layers and images; import them from their own modules."""

from wpt_agents.model.images import Decoder, Encoder, to_uint8, to_unit
from wpt_agents.model.layers import (
    BlockLinear,
    ChannelNorm,
    DownConv,
    Head,
    Linear,
    LinearNorm,
    UpConv,
    frozen,
)
from wpt_agents.model.sizes import GATES, NORM_EPS, SIZES, Size, find_size, plain_size

__all__ = [
    "GATES",
    "NORM_EPS",
    "SIZES",
    "BlockLinear",
    "ChannelNorm",
    "Decoder",
    "DownConv",
    "Encoder",
    "Head",
    "Linear",
    "LinearNorm",
    "Size",
    "UpConv",
    "find_size",
    "frozen",
    "plain_size",
    "to_uint8",
    "to_unit",
]
