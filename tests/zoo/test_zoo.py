"""The runner end to end, on a toy task and the smallest networks."""

import csv
import hashlib
import io
import json
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import toy_env
import yaml
from debug_agent import recorded
from rich.console import Console
from run_folders import make_run
from scipy import stats
from stable_baselines3.common.results_plotter import load_results, ts2xy
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv
from typer.main import get_command
from wpt_envs.tasks import TASKS, Task
from zoo_command import call

from wpt_agents.agents.wpt import WPT
from wpt_agents.data.dataset import TrajectoryDataset
from wpt_agents.training.learner import Learner
from wpt_agents.zoo.commands import app as command_line
from wpt_agents.zoo.judge.evaluation import evaluate, make_vec_env
from wpt_agents.zoo.judge.untrained import DoNothing, RandomPolicy
from wpt_agents.zoo.plan.methods import METHODS
from wpt_agents.zoo.plan.presets import Preset
from wpt_agents.zoo.plan.runs import Run, make_plan
from wpt_agents.zoo.provenance import commit
from wpt_agents.zoo.report import record, tables
from wpt_agents.zoo.report.folders import find_finished, read_results
from wpt_agents.zoo.result import Result, Score, Variant, read_result, write_result
from wpt_agents.zoo.run import learning, runner, shared
from wpt_agents.zoo.run.runner import run
from wpt_agents.zoo.run.shared import collect_data, pretrain
from wpt_agents.zoo.statistics import mean_interval
from wpt_agents.zoo.terminal import console

pytestmark = pytest.mark.slow  # it runs simulators or whole runs

DOT = Task("dmc", "dot", "dot", 2, toy_env.LENGTH, "return", False)
MODEL_FREE = {
    "channels": 2,
    "feature_dim": 8,
    "hidden_dim": 16,
    "batch_size": 4,
    "update_every": 5,
    "learning_starts": 25,
    "warmup_steps": 25,
}
SECTIONS = {
    "env": {"action_repeat": 1, "rendering": "fast"},
    "collect": {"tasks": ["dot"], "episodes": 4},
    "pretrain": {"steps": 2},
    "learn": {"frames": 75},
    "evaluate": {"episodes": 3},
    "wpt": {
        "size": "debug",
        "max_action_dim": 2,
        "batch_size": 2,
        "batch_length": 8,
        "train_ratio": 2,
        "learning_starts": 25,
        "warmup_steps": 25,
        "num_retrieve": 3,
        "bc_steps": 2,
        "bc_batch_size": 4,
    },
    "drqv2": MODEL_FREE | {"std": "linear(1,0.1,50)"},
    "jsrl": {"bc_size": "debug", "bc_steps": 2, "bc_batch_size": 4, "warmup_steps": 0},
    "r3m": {"clips": 4},
    "rlpd": MODEL_FREE | {"critics": 2, "reward_members": 2, "num_retrieve": 3},
    "mrq": {
        "channels": 2,
        "latent_dim": 8,
        "hidden_dim": 8,
        "batch_size": 4,
        "horizon": 2,
        "sync_every": 2,
        "update_every": 10,
        "learning_starts": 25,
        "warmup_steps": 25,
    },
    "sac": {"buffer_size": 100, "learning_starts": 25, "batch_size": 4, "train_freq": 10},
}


def make_dot(action_repeat=1, rendering="fast", render_size=None, render_mode="rgb_array"):
    return toy_env.DotEnv(render_mode)


@pytest.fixture(autouse=True)
def dot(monkeypatch):
    monkeypatch.setitem(TASKS, DOT.id, DOT)
    gym.register(DOT.id, entry_point=make_dot)
    monkeypatch.setattr(console, "_width", 160)
    yield
    del gym.registry[DOT.id]


def job(tmp_path, method="wpt", seed=0, data=None, **changes):
    sections = {title: SECTIONS[title] | changes.get(title, {}) for title in SECTIONS}
    return Run(DOT, seed, method, "toy", Preset.of(sections), tmp_path, 1, data=data)


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


def _without_times(path):
    rows = csv.DictReader(path.read_text().splitlines())
    return [{k: v for k, v in row.items() if not k.startswith("time/fps")} for row in rows]


