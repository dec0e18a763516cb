"""The runner end to end, on a toy task and the smallest networks."""

import csv
import hashlib
import json
import os
import signal
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import toy_env
import yaml
from debug_agent import recorded
from dot_runs import DOT, dot, job  # noqa: F401  (dot registers the task for each test)
from gymnasium import spaces
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.results_plotter import load_results, ts2xy
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv
from wpt_envs.tasks import TASKS

from wpt_agents.agents.wpt import WPT
from wpt_agents.data.dataset import TrajectoryDataset
from wpt_agents.training.learner import Learner
from wpt_agents.zoo.judge import evaluation
from wpt_agents.zoo.judge.evaluation import evaluate
from wpt_agents.zoo.judge.untrained import DoNothing, RandomPolicy
from wpt_agents.zoo.locks import locked
from wpt_agents.zoo.plan.methods import METHODS
from wpt_agents.zoo.plan.overview import identity_of
from wpt_agents.zoo.plan.presets import load_preset
from wpt_agents.zoo.plan.request import Request
from wpt_agents.zoo.plan.runs import make_plan
from wpt_agents.zoo.plan.shared import Shared
from wpt_agents.zoo.provenance import commit
from wpt_agents.zoo.report import record
from wpt_agents.zoo.report.folders import find_finished
from wpt_agents.zoo.result import Result, Score, read_result, write_result
from wpt_agents.zoo.run import evaluating, learning, runner, shared
from wpt_agents.zoo.run.runner import run
from wpt_agents.zoo.run.shared import collect_data, pretrain
from wpt_agents.zoo.vec_envs import make_vec_env

pytestmark = pytest.mark.slow  # it runs simulators or whole runs


def test_a_finished_run_is_added_to_the_record_at_once(tmp_path):
    path = tmp_path / "results" / "toy.csv"
    path.parent.mkdir()
    one = replace(job(tmp_path, "scratch"), record=path)
    result = run(one)
    lines = record.read(path)
    assert lines == record.lines_of(find_finished(tmp_path))
    assert identity_of(one) in {line.run for line in lines}
    assert {"toy.csv", "toy.md", "toy.png"} <= {file.name for file in path.parent.iterdir()}
    path.unlink()
    assert run(one) == result and record.read(path) == lines  # of a run that was finished before
    assert one.config() == job(tmp_path, "scratch").config()


def test_a_run_leaves_everything_in_one_folder(tmp_path):
    one = job(tmp_path, evaluate={"every": 25, "during_episodes": 2})
    result = run(one)
    names = {path.name for path in one.folder.iterdir()}
    logs = {"0.monitor.csv", "progress.csv", "evaluations.npz", "system.json", "command.txt"}
    pictures = {"learning_curve.png", "policy.mp4", "predictions.png", "retrieval.png"}
    assert logs | pictures | {"config.yaml", "model.zip", "result.json"} <= names
    assert any(name.startswith("events.out.tfevents") for name in names)
    assert list(result.scores) == ["nothing", "random", "prior actor", "last"]
    assert all(len(score.returns) == 3 for score in result.scores.values())
    assert yaml.safe_load((one.folder / "config.yaml").read_text()) == one.config()
    assert read_result(one.folder) == result
    assert result.updates > 0 and result.cpu_seconds > 0 and len(result.model) == 12
    start = (one.shared.model_path / "model.zip").read_bytes()
    assert result.pretrained == hashlib.sha256(start).hexdigest()[:12]
    lines = record.lines_of(find_finished(tmp_path))
    assert [(line.policy, line.model_hash) for line in lines if line.frames] == [
        ("prior actor", result.pretrained),
        ("last", result.pretrained),
    ]
    assert {line.success_any for line in lines} == {None}  # the dot counts returns


def test_sb3_reads_the_run_folder_and_wpt_its_model(tmp_path):
    one = job(tmp_path)
    run(one)
    steps, _ = ts2xy(load_results(str(one.folder)), "timesteps")
    assert steps.tolist() == [25, 50, 75]
    assert WPT.load(one.folder / "model.zip").num_timesteps == 75


def test_true_rewards_are_asked_of_data_that_hold_them(tmp_path):
    with pytest.raises(ValueError, match=r"without rewards.*label='zero'"):
        run(job(tmp_path, "rlpd"))
    with TrajectoryDataset.create(tmp_path / "own") as data:
        for seed in range(3):
            one = recorded(seed=seed, embodiment=DOT.embodiment)
            data.append(replace(one, reward=np.ones(len(one))))
    assert run(job(tmp_path / "runs", "rlpd", data=tmp_path / "own")).updates == 10


