"""Engines: runs in processes of their own, on a Ray cluster, or as Slurm jobs.

All engines first execute the shared stages (data, pre-trained model), then one job per run, which
resumes from its last checkpoint if its worker died. They use the same folders, which must be on a
file system that all machines share. Ray and submitit are imported only when needed.
"""

import shutil
import signal
import sys
from collections import Counter, deque
from collections.abc import Callable, Collection, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from multiprocessing import get_context
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

import torch
from rich.markup import escape

from wpt_agents.files.names import counted
from wpt_agents.training.signals import StopSignals
from wpt_agents.zoo.collect.workers import end_with_parent
from wpt_agents.zoo.locks import locked
from wpt_agents.zoo.machine import check_machine, import_extra
from wpt_agents.zoo.plan.runs import Run
from wpt_agents.zoo.result import read_result
from wpt_agents.zoo.run import runner
from wpt_agents.zoo.run.checkpoints import last_checkpoint
from wpt_agents.zoo.run.folder import check_folder, clear
from wpt_agents.zoo.run.shared import collect_data, pretrain
from wpt_agents.zoo.run.watch import shown
from wpt_agents.zoo.terminal import console, logged, say

Work = Callable[[Run], None]
Tick = Callable[[], None]  # called repeatedly while waiting; should be fast
Errors = dict[Path, str]  # by run folder, of the runs that failed
STOPPING = (
    "each run first completes its episode and its updates, and is saved; Ctrl-C again stops all "
    "runs at once"
)


@dataclass(frozen=True)
class Resources:
    """The resources of one job, and the number of retries if its worker dies.

    :param hours: the time limit of a Slurm job, after which it is resubmitted and resumes
    :param address: the address of the Ray cluster; "" starts one on this machine
    :param partition: the Slurm partition; "local" executes the jobs on this machine without Slurm
    """

    workers: int = 2
    cpus: int = 1
    gpus: float = 0
    memory_gb: float = 4
    hours: float = 24
    retries: int = 2
    address: str = ""
    partition: str = ""


def run_on(engine: str, jobs: Sequence[Run], force: bool, resources: Resources) -> bool:
    """Execute the runs on an engine and show their progress.

    :return: True if all are finished, and recorded if wanted
    """
    check_machine(engine, jobs[0].device)
    jobs = [_at_absolute_paths(job) for job in jobs]
    for job in jobs:
        check_folder(job, force)
    engines: dict[str, type[Local | Ray | Slurm]] = {"local": Local, "ray": Ray, "slurm": Slurm}
    chosen = engines[engine](resources)
    left = [job for job in jobs if force or read_result(job.folder) is None]
    if force:
        clear_all([job.folder for job in left])
    # A worker may have been killed, or have failed, between its result and the record.
    runner.record_finished([job for job in jobs if job not in left])
    by_need = sorted(left, key=needs_model)
    shared = {job.shared.model_path: job for job in by_need if job.algorithm.needs_data}
    cpus = counted(resources.cpus, "CPU")
    say("engine", f"{engine}: {len(left)} of {counted(len(jobs), 'run')} to do, {cpus} each")
    with shown(jobs) as tick:
        if errors := chosen.map(make_shared, list(shared.values()), tick):
            reason = f"{next(iter(errors.values()))} (see {jobs[0].shared.log})"
            raise ValueError(f"The data or model that the runs share could not be made: {reason}")
        errors = chosen.map(do, left, tick)
    for folder, error in errors.items():
        console.print(f"[red]failed[/red] {escape(str(folder))}: {escape(error)}")
    return not errors and all(read_result(job.folder) for job in jobs)


def clear_all(folders: Sequence[Path]) -> None:
    """Clear the folders, or none of them if another process is using one."""
    with ExitStack() as locks:
        for folder in folders:  # all of them, before anything is deleted
            locks.enter_context(locked(folder / "lock"))
        for folder in folders:
            clear(folder)