def test_a_finished_run_is_not_done_again_unless_forced(tmp_path, monkeypatch):
    first = run(job(tmp_path))
    done = (job(tmp_path).folder / "result.json").stat().st_mtime_ns
    assert run(job(tmp_path)) == first
    assert (job(tmp_path).folder / "result.json").stat().st_mtime_ns == done
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


def test_a_dataset_of_ones_own_takes_the_place_of_the_presets(tmp_path):
    data = collect_data(job(tmp_path).shared).path.rename(tmp_path / "own")
    one = job(tmp_path, data=data)
    assert one.shared.model_path != job(tmp_path).shared.model_path
    run(one)
    assert TrajectoryDataset.open(data).fingerprint.startswith(one.config()["data"])
    assert not list((tmp_path / "cache").glob("data-*"))
    path = one.shared.model_path
    assert job(tmp_path, data=data.rename(tmp_path / "moved")).shared.model_path == path


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
    with pytest.raises(ValueError, match="no run folder"):
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


def test_evaluations_and_training_start_from_different_seeds(tmp_path):
    seeds = {job(tmp_path, seed=seed).evaluation_seed for seed in range(100)}
    assert len(seeds) == 100
    assert all(100 < seed < 2**31 - 100 for seed in seeds)


@pytest.mark.parametrize("n", [2, 3, 10, 31, 50])
def test_the_interval_is_students(n):
    values = np.random.default_rng(n).normal(5, 2, n)
    expected = stats.t.interval(0.95, n - 1, values.mean(), stats.sem(values))
    assert mean_interval(values.tolist())[1:] == pytest.approx(expected, abs=2e-3)


def test_one_value_has_no_interval():
    assert mean_interval([3.0]) == (3.0, None, None)


def fake_result(seed, mean, method="wpt", frames=150_000, untrained=()):
    score = Score((mean - 10, mean + 10))
    scores = {**dict.fromkeys(untrained, Score((-9.0, 11.0))), "last": score}
    where = "dmc", "dmc-walker-run", method, Variant("paper"), seed, frames, frames // 2
    return Result(*where, "return", scores, {}, "abc")


def test_the_report_is_the_mean_over_seeds_beside_the_papers_number(tmp_path):
    for seed, mean in enumerate((700.0, 710.0, 720.0)):
        (tmp_path / str(seed)).mkdir()
        write_result(tmp_path / str(seed), fake_result(seed, mean))
    (row,) = tables.summarise(read_results(tmp_path))
    # sd 10, t 4.303 with two degrees of freedom: 710 -+ 4.303 * 10 / sqrt(3) = 24.8
    assert (row.seeds, row.mean, row.paper) == (3, 710, 728.0)
    assert (row.low, row.high) == pytest.approx((685.2, 734.8), abs=0.1)


def test_the_report_keeps_methods_and_budgets_apart():
    other = fake_result(0, 1.0, frames=1)
    rows = tables.summarise([fake_result(0, 1.0), fake_result(0, 2.0, "scratch"), other])
    assert [(row.method, row.frames) for row in rows] == [
        ("scratch", 150_000),
        ("wpt", 1),
        ("wpt", 150_000),
    ]


def test_the_report_prints_as_table_and_as_markdown(capsys):
    rows = tables.summarise([fake_result(0, 1.234), fake_result(0, 456.7, "scratch")])
    Console(width=200).print(tables.summary_table(rows))
    printed = capsys.readouterr().out
    for text in (printed, tables.markdown(rows)):
        assert "1.23" in text
        assert "457" in text
    assert tables.markdown(rows).count("\n") == 4


def test_every_policy_has_its_seeds_and_three_intervals():
    results = [fake_result(seed, mean) for seed, mean in enumerate((700.0, 710.0, 720.0))]
    (row,) = tables.policies(results)
    assert (row.name, row.seeds, row.means, row.mean) == ("wpt", (0, 1, 2), (700, 710, 720), 710)
    # six episodes, each 10 from its seed's mean: sd of the mean 10 / sqrt(6) = 4.1, extremes 700
    assert 700 <= row.episodes_low < 705 and 715 < row.episodes_high <= 720
    # all three draws the same seed: probability 1/27 > 2.5 %
    assert (row.seeds_low, row.seeds_high) == (700, 720)
    assert (row.t_low, row.t_high) == pytest.approx((685.2, 734.8), abs=0.1)
    assert (row.episodes, row.commits, row.success) == (2, ("abc",), None)