@pytest.mark.parametrize("method", sorted(METHODS.keys() - {"rlpd"}))
def test_every_method_runs(tmp_path, method):
    result = run(job(tmp_path, method))
    assert np.isfinite(result.final.mean) and result.updates > 0
    if METHODS[method].agent is not WPT:
        assert ("pretrain" in result.seconds) == (method == "r3m")
        assert ("prior actor" in result.scores) == (method == "jsrl-bc")
        return
    alone = ("scratch", "dreamer-v3")
    guided = method not in (*alone, "pretrain-only", "no-guidance")
    assert ("prior actor" in result.scores) == guided
    assert ("pretrain" in result.seconds) == (method not in (*alone, "no-pretrain"))
    retrieved = (job(tmp_path, method).folder / "retrieval.png").exists()
    assert retrieved == (method not in (*alone, "pretrain-only", "random-retrieval"))


def test_an_environment_beside_the_learner_changes_nothing_but_the_time(tmp_path, monkeypatch):
    made, before = [], learning.make_vec_env
    monkeypatch.setattr(
        learning, "make_vec_env", lambda *a, **k: made.append(before(*a, **k)) or made[-1]
    )
    reach, scores = TASKS["wpt/metaworld-reach-v0"], []
    wpt = {"train_freq": "step", "max_action_dim": 4, "train_ratio": 1}
    for overlap in (True, False):
        one = job(
            tmp_path / str(overlap),
            "scratch",
            env={"action_repeat": 2},
            learn={"frames": 400, "overlap": overlap},
            evaluate={"episodes": 1},
            wpt=wpt,
        )
        scores.append(run(replace(one, task=reach)).scores)
    assert [type(venv) for venv in made] == [SubprocVecEnv, DummyVecEnv]
    assert scores[0] == scores[1]
    beside, alone = (
        next((tmp_path / str(overlap)).rglob("progress.csv")) for overlap in (True, False)
    )
    assert _without_times(beside) == _without_times(alone) != []


def test_an_environment_beside_the_learner_survives_ctrl_c():
    venv = make_vec_env("wpt/metaworld-reach-v0", {"rendering": "fast"}, 0, workers=True)
    with closing(venv):
        venv.reset()
        os.kill(venv.processes[0].pid, signal.SIGINT)
        venv.step(np.zeros((1, 4), np.float32))


def _without_times(path):
    rows = csv.DictReader(path.read_text().splitlines())
    return [{k: v for k, v in row.items() if not k.startswith("time/fps")} for row in rows]


def test_a_finished_run_is_not_done_again_unless_forced(tmp_path, monkeypatch):
    first = run(job(tmp_path))
    done = (job(tmp_path).folder / "result.json").stat().st_mtime_ns
    for name in ("checkpoints", "replay"):  # of a process that was killed right after its result
        (job(tmp_path).folder / name).mkdir()
    assert run(job(tmp_path)) == first
    assert (job(tmp_path).folder / "result.json").stat().st_mtime_ns == done
    assert not {"checkpoints", "replay"} & {path.name for path in job(tmp_path).folder.iterdir()}
    monkeypatch.setattr(runner, "do_stages", lambda job: "done again")
    assert run(job(tmp_path), force=True) == "done again"


def test_a_second_seed_reuses_data_model_and_index_and_says_so(tmp_path, monkeypatch, capsys):
    run(job(tmp_path))
    capsys.readouterr()
    monkeypatch.setattr(WPT, "pretrain", lambda *_, **__: pytest.fail("pre-trained again"))
    monkeypatch.setattr(shared, "evaluate", lambda *_: pytest.fail("no new baseline of this seed"))
    with pytest.raises(pytest.fail.Exception, match="baseline"):
        run(job(tmp_path, seed=1))
    said = capsys.readouterr().out
    for stage in ("collect", "pretrain", "index"):
        assert f"{stage:<10}reused" in said