def _at_absolute_paths(job: Run) -> Run:
    data = job.data.resolve() if job.data is not None else None
    record = job.record.resolve() if job.record is not None else None
    return replace(job, out=job.out.resolve(), data=data, record=record)


def make_shared(job: Run) -> None:
    """Execute the shared stages of `job`, with their output in the cache's `log.txt`."""
    with logged(job.shared.log):
        dataset = collect_data(job.shared)
        if needs_model(job):
            pretrain(job.shared, dataset)


def needs_model(job: Run) -> bool:
    """Return whether a run needs the pre-trained model: if no checkpoint has its weights."""
    if not job.algorithm.pretrained:
        return False
    checkpoint = last_checkpoint(job.folder)
    return checkpoint is None or checkpoint.state.origin.pretrained is None


def do(job: Run) -> None:
    """Execute the run of a job, with its output in the folder's `log.txt`."""
    (job.folder / "error.txt").unlink(missing_ok=True)  # of an earlier attempt: see `trace_of`
    with logged(job.folder / "log.txt"):
        runner.run(job)


class Local:
    """The engine with `workers` simultaneous processes, one for each run."""

    def __init__(self, resources: Resources) -> None:
        self.resources = resources

    def map(self, work: Work, jobs: Sequence[Run], tick: Tick) -> Errors:
        """Execute the jobs; a job whose process is killed resumes in a new one.

        :return: the errors of the jobs that failed
        """
        waiting = deque(jobs)
        deaths = Counter[Path]()
        errors = {}
        running: dict[BaseProcess, Run] = {}
        with StopSignals() as signals, ExitStack() as stack:
            stack.callback(stop, running)  # the work is saved before a signal takes effect
            while (waiting or running) and not signals.received:
                while waiting and len(running) < self.resources.workers:
                    job = waiting.popleft()
                    running[self.start(work, job)] = job
                tick()
                for process in [one for one in running if one.exitcode is not None]:
                    job = running.pop(process)
                    code = process.exitcode or 0
                    deaths[job.folder] += code < 0
                    if code < 0 and deaths[job.folder] <= self.resources.retries:
                        waiting.append(job)
                    elif code:
                        trace = job.shared.log if work is make_shared else trace_of(job.folder)
                        errors[job.folder] = why(trace, code)
        return errors

    def start(self, work: Work, job: Run) -> BaseProcess:
        """Start a new process, so that runs do not share any state."""
        context = get_context("forkserver")  # imports the modules of all runs once
        context.set_forkserver_preload([runner.__name__])
        process = context.Process(target=_in_child, args=(work, job, self.resources.cpus))
        process.start()
        return process


def _in_process(work: Work, job: Run, cpus: int) -> None:
    torch.set_num_threads(cpus)
    work(job)


def stop(processes: Collection[BaseProcess]) -> None:
    """End processes as soon as they have saved their work; Ctrl-C meanwhile kills them."""
    for process in processes:
        process.terminate()
    try:
        if processes:
            say("stop", STOPPING)
        for process in processes:
            process.join()
    except KeyboardInterrupt:
        for process in processes:
            process.kill()
        raise


def _in_child(work: Work, job: Run, cpus: int) -> None:
    end_with_parent()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # of a terminal; the parent decides: see `stop`
    try:
        _in_process(work, job, cpus)
    except Exception:  # the job's log has the traceback; the parent reports it
        sys.exit(1)


def trace_of(folder: Path) -> Path:
    """Return the file with the traceback of a failed run: its log if it failed before it began."""
    error = folder / "error.txt"
    return error if error.exists() else folder / "log.txt"


def why(trace: Path, code: int) -> str:
    """Return the last line of a failed job's traceback, or the signal that ended it."""
    if code < 0:
        return f"killed by {signal.Signals(-code).name}"
    lines = trace.read_text(encoding="utf-8").strip().splitlines() if trace.exists() else []
    return lines[-1] if lines else f"exit code {code}"