def test_untrained_policies_are_told_once_however_many_methods_met_them():
    methods = ("wpt", "scratch")
    results = [fake_result(0, 5.0, method, untrained=["nothing"]) for method in methods]
    rows = tables.policies(results)
    assert [(row.method, row.policy) for row in rows] == [
        ("", "nothing"),
        ("scratch", "last"),
        ("wpt", "last"),
    ]
    assert rows[0].seeds_low is None  # one seed
    table = tables.policy_markdown(rows)
    assert "| doing nothing | 1.00 | 1.00 | -9.0 to 11.0 | - | - | - |" in table
    assert "| scratch | 5.0 |" in table
    assert "Seeds 0, 2 episodes each; commit abc." in table


def test_the_csv_reads_back_unrounded():
    rows = tables.policies([fake_result(seed, 1 / 3 + seed) for seed in (0, 4)])
    (read,) = csv.DictReader(io.StringIO(tables.policy_csv(rows)))
    assert read["means"] == f"{rows[0].means[0]} {rows[0].means[1]}" and read["seeds"] == "0 4"
    assert float(read["mean"]) == rows[0].mean
    assert read["success"] == ""


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["run", "--preset", "demmo"], "Did you mean 'demo'"),
        (["run", "--suite", "dcm"], "Did you mean 'dmc'"),
        (["run", "--tasks", "walker-rum"], "Did you mean 'walker-run'"),
        (["run", "--set", "gama=1"], "Did you mean 'gamma'"),
        (["run", "--set", "learn.fames=1"], "Did you mean 'frames'"),
        (["run", "--method", "scrath"], "Did you mean 'scratch'"),
        (["run", "--seeds", "none"], "how many"),
        (["run", "--tasks", "walker-run", "walker-rum"], "Did you mean 'walker-run'"),
        (["run", "--data", "nowhere"], "nowhere does not exist"),
        (["report", "nowhere"], "No finished run below nowhere"),
        (["list", "--suite", "dcm"], "Did you mean 'dmc'"),
        (["pretrain", "--preset", "demmo"], "Did you mean 'demo'"),
        (["collect", "--out", "data", "--tasks", "walker-rum"], "Did you mean 'walker-run'"),
        (["collect", "--out", "data", "--behaviour", "icn"], "Did you mean 'icm'"),
        (["collect", "--out", "data", "--behaviour", "icm", "--set", "gama=1"], "mean 'gamma'"),
        (["collect", "--out", "data", "--behaviour", "icm", "--set", "gamma=2"], "gamma must be a"),
        (["run", "--preset", "debug", "--device", "cuda:99"], "--device cuda:99: torch"),
        (["run", "--preset", "debug", "--device", "gpu"], "write auto, cpu, cuda"),
        (["run", "--preset", "debug", "--device", "gpu", "--engine", "local"], "write auto, cpu"),
        (["pretrain", "--preset", "debug", "--device", "cuda:99"], "--device cuda:99: torch"),
    ],
)
def test_a_wrong_name_ends_in_the_nearest_valid_one_and_code_2(
    words, message, monkeypatch, capsys, tmp_path
):
    monkeypatch.chdir(tmp_path)
    assert call(monkeypatch, *words) == 2
    printed = capsys.readouterr()
    assert message in printed.err
    assert "Traceback" not in printed.err and printed.out == ""  # refused before anything is begun
    assert list(tmp_path.iterdir()) == []


COMMANDS = get_command(command_line.app).commands


@pytest.mark.parametrize("command", [[], *([name] for name in COMMANDS)])
def test_every_command_has_help(command, monkeypatch, capsys):
    assert call(monkeypatch, *command, "--help") == 0
    assert "Usage" in capsys.readouterr().out