def test_a_change_of_fine_tuning_keeps_the_pretrained_model_and_others_do_not(tmp_path):
    before = job(tmp_path).shared
    assert job(tmp_path, wpt={"gamma": 0.9}).shared.model_path == before.model_path
    assert job(tmp_path, wpt={"size": "tiny"}).shared.model_path != before.model_path
    assert job(tmp_path, pretrain={"steps": 3}).shared.model_path != before.model_path
    assert job(tmp_path, collect={"episodes": 5}).shared.model_path != before.model_path
    assert job(tmp_path, env={"rendering": "near"}).shared.data_path != before.data_path


def test_a_preset_sets_the_steps_of_explore_state_and_without_them_data_keep_their_name(tmp_path):
    explore = ["collect.behaviour=explore-state", "collect.tasks=[dmc-cartpole-balance]"]
    usual = Shared(load_preset("dmc", "debug", explore), "dmc", tmp_path, workers=1)
    fewer = Shared(load_preset("dmc", "debug", [*explore, "collect.steps=20"]), "dmc", tmp_path, 1)
    label = json.loads((collect_data(fewer).path / "collect.json").read_text())
    assert label["settings"] == {"steps": 20}
    assert fewer.data_path != usual.data_path
    assert "steps" not in usual.preset.as_dict()["collect"]


def test_a_dataset_of_ones_own_takes_the_place_of_the_presets(tmp_path):
    data = collect_data(job(tmp_path).shared).path.rename(tmp_path / "own")
    one = job(tmp_path, data=data)
    assert one.shared.model_path != job(tmp_path).shared.model_path
    run(one)
    assert TrajectoryDataset.open(data).fingerprint.startswith(one.config()["data"])
    assert not list((tmp_path / "cache").glob("data-*"))
    path = one.shared.model_path
    assert job(tmp_path, data=data.rename(tmp_path / "moved")).shared.model_path == path


def test_a_damaged_label_of_ones_own_data_is_named(tmp_path):
    with TrajectoryDataset.create(tmp_path / "own") as dataset:
        dataset.append(recorded())
    (tmp_path / "own" / "collect.json").write_text('{"env": {')
    with pytest.raises(ValueError, match=r"collect\.json is damaged .*restore"):
        collect_data(job(tmp_path, data=tmp_path / "own").shared)


def test_a_run_goes_on_with_the_same_data_alone(tmp_path):
    data = collect_data(job(tmp_path).shared).path.rename(tmp_path / "own")
    run(job(tmp_path, data=data))
    with TrajectoryDataset.open(data) as dataset:
        dataset.append(dataset[0])
    with pytest.raises(ValueError, match=r"other settings \(data\)"):
        run(job(tmp_path, data=data))


def test_the_datas_name_is_as_it_was_written_wherever_a_run_is_done(tmp_path, monkeypatch):
    collect_data(job(tmp_path).shared).path.rename(tmp_path / "own")
    monkeypatch.chdir(tmp_path)
    one = replace(job(tmp_path, data=Path("own")), data_name="own")
    assert str(replace(one, data=one.data.resolve()).variant) == str(one.variant) == "toy data=own"


def test_a_failure_whose_words_look_like_markup_ends_one_run_and_not_all(
    tmp_path, monkeypatch, capsys
):
    def fail(one, force):
        raise OSError(f"could not read [/data/{one.seed}.bin]")

    monkeypatch.setattr(runner, "run", fail)
    assert not runner.run_all([job(tmp_path), job(tmp_path, seed=1)])
    said = capsys.readouterr().out
    assert "read [/data/0.bin]" in said and "read [/data/1.bin]" in said
    assert "error.txt" not in said  # there is none


def test_without_git_a_run_is_of_no_commit(monkeypatch):
    monkeypatch.setattr("shutil.which", lambda _: None)
    monkeypatch.setattr("subprocess.run", lambda *_, **__: pytest.fail("asked git"))
    assert commit.__wrapped__() is None


def test_data_of_another_look_than_the_tasks_are_told(tmp_path, capsys):
    data = collect_data(job(tmp_path).shared).path
    collect_data(job(tmp_path, data=data).shared)
    assert "warning" not in capsys.readouterr().out
    collect_data(job(tmp_path, data=data, env={"rendering": "near"}).shared)
    assert "data of rendering=fast, but the task has rendering=near" in capsys.readouterr().out


def test_half_a_pretraining_is_continued(tmp_path, monkeypatch):
    run(job(tmp_path))
    shared = job(tmp_path).shared
    (shared.model_path / "done.json").unlink()  # as if killed after the last checkpoint
    monkeypatch.setattr(Learner, "update_world_model", lambda *_: pytest.fail("from the start"))
    pretrain(shared, collect_data(shared))
    assert (shared.model_path / "done.json").exists()


