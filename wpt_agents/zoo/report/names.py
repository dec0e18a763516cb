"""The names of policies in tables, records and pages."""

from wpt_agents.agents.wpt import WPT
from wpt_agents.zoo.plan.methods import METHODS
from wpt_agents.zoo.result import NOTHING, PRIOR_ACTOR, RANDOM, UNTRAINED, Result

TITLES = {NOTHING: "doing nothing", RANDOM: "random policy"}
WPT_CLONES = [  # methods with the same prior actor as `wpt`, if they have one
    name
    for name, method in METHODS.items()
    if method.agent is WPT and method.pretrained and "retrieval" not in method.keywords
]


def policy_name(result: Result, policy: str) -> str:
    """Return 'wpt', 'wpt, last', 'prior actor', 'prior actor, no-pretrain', 'random'.

    The policy that counts for a run has the name of the method. The name of a prior actor omits the
    method if it is trained as in `wpt`.
    """
    if policy in UNTRAINED:
        return policy
    if policy == result.final_policy:
        return result.method
    if policy == PRIOR_ACTOR:
        return policy if result.method in WPT_CLONES else f"{policy}, {result.method}"
    return f"{result.method}, {policy}"


def policy_title(name: str) -> str:
    """Return the label in tables for a name of `policy_name`."""
    return TITLES.get(name, name)
