"""The methods that the runner knows: an agent, its keywords, and the shared stages it needs."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class Method:
    """Which of the paper's parts are on.

    :param wpt: keywords of WPT that switch the others off
    """

    pretrained: bool = True
    needs_data: bool = True
    wpt: Mapping[str, Any] = field(default_factory=dict)


ALONE = {"offline_ratio": 0.0, "guidance": 0.0, "kickstart": 0.0}  # no data beside the replay


METHODS = {
    "wpt": Method(),
    "kickstart": Method(wpt={"kickstart": 20.0}),
    "scratch": Method(False, False, ALONE),
    "pretrain-only": Method(wpt=ALONE),
    "no-guidance": Method(wpt={"guidance": 0.0, "kickstart": 0.0}),
    "no-rehearsal": Method(wpt={"offline_ratio": 0.0}),
    "no-pretrain": Method(pretrained=False),
    "random-retrieval": Method(wpt={"retrieval": "random"}),
}


ABLATION = {
    "scratch": "none",
    "pretrain-only": "P",
    "no-guidance": "P+ER",
    "wpt": "P+ER+G",
}  # Fig. 5