def test_a_run_that_failed_is_told_and_done_anew(tmp_path, monkeypatch):
    def die(*_):
        raise RuntimeError("out of luck")

    with monkeypatch.context() as broken:
        broken.setattr(runner, "learn", die)
        assert not runner.run_all([job(tmp_path), job(tmp_path, "scratch")])
    assert "out of luck" in (job(tmp_path).folder / "error.txt").read_text()
    assert not (job(tmp_path).folder / "result.json").exists()
    assert runner.run_all([job(tmp_path)])
    assert not (job(tmp_path).folder / "error.txt").exists()


def test_a_picture_that_cannot_be_drawn_does_not_cost_the_result(tmp_path, monkeypatch, capsys):
    def no_video(*_):
        raise OSError("no [ffmpeg] here")

    monkeypatch.setattr(evaluating.pictures, "video", no_video)
    one = job(tmp_path, "scratch")
    assert runner.run_all([one])
    assert "pictures are missing: OSError: no [ffmpeg] here" in capsys.readouterr().out
    assert read_result(one.folder) is not None and not (one.folder / "error.txt").exists()
    assert "in no_video" in (one.folder / "pictures.txt").read_text()
    assert (one.folder / "learning_curve.png").exists()


def test_a_forced_run_that_could_not_begin_is_not_finished(tmp_path, capsys):
    one = job(tmp_path)
    one.folder.mkdir(parents=True)
    score = Score((1.0,))
    done = Result("dmc", "dmc-dot", "wpt", one.variant, 0, 75, 75, "return", {"last": score})
    write_result(one.folder, done)
    (one.folder / "config.yaml").write_text(yaml.safe_dump(json.loads(json.dumps(one.config()))))
    with locked(one.folder / "lock"):
        assert not runner.run_all([one], force=True)
    assert "worked on by another process" in capsys.readouterr().out


def test_a_finished_run_of_other_settings_is_refused_before_any_work(tmp_path):
    run(job(tmp_path))
    with pytest.raises(ValueError, match=r"other settings \(wpt.gamma\).*--out"):
        runner.run_all([job(tmp_path, seed=1), job(tmp_path, wpt={"gamma": 0.5})])
    assert not job(tmp_path, seed=1).folder.exists()


def test_a_run_from_before_a_keyword_was_there_is_the_same_run(tmp_path):
    one = job(tmp_path, "scratch")
    first = run(one)
    path = one.folder / "config.yaml"
    config = yaml.safe_load(path.read_text())
    assert config["wpt"].pop("kickstart") == 0
    path.write_text(yaml.safe_dump(config))
    assert run(one) == first
    config["wpt"]["kickstart"] = 3
    path.write_text(yaml.safe_dump(config))
    with pytest.raises(ValueError, match=r"other settings \(wpt.kickstart\)"):
        run(one)


def test_a_folder_that_is_no_run_is_never_deleted(tmp_path):
    one = job(tmp_path)
    one.folder.mkdir(parents=True)
    (one.folder / "thesis.txt").write_text("mine")
    with pytest.raises(ValueError, match="not a run folder"):
        run(one, force=True)
    assert (one.folder / "thesis.txt").exists()


def test_evaluation_is_seeded_apart_from_training():
    env = {"action_repeat": 1, "rendering": "fast"}
    still, space = DoNothing(toy_env.DotEnv().action_space), toy_env.DotEnv().action_space
    returns = evaluate(still, DOT.id, env, 3, seed=5).returns
    assert returns == evaluate(still, DOT.id, env, 3, seed=5).returns
    assert returns != evaluate(still, DOT.id, env, 3, seed=6).returns
    assert len(set(returns)) == 3
    noise = [evaluate(RandomPolicy(space, 1), DOT.id, env, 2, 5).returns for _ in range(2)]
    assert noise[0] == noise[1]


class Passing(toy_env.DotEnv):
    """A task that is solved at its second step, and then no more."""

    def step(self, action):
        *rest, info = super().step(action)
        self.steps = getattr(self, "steps", 0) + 1
        success = self.steps == 2
        self.ever = success or getattr(self, "ever", False)
        return *rest, info | {"is_success": success, "success_any": self.ever}


