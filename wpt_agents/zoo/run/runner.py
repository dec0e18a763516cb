"""Execute runs: one task, method and seed per run folder, with all settings and results.

A run collects, pre-trains, indexes, fine-tunes and evaluates: five stages, each a function of its
inputs. `result.json` is written last: if it exists, the run is finished.
"""

import time
import traceback
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager

from rich.markup import escape
from stable_baselines3.common.base_class import BaseAlgorithm

from wpt_agents.zoo.judge.trained import final_model
from wpt_agents.zoo.locks import locked
from wpt_agents.zoo.plan.runs import Run
from wpt_agents.zoo.provenance import commit
from wpt_agents.zoo.report import record_page, tables
from wpt_agents.zoo.report.folders import Finished
from wpt_agents.zoo.result import Result, Score, read_result, write_result
from wpt_agents.zoo.run.checkpoints import (
    LOGS,
    Checkpoint,
    Origin,
    last_checkpoint,
    remove_checkpoints,
)
from wpt_agents.zoo.run.evaluating import draw, evaluate_policies, file_hash
from wpt_agents.zoo.run.folder import check_folder, clear, described
from wpt_agents.zoo.run.learning import Effort, build_index, learn, make_agent, make_training_env
from wpt_agents.zoo.run.shared import collect_data, pretrain
from wpt_agents.zoo.tasks import metric_of, short_name
from wpt_agents.zoo.terminal import console, say


def run_all(jobs: Sequence[Run], force: bool = False) -> bool:
    """Execute the runs in turn; a failed run is reported and does not stop the others.

    :param force: whether to replace finished runs
    :return: whether all are finished
    """
    for job in jobs:
        check_folder(job, force)
    finished = True
    for number, job in enumerate(jobs, 1):
        say(f"run {number}/{len(jobs)}", job.title)
        try:
            done = run(job, force)
        except Exception as error:  # any failure of one run must not stop the others
            finished = False
            console.print(f"[red]failed[/red]: {escape(str(error))}")
            if (trace := job.folder / "error.txt").exists():
                console.print(f"Traceback: {escape(str(trace))}")
            continue
        console.print(tables.scores_table(done))
        say("took", ", ".join(f"{stage} {s:.0f} s" for stage, s in done.seconds.items()))
        console.print(f"Run folder: [bold]{escape(str(job.folder.resolve()))}[/bold]")
    results = [result for job in jobs if (result := read_result(job.folder))]
    if len(results) > 1:
        console.print(tables.summary_table(tables.summarise(results)))
    return finished


def run(job: Run, force: bool = False) -> Result:
    """Execute the unfinished stages of a run, record its result if wanted, and return it."""
    result = _finish(job, force)
    record_finished([job])
    return result


def record_finished(jobs: Sequence[Run]) -> None:
    """Add the finished ones of these runs to their record, if they have one."""
    if not jobs or (record := jobs[0].record) is None:
        return
    results = ((job.folder, read_result(job.folder)) for job in jobs)
    record_page.add(record, [Finished(folder, one) for folder, one in results if one is not None])


def _finish(job: Run, force: bool) -> Result:
    check_folder(job, force)
    done = None if force else read_result(job.folder)
    if done is not None:
        say("run", "finished earlier, reused (--force replaces it)", job.folder)
        remove_checkpoints(job.folder)  # left if the process was killed right after its result
        return done
    with locked(job.folder / "lock"):
        if force:
            clear(job.folder)
        # another process may have finished it while this one waited for the lock
        return read_result(job.folder) or _begin(job)


def _begin(job: Run) -> Result:
    """Write the configuration into the folder, then execute the run."""
    with described(job.folder, job.config(), job.command):
        return do_stages(job)


class Clock:
    """The wall-clock seconds of each stage, those of earlier processes included."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        """Time a stage."""
        start = time.perf_counter()
        yield
        self.add({stage: time.perf_counter() - start})

    def add(self, seconds: Mapping[str, float]) -> None:
        """Add seconds of stages."""
        for stage, more in seconds.items():
            self.seconds[stage] = round(self.seconds.get(stage, 0.0) + more, 1)


def do_stages(job: Run) -> Result:
    """Execute the stages in turn; fine-tuning resumes from the last checkpoint, if any."""
    clock = Clock()
    dataset = None
    start = None
    checkpoint = last_checkpoint(job.folder)
    before = checkpoint.state.origin if checkpoint is not None else Origin()
    if job.algorithm.needs_data:
        with clock("collect"):
            dataset = collect_data(job.shared)
    if job.algorithm.pretrained and before.pretrained is None:  # else the checkpoint is enough
        assert dataset is not None, job.method
        with clock("pretrain"):
            start = pretrain(job.shared, dataset)
    clock.add(before.seconds)
    # The file may change while the run learns, or before it is resumed.
    pretrained = before.pretrained or (file_hash(start) if start is not None else None)
    prepare_logs(job, checkpoint)
    with closing(make_training_env(job)) as venv:
        agent = make_agent(job, venv, dataset, start, checkpoint)
        if dataset is not None and checkpoint is None:  # a resumed run has already retrieved
            with clock("index"):
                build_index(job, agent)
        commits = tuple(dict.fromkeys((*before.commits, commit() or "unknown")))
        origin = Origin(commits, pretrained, dict(clock.seconds))
        effort = learn(job, agent, checkpoint, origin)
        clock.seconds["learn"] = round(effort.seconds, 1)
        agent.save(job.folder / "model.zip")
    with clock("evaluate"):
        scores = evaluate_policies(job, agent)
    with clock("pictures"):
        try_to_draw(job, agent, scores)
    result = make_result(job, agent, scores, clock.seconds, effort, origin)
    write_result(job.folder, result)
    remove_checkpoints(job.folder)
    return result


def try_to_draw(job: Run, agent: BaseAlgorithm, scores: Mapping[str, Score]) -> None:
    """Draw the pictures; if one fails, for example without ffmpeg, the result counts anyway."""
    try:
        draw(job, agent, scores)
    except Exception as error:
        text = f"pictures are missing: {type(error).__name__}: {error}"
        say("warning", f"{escape(text)}; the traceback is in pictures.txt")
        (job.folder / "pictures.txt").write_text(traceback.format_exc(), encoding="utf-8")


def prepare_logs(job: Run, checkpoint: Checkpoint | None) -> None:
    """Restore the logs of the checkpoint, or delete old logs if there is none."""
    if checkpoint is not None:
        checkpoint.restore_logs(job.folder)
        return
    remove_checkpoints(job.folder)  # damaged ones
    for name in LOGS:
        (job.folder / name).unlink(missing_ok=True)


def make_result(
    job: Run,
    agent: BaseAlgorithm,
    scores: Mapping[str, Score],
    seconds: Mapping[str, float],
    effort: Effort,
    origin: Origin,
) -> Result:
    """Assemble the result of a run."""
    return Result(
        suite=job.task.suite,
        task=short_name(job.task),
        method=job.method,
        variant=job.variant,
        seed=job.seed,
        frames=job.preset.learn.frames,
        steps=job.preset.steps,
        metric=metric_of(job.task),
        scores=scores,
        seconds=seconds,
        commit=None if origin.commits == ("unknown",) else ", ".join(origin.commits),
        updates=getattr(agent, "updates", getattr(agent, "_n_updates", None)),
        cpu_seconds=round(effort.cpu_seconds, 1),
        model=file_hash(final_model(job.folder)),
        pretrained=origin.pretrained,
    )
