"""Engines: every run is done once, whatever kills its worker, and failures are reported."""

import os
import pickle
import signal
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest
import yaml
from dot_runs import dot, job  # noqa: F401  (dot registers the task for each test)
from engine_work import die_always, die_once, do_dot, fail, slow_once, touch
from zoo_command import call

from wpt_agents.zoo.locks import locked
from wpt_agents.zoo.plan.overview import identity_of
from wpt_agents.zoo.report import record
from wpt_agents.zoo.result import Result, Score, read_result, write_result
from wpt_agents.zoo.run import engines
from wpt_agents.zoo.run.engines import Local, Ray, Resources, Slurm, run_on
from wpt_agents.zoo.run.watch import standing
from wpt_agents.zoo.tasks import short_name
from wpt_agents.zoo.terminal import console

pytestmark = pytest.mark.slow  # it runs simulators or whole runs

PLACES = os.pathsep.join(
    [str(Path(__file__).parents[2] / "helpers"), *filter(None, sys.path)]
)  # for workers


def tick():
    time.sleep(0.02)


def times_done(one):
    path = one.folder / "done.txt"
    return len(path.read_text().splitlines()) if path.exists() else 0


@pytest.fixture
def jobs(tmp_path):
    return [job(tmp_path, seed=seed) for seed in range(2)]


def test_a_run_travels_to_another_process_with_its_command(tmp_path):
    one = job(tmp_path)
    assert pickle.loads(pickle.dumps(one)) == one
    assert pickle.loads(pickle.dumps(one)).command == one.command != ""
    assert replace(one, command="other") == one


def test_local_does_each_run_in_a_process_of_its_own(jobs):
    assert Local(Resources(workers=2)).map(touch, jobs, tick) == {}
    processes = {(one.folder / "done.txt").read_text() for one in jobs}
    assert len(processes) == 2 and f"{os.getpid()}\n" not in processes


def test_local_goes_on_with_what_was_killed(jobs):
    assert Local(Resources(workers=2)).map(die_once, jobs, tick) == {}
    assert [times_done(one) for one in jobs] == [1, 1]


def test_local_gives_up_after_its_retries_and_says_what_happened(tmp_path):
    one = job(tmp_path)
    assert Local(Resources(retries=1)).map(die_always, [one], tick) == {
        one.folder: "killed by SIGKILL"
    }
    assert times_done(one) == 2


@pytest.mark.filterwarnings("ignore")
def test_local_does_not_try_again_what_failed_by_itself(tmp_path):
    one = job(tmp_path)
    assert Local(Resources()).map(fail, [one], tick) == {one.folder: "RuntimeError: out of luck"}
    assert times_done(one) == 1


