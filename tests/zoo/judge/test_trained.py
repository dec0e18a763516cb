"""A finished run goes anywhere: moved, without its data, by eval, enjoy, push and pull."""

import json
import re
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from debug_agent import agent, noise
from dot_runs import DOT, SECTIONS, dot, job  # noqa: F401  (dot registers the task for each test)
from hub_stand_in import hub  # noqa: F401  (a fixture)
from imageio_ffmpeg import count_frames_and_secs
from PIL import Image
from run_folders import make_run
from zoo_command import call

from wpt_agents.data.trajectory import Trajectory
from wpt_agents.model.actor_critic import lambda_return
from wpt_agents.zoo.judge.diagnosis import Diagnosis, Promise, promises, show
from wpt_agents.zoo.judge.evaluation import NoisyPolicy, episode_steps
from wpt_agents.zoo.judge.trained import Origin, Trained, find_trained
from wpt_agents.zoo.plan.methods import METHODS
from wpt_agents.zoo.report.hub import card, pull, push
from wpt_agents.zoo.result import Score, read_result
from wpt_agents.zoo.run.runner import run

pytestmark = pytest.mark.slow  # it runs simulators or whole runs


@pytest.fixture
def moved(tmp_path):
    """A finished run elsewhere, its dataset and everything else of where it was made gone."""
    one = job(tmp_path / "made")
    result = run(one)
    shutil.copytree(one.folder, tmp_path / "moved")
    shutil.rmtree(tmp_path / "made")
    return tmp_path / "moved", result, one.evaluation_seed


def test_a_moved_run_without_its_data_plays_as_it_did(moved):
    folder, result, seed = moved
    trained = find_trained(folder)
    for policy, name in (("wpt", "last"), ("prior", "prior actor")):
        score = trained.evaluate(trained.load(policy), 3, seed)
        assert score.returns == pytest.approx(result.scores[name].returns)


def test_the_actor_of_the_head_start_is_scored_alone_where_the_prior_actor_acts_with_it(tmp_path):
    keywords = {**SECTIONS["wpt"], "residual": True, "actor_delay": 2, "guidance": 0}
    one = job(tmp_path, wpt=keywords)
    scores = run(one).scores
    assert list(scores)[2:] == ["prior actor", "after head start", "imitating actor", "last"]
    # before any imagination there is nothing to correct: the prior actor acts
    returns = {name: score.returns for name, score in scores.items()}
    assert returns["after head start"] == pytest.approx(returns["prior actor"])
    assert returns["imitating actor"] != pytest.approx(returns["prior actor"])
    trained = find_trained(one.folder / "head_start_model.zip")
    score = trained.evaluate(trained.load("actor"), 3, one.evaluation_seed)
    assert score.returns == pytest.approx(returns["imitating actor"])
    other = replace(trained, method=METHODS["drq-v2"])
    with pytest.raises(ValueError, match="is not of WPT, so its actor always acts alone"):
        other.choose(METHODS["drq-v2"].agent(), "actor")


def test_eval_and_enjoy_show_the_policy(moved, monkeypatch, capsys, tmp_path):
    folder, _, seed = moved
    assert call(monkeypatch, "eval", folder, "--episodes", "2", "--seed", seed) == 0
    printed = capsys.readouterr().out
    assert re.search(r"returns +-?\d", printed) and DOT.id in printed
    video = tmp_path / "new" / "video.mp4"
    assert call(monkeypatch, "enjoy", folder, "--out", video, "--size", "64") == 0
    assert count_frames_and_secs(video)[0] >= DOT.frames
    animation = tmp_path / "policy.gif"
    assert call(monkeypatch, "enjoy", folder, "--out", animation, "--size", "64") == 0
    assert "MB)" in capsys.readouterr().out
    with Image.open(animation) as pictures:
        assert pictures.width > 3 * 64 and pictures.n_frames > 1  # the strip is beside the film
    model = shutil.copy(folder / "model.zip", tmp_path / "alone.zip")
    words = ["--task", "dmc-dot", "--episodes", "1"]
    assert call(monkeypatch, "eval", model, "--episodes", "1") == 2  # nothing says what it is for
    monkeypatch.setattr(
        "wpt_agents.zoo.judge.trained.read_origin", lambda _: Origin("", SECTIONS["env"])
    )
    assert call(monkeypatch, "eval", model, *words) == 0


