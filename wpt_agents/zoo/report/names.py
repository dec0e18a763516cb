"""The names of policies in tables, records and pages, and what they mean."""

from wpt_agents.agents.wpt import WPT
from wpt_agents.zoo.plan.methods import METHODS
from wpt_agents.zoo.result import NOTHING, PRIOR_ACTOR, RANDOM, UNTRAINED, Result

TITLES = {NOTHING: "doing nothing", RANDOM: "random policy"}
WPT_CLONES = [  # methods with the same prior actor as `wpt`, if they have one
    name
    for name, method in METHODS.items()
    if method.agent is WPT and method.pretrained and "retrieval" not in method.keywords
]
MEANINGS = {  # of the methods, for readers who have not seen the documentation
    "wpt": "the paper's method: a world model is pre-trained on data without rewards; fine-tuning "
    "also replays the retrieved trajectories that start most like the task (rehearsal), and a "
    "policy that imitates them, the prior actor, acts in part of the early episodes (guidance)",
    "wpt+": "wpt with the additions to the paper's algorithm in the section plus of the preset",
    "kickstart": "wpt, whose actor also imitates the prior actor",
    "scratch": "the same agent without pre-training, data or prior actor",
    "pretrain-only": "wpt without rehearsal and guidance",
    "no-guidance": "wpt without guidance",
    "no-rehearsal": "wpt without rehearsal",
    "no-pretrain": "wpt with a new world model",
    "random-retrieval": "wpt with trajectories that are drawn at random",
    "dreamer-v3": "our agent with DreamerV3's losses and settings, without any data",
    "drq-v2": "DrQ-v2, a model-free agent, without any data",
    "r3m": "DrQ-v2 on the features of an encoder that was pre-trained as in R3M",
    "jsrl-bc": "DrQ-v2 after a behaviour clone, which acts at the beginning of each episode (JSRL)",
    "packnet": "DrQ-v2 for a sequence of tasks, each of which keeps its own weights (PackNet)",
    "uds": "a model-free agent (RLPD) with the data, whose rewards are set to zero",
    "explore": "a model-free agent (RLPD) with the data, whose rewards are optimistic guesses",
    "rlpd": "a model-free agent (RLPD) with the data and their true rewards",
    "mrq": "MR.Q, a model-free agent whose features come from a model, without any data",
    "sac": "soft actor-critic of Stable-Baselines3 on three stacked images, without any data",
}


def is_added(name: str) -> bool:
    """Return whether a policy is of a method that was added to those of the library."""
    method, comma, _ = name.partition(",")
    return not comma and method not in MEANINGS and method not in (*UNTRAINED, PRIOR_ACTOR)


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
