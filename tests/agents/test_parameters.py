"""Parameters that one agent hands to another: it then acts, and learns, as the first one does."""

from collections import defaultdict

import pytest
import torch
from debug_agent import SETTINGS, ClockEnv, noise, recorded, same, weights

from wpt_agents import JSRL, MRQ, R3M, RLPD, WPT, DrQv2, PackNet
from wpt_agents.agents.curious import ICMExplorer, Plan2Explore
from wpt_agents.training.model_files import optimizers

SMALL = {"seed": 0, "device": "cpu", "batch_size": 4, "learning_starts": 0, "warmup_steps": 0}
FRAMES = {**SMALL, "channels": 4, "hidden_dim": 8, "update_every": 7, "train_freq": "episode"}
DEBUG = {**SETTINGS, **SMALL, "train_ratio": 2}
NOISY = {**FRAMES, "std": 0.3}
CLONING = {"bc_size": "debug", "bc_steps": 2, "bc_batch_size": 4}
EXPLORER = {**DEBUG, "offline_ratio": 0.0, "guidance": 0.0}
AGENTS = [
    (WPT, {**DEBUG, "residual": True, "actor_average": 0.1, "reward_ensemble": 2}),
    (ICMExplorer, EXPLORER),
    (Plan2Explore, EXPLORER),
    (DrQv2, NOISY),
    (JSRL, {**NOISY, **CLONING}),
    (MRQ, {**FRAMES, "latent_dim": 8, "horizon": 3, "sync_every": 4}),
    (PackNet, NOISY),
    (R3M, NOISY),
    (RLPD, {**FRAMES, "critics": 3, "label": "optimistic", "reward_members": 2}),
]
pytestmark = pytest.mark.filterwarnings("ignore:.*offline data", "ignore:.*dataset= has no effect")


@pytest.mark.parametrize("by_file", [False, True])
@pytest.mark.parametrize(("kind", "keywords"), AGENTS, ids=lambda x: getattr(x, "__name__", ""))
def test_an_agent_with_anothers_parameters_acts_and_learns_like_it(
    kind, keywords, by_file, tmp_path
):
    policy = next(iter(kind.policy_aliases))
    data = None
    if kind in (WPT, JSRL, RLPD):
        keywords = {**keywords, "embodiment": "dot"}
        data = [recorded(seed=i, embodiment="dot") for i in range(3)]
    one = kind(policy, ClockEnv(terminates=True), dataset=data, **keywords).learn(42)
    other = kind(policy, ClockEnv(), **keywords)
    one.save(tmp_path / "model")
    other.set_parameters(tmp_path / "model" if by_file else one.get_parameters())
    torch.manual_seed(0)
    ours, _ = one.predict(noise(3))
    torch.manual_seed(0)
    theirs, _ = other.predict(noise(3))
    assert (ours == theirs).all()
    if kind in (WPT, JSRL):
        assert one.prior is not None and other.prior is not None
    for name in ("updates", "num_timesteps", "episodes", "task_updates", "_total_timesteps"):
        if hasattr(one, name):
            setattr(other, name, getattr(one, name))  # schedules and random numbers go by these
    other.replay_buffer, other.retrieved = one.replay_buffer, one.retrieved
    for model in (one, other):
        for _ in range(2):
            model.update(defaultdict(list))
    assert one.updates > 2 and same(weights(one), weights(other))


@pytest.mark.parametrize(("kind", "keywords"), AGENTS, ids=lambda x: getattr(x, "__name__", ""))
def test_learning_rates_stay_those_of_the_agents_own_keywords(kind, keywords):
    policy = next(iter(kind.policy_aliases))
    one, other = (kind(policy, ClockEnv(), learning_rate=x, **keywords) for x in (1e-3, 3e-3))

    def rates():
        return {name: x.param_groups[0]["lr"] for name, x in optimizers(other.learner).items()}

    before = rates()
    other.set_parameters(one.get_parameters())
    assert rates() == before and 3e-3 in before.values()


def test_a_trained_prior_actor_is_kept_and_an_untrained_one_does_not_guide():
    trained, other = (
        WPT("WPTPolicy", ClockEnv(), dataset=[recorded()], **DEBUG, bc_learning_rate=rate)
        for rate in (1e-3, 1e-2)
    )
    other.set_parameters(trained.learn(7).get_parameters())
    other.learn(7)  # retrieves, and has a prior actor already
    assert same(weights(trained, "prior_actor"), weights(other, "prior_actor"))
    trained.set_parameters(WPT("WPTPolicy", ClockEnv(), **DEBUG).get_parameters())
    assert trained.prior is None


def test_parameters_of_an_earlier_version_hold_no_counters_and_change_none():
    model = MRQ("CnnPolicy", ClockEnv(), **FRAMES, latent_dim=8)
    model.progress.scale = 2.0
    parameters = model.get_parameters()
    del parameters["progress"]
    model.set_parameters(parameters)
    assert model.progress.scale == 2.0