@pytest.mark.parametrize("words", [[], ["--task", "dmc-walker-run"]])
def test_a_file_of_sb3_without_its_run_says_what_is_missing(words, tmp_path, monkeypatch, capsys):
    file = tmp_path / "model.zip"
    METHODS["sac"].agent("MlpPolicy", "Pendulum-v1", buffer_size=1).save(file)
    assert call(monkeypatch, "eval", file, *words) == 2
    printed = capsys.readouterr().err
    assert "config.yaml of its run, which does, is not beside it: copy it there" in printed
    assert "damaged" not in printed and "add --task" not in printed


def test_eval_names_the_initial_states_where_a_policy_fails(moved, monkeypatch, capsys):
    folder, *_ = moved
    score = Score((1.0, 2.0, 3.0), (False, True, False))
    monkeypatch.setattr(Trained, "evaluate", lambda *_: score)
    assert call(monkeypatch, "eval", folder, "--episodes", "3", "--seed", "20") == 0
    assert "failures         seeds 20, 22 (" in capsys.readouterr().out


def test_the_last_step_of_an_episode_may_repeat_an_action_less_often():
    task = "wpt/dmc-walker-run-v0"  # of 1000 frames
    assert [episode_steps(task, {"action_repeat": n}) for n in (1, 2, 3)] == [1000, 500, 334]
    assert episode_steps(task, {}) == 500
    assert episode_steps("CartPole-v1", {}) is None


def test_noise_on_the_actions_is_of_the_asked_size_and_seeded():
    class Still:
        def predict(self, observation, state=None, episode_start=None, deterministic=False):
            return np.full((len(observation), 4), 0.9, np.float32), state

    obs = np.zeros((5000, 1))
    noisy, _ = NoisyPolicy(Still(), 0.02, seed=1).predict(obs)
    assert noisy.dtype == np.float32
    assert noisy.mean() == pytest.approx(0.9, abs=1e-3)
    assert noisy.std() == pytest.approx(0.02, rel=0.02)
    again, other = (NoisyPolicy(Still(), 0.02, seed).predict(obs)[0] for seed in (1, 2))
    assert np.array_equal(noisy, again) and not np.array_equal(noisy, other)
    assert NoisyPolicy(Still(), 5.0, seed=1).predict(obs)[0].max() == 1  # clipped


def test_eval_plays_with_noise_if_asked(moved):
    folder, _, seed = moved
    trained = find_trained(folder)
    plain, noisy, again = (
        trained.evaluate(trained.load(), 2, seed, noise).returns for noise in (0, 0.5, 0.5)
    )
    assert noisy == again and noisy != plain


def test_diagnose_shows_promises_beside_what_came(moved, monkeypatch, capsys):
    folder, _, seed = moved
    words = ["--episodes", "2", "--horizon", "10", "--seed", seed]
    assert call(monkeypatch, "diagnose", folder, *words) == 0
    printed = capsys.readouterr().out
    assert all(word in printed for word in ("earned", "imagined", "discounted return"))
    rows = re.findall(r"│ +(\d+) │ +(-?[\d.]+) │", printed)
    assert [int(step) for step, _ in rows] == [0, 3, 7, 11, 15]  # five from 0 to 25 - 10
    returns = find_trained(folder).evaluate(find_trained(folder).load(), 1, seed).returns
    assert re.search(rf"Returns: {returns[0]:.0f}, ", printed)
    assert (
        re.search(r"new episode, update \d+ +│ +\d", printed) and "same actions, largest" in printed
    )
    assert call(monkeypatch, "diagnose", folder / "model.zip", *words) == 0
    assert "new episode, update" not in capsys.readouterr().out  # a file alone has no log
    assert call(monkeypatch, "diagnose", folder, "--horizon", "26") == 2
    assert "shorter --horizon" in capsys.readouterr().err