class Ray:
    """The engine with a Ray task for each run, which Ray restarts if its worker dies."""

    def __init__(self, resources: Resources) -> None:
        self.resources = resources
        self.ray = import_extra("ray", "ray")
        if not self.ray.is_initialized():
            try:
                self.ray.init(address=resources.address or None, log_to_driver=False)
            except Exception as error:  # Ray raises a bare one when its processes do not start
                raise ValueError(
                    f"No Ray cluster answers at {resources.address!r} ({error}); "
                    "start one with `ray start --head`, or leave --address out"
                ) from None
        self.check_resources()

    def map(self, work: Work, jobs: Sequence[Run], tick: Tick) -> Errors:
        """Do the work of each job.

        :return: the errors of the jobs that failed
        """
        errors = {}
        remote = self.ray.remote(
            num_cpus=self.resources.cpus,
            num_gpus=self.resources.gpus,
            memory=int(self.resources.memory_gb * 2**30),
            max_retries=self.resources.retries,
        )
        task = remote(work)
        waiting = {task.remote(job): job for job in jobs}
        while waiting:
            tick()
            ready, _ = self.ray.wait(list(waiting), num_returns=len(waiting), timeout=0)
            for reference in ready:
                job = waiting.pop(reference)
                try:
                    self.ray.get(reference)
                except self.ray.exceptions.RayError as error:
                    errors[job.folder] = str(error).strip().splitlines()[-1]
        return errors

    def check_resources(self) -> None:
        """Raise an error if the cluster does not have the requested resources."""
        cluster = self.ray.cluster_resources()
        resources = self.resources
        memory = resources.memory_gb * 2**30
        for name, asked in (("CPU", resources.cpus), ("GPU", resources.gpus), ("memory", memory)):
            if cluster.get(name, 0) < asked:
                raise ValueError(
                    f"The Ray cluster has {cluster.get(name, 0):g} {name}, a run asks for "
                    f"{asked:g}: ask for less (--cpus, --gpus, --memory-gb), or add machines"
                )


class Slurm:
    """The engine with a Slurm job for each run (submitit), which is resubmitted if preempted."""

    def __init__(self, resources: Resources) -> None:
        self.resources = resources
        self.submitit = import_extra("submitit", "slurm")
        if resources.partition != "local" and shutil.which("srun") is None:
            raise ValueError(
                "--engine slurm: there is no `srun` here; start it on a login node of the cluster, "
                "or try it out with --partition local"
            )

    def map(self, work: Work, jobs: Sequence[Run], tick: Tick) -> Errors:
        """Do the work of each job.

        :return: the errors of the jobs that failed
        """
        preemptible = Preemptible(work, self.resources.cpus)
        errors = {}
        sent = [(job, self.executor(job.out).submit(preemptible, job)) for job in jobs]
        while not all(handle.done() for _, handle in sent):
            tick()
        for job, handle in sent:
            if (error := handle.exception()) is not None:
                errors[job.folder] = str(error).strip().splitlines()[-1]
        return errors

    def executor(self, out: Path) -> Any:
        """Return submitit's executor with the resources; its logs go to `out/slurm`."""
        resources = self.resources
        local = resources.partition == "local"
        executor = self.submitit.AutoExecutor(out / "slurm", cluster="local" if local else "slurm")
        executor.update_parameters(
            name="wpt",
            timeout_min=int(resources.hours * 60),
            cpus_per_task=resources.cpus,
            mem_gb=resources.memory_gb,
            gpus_per_node=int(resources.gpus),
        )
        if resources.partition and not local:
            executor.update_parameters(slurm_partition=resources.partition)
        return executor


@dataclass(frozen=True)
class Preemptible:
    """A job that submitit resubmits if Slurm ends it, to resume from its last checkpoint."""

    work: Work
    cpus: int = 1

    def __call__(self, job: Run) -> None:
        """Do the work."""
        _in_process(self.work, job, self.cpus)

    def checkpoint(self, job: Run) -> Any:
        """Return the job to resubmit after a preemption."""
        submitit = import_extra("submitit", "slurm")
        return submitit.helpers.DelayedSubmission(self, job)