def test_a_process_ends_without_a_traceback_on_the_terminal(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(engines, "end_with_parent", lambda: None)
    before = signal.getsignal(signal.SIGINT)
    try:
        with pytest.raises(SystemExit, match="1"):
            engines._in_child(fail, job(tmp_path), 1)
        assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN  # the parent decides
    finally:
        signal.signal(signal.SIGINT, before)  # of the process of the tests
    assert capsys.readouterr().err == ""


def test_a_job_that_fails_before_its_run_begins_says_why_in_its_log(tmp_path, monkeypatch):
    def refuse(_):
        raise ValueError("worked on by another process")

    one = job(tmp_path)
    one.folder.mkdir(parents=True)
    (one.folder / "error.txt").write_text("RuntimeError: of an earlier time\n")
    monkeypatch.setattr(engines.runner, "run", refuse)
    with pytest.raises(ValueError, match="another process"):
        engines.do(one)
    reason = engines.why(engines.trace_of(one.folder), 1)
    assert reason == "ValueError: worked on by another process"
    (one.folder / "error.txt").write_text("Traceback\nRuntimeError: out of luck\n")
    assert engines.why(engines.trace_of(one.folder), 1) == "RuntimeError: out of luck"


@pytest.mark.filterwarnings("ignore")
def test_data_that_cannot_be_made_are_told_with_their_own_reason_and_the_log(tmp_path):
    one = job(tmp_path)  # whose task is unknown to other processes
    one.folder.mkdir(parents=True)
    (one.folder / "config.yaml").write_text(yaml.safe_dump(one.config()))
    (one.folder / "error.txt").write_text("RuntimeError: of an earlier time\n")
    with pytest.raises(ValueError, match=r"ValueError: No task .*'dot'.* \(see .*cache/log.txt\)"):
        run_on("local", [one], False, Resources(workers=1))


def test_a_job_knows_its_record_wherever_its_process_starts(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    one = engines._at_absolute_paths(replace(job(Path("runs")), record=Path("mid.csv")))
    assert one.record == tmp_path / "mid.csv"
    assert engines._at_absolute_paths(job(Path("runs"))).record is None


def test_a_real_run_on_an_engine_leaves_the_same_folder(tmp_path, monkeypatch):
    monkeypatch.setattr(engines, "do", do_dot)
    one = job(tmp_path, "scratch")
    assert run_on("local", [one], False, Resources(workers=1))
    assert read_result(one.folder).seed == 0
    assert "evaluate" in (one.folder / "log.txt").read_text()
    assert (one.folder / "command.txt").read_text().strip() == one.command
    assert standing(one).state == "finished"


def finish(one):
    """Leave the folder of a finished run, without a run."""
    one.folder.mkdir(parents=True)
    (one.folder / "config.yaml").write_text(yaml.safe_dump(one.config()))
    names = one.task.suite, short_name(one.task), one.method, one.variant, one.seed
    budget = one.preset.learn.frames, one.preset.steps, "return"
    write_result(one.folder, Result(*names, *budget, {"last": Score((1.0,))}))


def test_an_engine_records_finished_runs_and_reports_one_that_it_could_not_record(
    tmp_path, monkeypatch
):
    path = tmp_path / "toy.csv"
    first, second = (
        replace(job(tmp_path / "runs", "scratch", seed=seed), record=path) for seed in range(2)
    )
    finish(first)
    monkeypatch.setattr(Local, "map", lambda *_: {})
    assert run_on("local", [first], False, Resources())
    assert {line.identity for line in record.read(path)} == {identity_of(first)}

    def fail_to_record(_, work, jobs, tick):
        for one in jobs:
            finish(one)
        return {one.folder: "ValueError: no record" for one in jobs}

    monkeypatch.setattr(Local, "map", fail_to_record)
    assert not run_on("local", [first, second], False, Resources())
    assert read_result(second.folder) is not None


def test_force_deletes_nothing_unless_it_can_begin(jobs):
    for one in jobs:
        one.folder.mkdir(parents=True)
        (one.folder / "config.yaml").write_text(yaml.safe_dump(one.config()))
        (one.folder / "result.json").write_text("{}")
    with (
        locked(jobs[1].folder / "lock"),
        pytest.raises(ValueError, match="worked on by another process"),
    ):
        run_on("local", jobs, True, Resources())
    assert (jobs[0].folder / "result.json").exists()


def test_an_unknown_engine_is_answered_with_the_nearest(tmp_path):
    with pytest.raises(ValueError, match="Did you mean 'slurm'"):
        run_on("slurn", [job(tmp_path)], False, Resources())
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("engine", "module"), [("ray", "ray"), ("slurm", "submitit")])
def test_an_engine_that_is_not_installed_is_told_before_any_work(
    engine, module, monkeypatch, tmp_path, capsys
):
    monkeypatch.setitem(sys.modules, module, None)  # what a missing module looks like
    words = ["run", "--tasks", "dot", "--method", "scratch", "--preset", "debug"]
    words += ["--engine", engine]
    for also in ([], ["--dry-run"]):
        assert call(monkeypatch, *words, *also, "--out", tmp_path / "runs") == 2
        assert f'pip install "wpt-agents[{engine}]"' in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_no_engine_is_imported_unless_asked_for():
    import subprocess

    code = "import sys, wpt_agents.zoo.run.engines; print({'ray', 'submitit'} & sys.modules.keys())"
    process = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert process.stdout.strip() == "set()"


@pytest.fixture(scope="module")
def ray():
    module = pytest.importorskip("ray", reason="the extra `ray` is not installed")
    os.environ.setdefault("RAY_raylet_start_wait_time_s", "300")  # on a busy machine
    module.init(
        num_cpus=2,
        include_dashboard=False,
        log_to_driver=False,
        runtime_env={"env_vars": {"PYTHONPATH": PLACES, "OMP_NUM_THREADS": "1"}},
    )
    yield module
    module.shutdown()


@pytest.mark.filterwarnings("ignore")
def test_ray_does_the_runs_and_goes_on_with_what_was_killed(ray, jobs):
    assert Ray(Resources(memory_gb=0.1)).map(die_once, jobs, tick) == {}
    assert [times_done(one) for one in jobs] == [1, 1]


@pytest.mark.filterwarnings("ignore")
def test_ray_tells_what_failed(ray, tmp_path):
    one = job(tmp_path)
    errors = Ray(Resources(memory_gb=0.1)).map(fail, [one], tick)
    assert "out of luck" in errors[one.folder]


def test_ray_refuses_to_wait_for_what_the_cluster_does_not_have(ray):
    with pytest.raises(ValueError, match=r"has 2 CPU, a run asks for 64: ask for less"):
        Ray(Resources(cpus=64))


@pytest.mark.filterwarnings("ignore")
def test_slurm_through_submitit_goes_on_after_a_preemption(tmp_path, monkeypatch):
    pytest.importorskip("submitit", reason="the extra `slurm` is not installed")
    monkeypatch.setenv("PYTHONPATH", PLACES)
    one, engine = job(tmp_path), Slurm(Resources(partition="local"))
    preempted = []

    def preempt_once():
        time.sleep(0.2)
        if not preempted and (one.folder / "begun").exists():
            os.kill(int((one.folder / "begun").read_text()), signal.SIGUSR2)
            preempted.append(True)

    assert engine.map(slow_once, [one], preempt_once) == {}
    assert preempted and times_done(one) == 1


def test_slurm_that_is_not_here_is_told(monkeypatch):
    pytest.importorskip("submitit", reason="the extra `slurm` is not installed")
    monkeypatch.setattr(engines.shutil, "which", lambda _: None)
    with pytest.raises(ValueError, match="no `srun` here"):
        Slurm(Resources())


def test_the_consoles_file_is_given_back(tmp_path):
    before = console.file
    with engines.logged(tmp_path / "log.txt"):
        console.print("said")
        print("printed")
    assert console.file is before
    assert (tmp_path / "log.txt").read_text() == "said\nprinted\n"