def test_diagnose_says_where_dreams_lack_the_prior_actor(capsys):
    rows = [Promise(0, 1.0, 1.0, 1.0, 1.0, 1.0)]
    show(Diagnosis([1.0], 0.1, rows, clone_acts=True), 20)
    assert "in acting, and not in imagination" in " ".join(capsys.readouterr().out.split())
    show(Diagnosis([1.0], 0.1, rows), 20)
    assert "prior actor" not in capsys.readouterr().out.lower()


def test_promises_are_of_the_actions_and_rewards_from_the_start_on(monkeypatch):
    policy, rng = agent(max_action_dim=3).policy, np.random.default_rng(0)
    action, reward = rng.uniform(-1, 1, (6, 3)).astype(np.float32), np.arange(6, dtype=np.float32)
    rssm, taken = policy.world_model.rssm, []

    def noted(state, act, horizon, generator):
        taken.append(torch.stack([act(state, t) for t in range(horizon)], 1))
        return imagine(state, act, horizon, generator)

    imagine = rssm.imagine
    monkeypatch.setattr(rssm, "imagine", noted)
    played = Trajectory(noise(7), action, reward)
    rows = promises(policy, played, 0.5, [0, 4], 2)
    assert [(p.start, p.earned) for p in rows] == [(0, 0.5), (4, 4.5)]
    # what the critic is taught: image t came with reward t - 1, and the last one pays no more
    arriving = torch.tensor([[0, *reward.tolist()]])
    returns = lambda_return(arriving, torch.zeros(1, 8), 0.5, lam=1.0)[0]
    assert [p.discounted for p in rows] == pytest.approx([returns[0].item(), returns[4].item()])
    assert rows[1].discounted == 3 + 0.5 * 4 + 0.25 * 5
    np.testing.assert_array_equal(taken[0][0], action[:2])
    np.testing.assert_array_equal(taken[2][0], action[4:])  # taken[1] are the actor's own
    assert not np.array_equal(taken[1][0], action[:2])