def test_the_list_shows_tasks_presets_and_methods(monkeypatch, capsys):
    assert call(monkeypatch, "list", "--suite", "dmc") == 0
    printed = capsys.readouterr().out
    for word in ("dmc-quadruped-roll-fast", "demo", "no-rehearsal"):
        assert word in printed
    assert "metaworld-" not in printed


def test_a_dry_run_shows_the_plan_and_writes_nothing(monkeypatch, capsys, tmp_path):
    words = ["--tasks", "walker-run", "cheetah-*", "--seeds", "2", "--out", tmp_path / "runs"]
    assert call(monkeypatch, "run", *words, "--preset", "debug", "--dry-run") == 0
    printed = capsys.readouterr().out
    assert printed.count("dmc-cheetah-run-back ") == 2
    assert "6 episodes to collect" in printed and " runs to do" in printed
    assert not (tmp_path / "runs").exists()


def test_a_dry_run_ends_in_what_the_run_would_be_refused_for(monkeypatch, capsys, tmp_path):
    words = ["--tasks", "walker-run", "--device", "cuda:99", "--preset", "debug", "--dry-run"]
    assert call(monkeypatch, "run", *words, "--out", tmp_path / "runs") == 2
    printed = capsys.readouterr()
    assert "1 of 1 run to do" in printed.out and "--device cuda:99" in printed.err


def test_a_dry_run_tells_of_a_folder_with_other_settings_too(monkeypatch, capsys, tmp_path):
    words = ["--tasks", "walker-run", "--preset", "debug", "--out", tmp_path]
    folder = tmp_path / "debug" / "wpt" / "dmc-walker-run_0"
    folder.mkdir(parents=True)
    [one] = make_plan("dmc", ["walker-run"], "debug", "1", ["wpt"], [], tmp_path, 2, "auto")
    (folder / "config.yaml").write_text(yaml.safe_dump(json.loads(json.dumps(one.config()))))
    assert call(monkeypatch, "run", *words, "--dry-run") == 0
    assert call(monkeypatch, "run", *words, "--dry-run", "--set", "gamma=0.9") == 2
    assert "other settings (wpt.gamma)" in capsys.readouterr().err


def test_collecting_ends_in_a_summary_of_what_there_is(monkeypatch, capsys, tmp_path):
    words = ["--tasks", "dot", "--episodes", "2", "--workers", "1", "--rendering", "fast"]
    assert call(monkeypatch, "collect", "--out", tmp_path / "data", *words) == 0
    printed = capsys.readouterr().out
    assert "embodiment" in printed and "Dataset:" in printed and "{" not in printed


def test_the_whole_command_line_runs_and_reports(monkeypatch, capsys, tmp_path):
    sections = [f"{t}.{k}={json.dumps(v)}" for t in SECTIONS for k, v in SECTIONS[t].items()]
    words = ["run", "--preset", "debug", "--tasks", "dot", "--out", tmp_path, "--workers", "1"]
    assert call(monkeypatch, *words, "--frames", "50", "--set", *sections) == 0
    folder = tmp_path / "debug" / "wpt" / "dmc-dot_0"
    assert str(folder) in capsys.readouterr().out
    assert json.loads((folder / "result.json").read_text())["frames"] == 50
    assert call(monkeypatch, "report", tmp_path) == 0
    assert "dmc-dot" in capsys.readouterr().out
    assert call(monkeypatch, "report", tmp_path, "--markdown") == 0
    printed = capsys.readouterr().out
    assert all(f"| {name} |" in printed for name in ("doing nothing", "prior actor", "wpt"))
    assert call(monkeypatch, "report", tmp_path, "--csv") == 0
    assert capsys.readouterr().out.startswith("task,preset,frames,method,policy")


def test_the_same_run_found_twice_is_refused_instead_of_counted_as_two_seeds(tmp_path):
    make_run(tmp_path / "a", "dmc-dot")
    make_run(tmp_path / "b", "dmc-dot")
    with pytest.raises(ValueError, match="are the same run: report one of their folders"):
        read_results(tmp_path)


def test_runs_of_a_changed_preset_are_told_apart(tmp_path):
    arguments = "dmc", ["walker-stand"], "debug", "1", ["wpt"]
    plain, changed, longer = (
        str(make_plan(*arguments, settings, tmp_path, 1, "cpu")[0].variant)
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