def test_success_at_any_step_is_counted_beside_that_at_the_last(monkeypatch):
    def watched():
        return Monitor(Passing())

    monkeypatch.setattr(evaluation, "make_vec_env", lambda *_: DummyVecEnv([watched] * 2))
    score = evaluate(DoNothing(toy_env.DotEnv().action_space), DOT.id, {}, 2, 5)
    assert (score.successes, score.successes_any) == ((False,) * 2, (True,) * 2)
    assert (score.success_rate, score.success_rate_any) == (0.0, 1.0)


def test_scores_are_in_the_order_of_seeds_even_if_later_episodes_end_earlier(monkeypatch):
    class Shorter(toy_env.DotEnv):
        """Ends the earlier, the higher its seed is; its return is its length."""

        def reset(self, *, seed=None, options=None):
            self.length = 12 - seed if seed is not None else self.length
            return super().reset(seed=seed)

        def step(self, action):
            obs, _, _, _, info = super().step(action)
            return obs, 1.0, self.time == self.length, False, info | {"is_success": self.length > 5}

    def make(_, __, seed, number):
        venv = DummyVecEnv([lambda: Monitor(Shorter()) for _ in range(number)])
        venv.seed(seed)
        return venv

    monkeypatch.setattr(evaluation, "make_vec_env", make)
    monkeypatch.setattr(evaluation, "PARALLEL", 3)
    score = evaluate(DoNothing(toy_env.DotEnv().action_space), DOT.id, {}, 5, 4)
    assert score.returns == (8, 7, 6, 5, 4)
    assert score.successes == (True, True, True, False, False)


def test_training_logs_success_where_the_task_counts_it(tmp_path):
    path = tmp_path / "0.monitor.csv"
    env = {"rendering": "fast"}
    with closing(make_vec_env("wpt/metaworld-reach-v0", env, 0, monitor=str(path))) as venv:
        venv.reset()
        while not venv.step(np.zeros((1, 4)))[2].any():
            pass
    assert path.read_text().splitlines()[1] == "r,l,t,is_success"


def test_doing_nothing_earns_the_first_reward_at_every_step():
    env, steps = toy_env.DotEnv(), toy_env.LENGTH
    env.reset(seed=5)
    score = evaluate(
        DoNothing(env.action_space), DOT.id, {"action_repeat": 1, "rendering": "fast"}, 1, 5
    )
    assert list(score.returns) == [pytest.approx(steps * env.reward(), rel=1e-5)]


@pytest.mark.parametrize("parallel", [2, 5])
def test_an_evaluation_of_many_episodes_plays_them_in_turns(parallel, monkeypatch):
    made = []
    whole = evaluate(DoNothing(spaces.Box(-1, 1, (2,))), DOT.id, {}, 5, 7)
    monkeypatch.setattr(evaluation, "PARALLEL", parallel)
    monkeypatch.setattr(
        evaluation, "make_vec_env", lambda *rest: made.append(rest[-1]) or make_vec_env(*rest)
    )
    assert evaluate(DoNothing(spaces.Box(-1, 1, (2,))), DOT.id, {}, 5, 7) == whole
    assert len(set(whole.returns)) > 1 and made == ([2, 2, 1] if parallel == 2 else [5])


def test_evaluations_and_training_start_from_different_seeds(tmp_path):
    seeds = {job(tmp_path, seed=seed).evaluation_seed for seed in range(100)}
    assert len(seeds) == 100
    assert all(100 < seed < 2**31 - 100 for seed in seeds)


def test_runs_of_a_changed_preset_are_told_apart():
    plain, changed, longer = (
        str(make_plan("dmc", ["walker-stand"], Request("debug", settings=settings))[0].variant)
        for settings in ([], ["gamma=0.9", "env.rendering=near"], ["learn.frames=9000"])
    )
    assert (plain, changed, longer) == ("debug", "debug env.rendering=near gamma=0.9", "debug")


def test_data_that_have_grown_are_pretrained_on_anew(tmp_path):
    data = collect_data(job(tmp_path).shared).path.rename(tmp_path / "own")
    before = job(tmp_path, data=data).shared.model_path
    assert job(tmp_path, data=data).shared.model_path == before
    with TrajectoryDataset.open(data) as dataset:
        dataset.append(dataset[0])
    assert job(tmp_path, data=data).shared.model_path != before