def test_a_moved_out_is_not_done_again(tmp_path):
    result = run(job(tmp_path / "a", "scratch"))
    (tmp_path / "a").rename(tmp_path / "b")
    assert run(job(tmp_path / "b", "scratch")) == result


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["eval", "nowhere"], "There is no nowhere"),
        (["enjoy", "empty"], "empty holds no run: name a run folder, or a model file (.zip)"),
        (["eval", "alone.zip"], "add --task"),
        (["eval", "run", "--task", "dmc-walker-rum"], "Did you mean 'walker-run'"),
        (["eval", "run", "--task", "dmc-walker-*"], "matches 7 tasks: name one"),
        (["enjoy", "run", "--size", "100"], "multiple of 16"),
        (["enjoy", "run", "--out", "film.avi"], "end in .mp4 or .gif"),
        (["eval", "damaged"], "is not the configuration of a run"),
        (["push", "run", "noname"], "write user/name"),
        (["push", "empty", "user/name"], "empty holds no run"),
        (["pull", "user/name", "--out", "run"], "is not empty"),
    ],
)
def test_what_cannot_be_played_is_told(words, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for name in ("empty", "run", "damaged"):
        (tmp_path / name).mkdir()
    (tmp_path / "alone.zip").touch()
    for name in ("run", "damaged"):
        (tmp_path / name / "model.zip").touch()
    config = {"task": "wpt/dmc-walker-run-v0", "env": {}}
    (tmp_path / "run" / "config.yaml").write_text(yaml.safe_dump(config))
    (tmp_path / "damaged" / "config.yaml").write_text("task: [")
    assert call(monkeypatch, *words) == 2
    assert message in capsys.readouterr().err


def test_a_task_of_a_sequence_is_played_as_the_sequence_was(tmp_path, monkeypatch, capsys):
    folder = tmp_path / "ant_0" / "dmc-quadruped-walk"
    folder.mkdir(parents=True)
    (folder / "model.zip").touch()
    tasks = [f"wpt/dmc-quadruped-{name}-v0" for name in ("stand", "walk")]
    env = {"action_repeat": 4, "rendering": "fast"}
    config = {"task": "ant", "tasks": tasks, "env": env, "method": "packnet"}
    (tmp_path / "ant_0" / "config.yaml").write_text(yaml.safe_dump(config))
    trained = find_trained(folder)
    assert (trained.task, trained.env, trained.method) == (tasks[1], env, METHODS["packnet"])
    assert find_trained(folder / "model.zip") == trained
    monkeypatch.chdir(folder)
    assert find_trained(Path("model.zip")).task == tasks[1]
    assert call(monkeypatch, "eval", tmp_path / "ant_0") == 2
    assert "name one in it: dmc-quadruped-walk" in capsys.readouterr().err


@pytest.mark.parametrize(("number", "more"), [(1, ""), (5, ""), (7, ", and 2 more")])
def test_a_folder_of_runs_is_not_called_an_unfinished_run(number, more, tmp_path):
    runs = [make_run(tmp_path / "runs", "dmc-walker-run", seed) for seed in range(number)]
    names = ", ".join(map(str, runs[:5]))
    for folder in (tmp_path / "runs", runs[0].parent):
        with pytest.raises(FileNotFoundError) as raised:
            find_trained(folder)
        assert str(raised.value) == f"{folder} holds no run: name one below it: {names}{more}"
    with pytest.raises(FileNotFoundError, match=r"model\.zip: the run is not finished"):
        find_trained(runs[0])  # it has no model yet


def test_the_hub_is_asked_for_only_when_needed_and_told_if_missing(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)  # what a missing module looks like
    assert call(monkeypatch, "pull", "user/name", "--out", tmp_path / "new") == 2
    assert 'pip install "wpt-agents[hub]"' in capsys.readouterr().err


def test_the_card_tells_scores_command_and_how_to_load(tmp_path):
    page = card(
        read_result(make_run(tmp_path, "dmc-walker-run", 3, returns=(700.0, 720.0))), "me/walker"
    )
    header = yaml.safe_load(page.split("---\n")[1])
    (result,) = header["model-index"][0]["results"]
    assert result["metrics"][0]["value"] == 710.0
    assert header["library_name"] == "wpt-agents"
    for text in ("| wpt | 710 |", "seed 3", "--tasks dmc-walker-run", "zoo pull me/walker"):
        assert text in page
    assert "Commit 0123456789ab. Made by:" in page


def test_the_card_of_a_run_outside_a_checkout_says_that_its_commit_is_unknown(tmp_path):
    result = read_result(make_run(tmp_path, "dmc-walker-run"))
    assert "Commit unknown. Made by:" in card(replace(result, commit=None), "me/walker")


def test_what_was_pushed_is_pulled_the_same(tmp_path, hub):  # noqa: F811
    folder = make_run(tmp_path, "dmc-walker-run")
    (folder / "model.zip").write_bytes(b"weights" * 1000)
    (folder / "checkpoints").mkdir()
    config = (folder / "config.yaml").read_text()
    (folder / "config.yaml").write_text(config + f"data: {tmp_path}\n")
    address = push(folder, "me/walker")
    assert not any(str(tmp_path).encode() in content for content in hub.files["me/walker"].values())
    (folder / "config.yaml").write_text(config)
    assert address.endswith("me/walker")
    assert {"README.md", "replay.mp4", "model.zip", "result.json"} <= hub.files["me/walker"].keys()
    assert b"model-index" in hub.files["me/walker"]["README.md"]
    pulled = pull("me/walker", tmp_path / "pulled")
    for name in ("model.zip", "config.yaml", "result.json", "policy.mp4"):
        assert (pulled / name).read_bytes() == (folder / name).read_bytes()
    assert json.loads((pulled / "result.json").read_text())["task"] == "dmc-walker-run"
