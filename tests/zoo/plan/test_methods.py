"""Methods of other agents than WPT, by the same stages."""

from dataclasses import replace

import pytest
from dot_runs import SECTIONS, dot, job  # noqa: F401  (dot registers the task for each test)
from stable_baselines3 import SAC
from stable_baselines3.common.vec_env import VecFrameStack, VecTransposeImage
from test_resume import killed_at

from wpt_agents.agents.drqv2 import DrQv2
from wpt_agents.zoo.plan import methods
from wpt_agents.zoo.plan.effects import check_changes
from wpt_agents.zoo.plan.methods import Method, defaults
from wpt_agents.zoo.result import Change
from wpt_agents.zoo.run import runner
from wpt_agents.zoo.run.runner import run

pytestmark = pytest.mark.slow  # whole runs

NO_DATA = {"policy": "CnnPolicy", "pretrained": False, "needs_data": False}
SMALL_SAC = {"buffer_size": 100, "batch_size": 2, "policy_kwargs": {"net_arch": [8]}}
SMALL_DRQ = {"channels": 4, "feature_dim": 8, "hidden_dim": 8, "batch_size": 4, "update_every": 8}


def two_frames(venv):
    return VecTransposeImage(VecFrameStack(venv, 2))


OTHERS = {
    "sac": Method(SAC, SMALL_SAC, shared=("learning_starts",), wrap=two_frames, **NO_DATA),
    "drq": Method(DrQv2, SMALL_DRQ, shared=("learning_starts", "warmup_steps"), **NO_DATA),
}


@pytest.fixture(autouse=True)
def others(monkeypatch):
    monkeypatch.setattr(methods, "METHODS", methods.METHODS | OTHERS)


@pytest.mark.parametrize("method", OTHERS)
def test_another_agent_runs_by_the_same_stages(tmp_path, method):
    one = job(tmp_path, method, evaluate={"every": 25, "during_episodes": 1, "keep_best": True})
    result = run(one)
    assert list(result.scores) == ["nothing", "random", "last", "best"]
    assert result.updates > 0 and result.cpu_seconds > 0
    assert (one.folder / "policy.mp4").exists() and not (one.folder / "predictions.png").exists()
    assert one.config()[OTHERS[method].agent.__name__.lower()]["learning_starts"] == 25
    assert run(one) == result  # reused


def test_an_agent_that_keeps_episodes_resumes_and_another_begins_again(
    tmp_path, monkeypatch, capsys
):
    changes = {"learn": {"frames": 75, "checkpoint_every": 25}}
    for method, resumed in (("drq", "continued at 50 of"), ("sac", "")):
        one = job(tmp_path, method, **changes)
        killed_at(60, monkeypatch, one)
        run(one)
        said = capsys.readouterr().out
        assert resumed in said and bool(resumed) == ("continued at" in said)


def test_a_setting_that_an_agent_does_not_take_is_refused():
    with pytest.raises(ValueError, match="takes only learning_starts of WPT's keywords"):
        check_changes("sac", [Change("gamma", "0.9")])
    check_changes("sac", [Change("learning_starts", "9")])


def test_the_keywords_of_an_agent_come_from_its_signature():
    assert defaults(DrQv2)["channels"] == 32 and defaults(SAC)["tau"] == 0.005
    assert not {"policy", "env", "seed", "device"} & {*defaults(DrQv2), *defaults(SAC)}


def test_a_pretrained_method_that_has_no_data_is_our_mistake(tmp_path, monkeypatch):
    broken = replace(OTHERS["drq"], pretrained=True)
    monkeypatch.setitem(methods.METHODS, "drq", broken)
    with pytest.raises(AssertionError):
        runner.do_stages(job(tmp_path, "drq"))


@pytest.mark.parametrize(("ibrl", "retrieves"), [(True, True), (False, False)])
def test_a_run_that_lets_the_clone_compete_needs_data(tmp_path, ibrl, retrieves):
    wpt = {**SECTIONS["wpt"], "offline_ratio": 0.0, "guidance": 0.0, "ibrl": ibrl}
    assert job(tmp_path, "wpt", wpt=wpt).retrieves == retrieves
    for method in ("scratch", "no-guidance", "dreamer-v3"):  # none of which has a clone
        assert not job(tmp_path, method, wpt=wpt).full_keywords["ibrl"]
