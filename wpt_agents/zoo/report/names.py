"""How the policies of runs are called in tables, records and pages."""

from wpt_agents.agents.wpt import WPT
from wpt_agents.zoo.plan.methods import METHODS
from wpt_agents.zoo.result import NOTHING, PRIOR_ACTOR, RANDOM, UNTRAINED, Result

TITLES = {NOTHING: "doing nothing", RANDOM: "random policy"}
WPT_CLONES = [  # methods whose prior actor is that of `wpt`, if they have one
    name
    for name, method in METHODS.items()
    if method.agent is WPT and method.pretrained and "retrieval" not in method.keywords
]


def policy_name(result: Result, policy: str) -> str:
    """Return 'wpt', 'wpt, last', 'prior actor', 'prior actor, no-pretrain', 'random'.

    The policy that a run counts for bears the name of the method alone. The prior actor of the
    methods that clone as `wpt` does bears none.
    """
    if policy in UNTRAINED:
        return policy
    if policy == result.final_policy:
        return result.method
    if policy == PRIOR_ACTOR:
        return policy if result.method in WPT_CLONES else f"{policy}, {result.method}"
    return f"{result.method}, {policy}"


def policy_title(name: str) -> str:
    """Return the words of a table for a name of `policy_name`."""
    return TITLES.get(name, name)
