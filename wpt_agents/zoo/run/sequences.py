"""Execute a sequence of tasks that one agent learns in turn; it can be resumed at any time.

Each task has a folder with the logs, checkpoints and model file of an ordinary run, and with
`scores.json` once it is finished. An agent starts the next task from files alone, so a killed
sequence resumes exactly. The episodes of all tasks are kept until the sequence ends.
`sequence.json` contains the results of the finished tasks.
"""

import shutil
from collections.abc import Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

from rich.markup import escape
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.type_aliases import PolicyPredictor
from stable_baselines3.common.vec_env import VecEnv

from wpt_agents.agents.packnet import PackNet
from wpt_agents.agents.wpt import WPT
from wpt_agents.data.dataset import TrajectoryDataset
from wpt_agents.data.replay import ReplayBuffer
from wpt_agents.zoo.locks import locked
from wpt_agents.zoo.plan.sequences import SequenceRun
from wpt_agents.zoo.provenance import commit
from wpt_agents.zoo.run.checkpoints import Checkpoint, Origin, last_checkpoint
from wpt_agents.zoo.run.evaluating import play
from wpt_agents.zoo.run.folder import check_config, clear, described
from wpt_agents.zoo.run.learning import (
    build_index,
    learn,
    load_agent,
    make_agent,
    make_training_env,
)
from wpt_agents.zoo.run.logs import go_to_episode
from wpt_agents.zoo.run.runner import prepare_logs
from wpt_agents.zoo.run.shared import collect_data, pretrain
from wpt_agents.zoo.sequence_result import (
    Row,
    SequenceResult,
    read_row,
    read_sequence,
    write_row,
    write_sequence,
)
from wpt_agents.zoo.tasks import short_name
from wpt_agents.zoo.terminal import console, say


def run_sequences(jobs: Sequence[SequenceRun], force: bool = False) -> bool:
    """Execute the sequences in turn; a failed one is reported and does not stop the others.

    :param force: whether to replace finished sequences
    :return: whether all are finished
    """
    for job in jobs:
        check_sequence(job, force)
    finished = True
    for number, job in enumerate(jobs, 1):
        say(f"sequence {number}/{len(jobs)}", job.title)
        try:
            run_sequence(job, force)
        except Exception as error:  # any failure of one sequence must not stop the others
            finished = False
            console.print(f"[red]failed[/red]: {escape(str(error))}")
            continue
        console.print(f"Folder: [bold]{escape(str(job.folder.resolve()))}[/bold]")
    return finished


def check_sequence(job: SequenceRun, force: bool) -> None:
    """Raise an error for a folder that is not this sequence's.

    :raises ValueError: if it is no run folder, or has other settings and `force` is off
    """
    check_config(job.folder, job.config(), job.runs[0], force)


def run_sequence(job: SequenceRun, force: bool = False) -> SequenceResult:
    """Learn the unfinished tasks of a sequence, and return its result."""
    done = None if force else read_sequence(job.folder)
    if done is not None and done.finished:
        say("sequence", "finished earlier, reused (--force replaces it)", job.folder)
        _remove_episodes(job)  # left if the process was killed right after its last task
        return done
    with locked(job.folder / "lock"):
        if force:
            clear(job.folder)
        with described(job.folder, job.config(), job.runs[0].command):
            return _do_tasks(job)


def _do_tasks(job: SequenceRun) -> SequenceResult:
    rows: list[Row] = []
    result = _result(job, rows)
    for number, run in enumerate(job.runs):
        row = read_row(run.folder)
        if row is None:
            row = _learn_task(job, number)
            write_row(run.folder, row)
            shutil.rmtree(run.folder / "checkpoints", ignore_errors=True)
        rows.append(row)
        result = _result(job, rows)
        write_sequence(job.folder, result)
        say("return", f"{row.learned.mean:.1f} on {row.task}")
    _remove_episodes(job)
    return result


def _remove_episodes(job: SequenceRun) -> None:
    """Delete the episodes of a finished sequence."""
    for run in job.runs:
        shutil.rmtree(run.folder / "replay", ignore_errors=True)


def _result(job: SequenceRun, rows: Sequence[Row]) -> SequenceResult:
    first = job.runs[0]
    return SequenceResult(
        suite=first.task.suite,
        sequence=job.name,
        method=first.method,
        variant=first.variant,
        seed=first.seed,
        tasks=[short_name(run.task) for run in job.runs],
        frames=first.preset.learn.frames,
        steps=first.preset.steps,
        rows=list(rows),
        commit=commit(),
    )


def _learn_task(job: SequenceRun, number: int) -> Row:
    """Learn one task, then evaluate it and all earlier ones."""
    run = job.runs[number]
    run.folder.mkdir(parents=True, exist_ok=True)
    dataset = collect_data(run.shared) if run.algorithm.needs_data else None
    checkpoint = last_checkpoint(run.folder)
    start = None
    if run.algorithm.pretrained and number == 0 and checkpoint is None:
        assert dataset is not None, run.method
        start = pretrain(run.shared, dataset)
    prepare_logs(run, checkpoint)
    with closing(make_training_env(run)) as venv:
        agent: Any = _begin(job, number, venv, dataset, start, checkpoint)
        if dataset is not None and checkpoint is None:
            build_index(run, agent)
        effort = learn(run, agent, checkpoint, Origin())
        agent.save(run.folder / "model.zip")
    made = sum(row.updates for row in map(read_row, _folders(job, number)) if row is not None)
    scores = {
        short_name(played.task): play(played, policy_of(agent, place), short_name(played.task))
        for place, played in enumerate(job.runs[: number + 1])
    }
    return Row(
        task=short_name(run.task),
        scores=scores,
        updates=agent.updates - made,
        seconds=round(effort.seconds, 1),
        cpu_seconds=round(effort.cpu_seconds, 1),
    )


def _begin(
    job: SequenceRun,
    number: int,
    venv: VecEnv,
    dataset: TrajectoryDataset | None,
    start: Path | None,
    checkpoint: Checkpoint | None,
) -> BaseAlgorithm:
    """Return the agent of a task: from its checkpoint, or from the previous task."""
    run = job.runs[number]
    folders = _folders(job, number)
    if checkpoint is not None or number == 0:
        agent: Any = make_agent(run, venv, dataset, start, checkpoint)
        _keep(agent, folders)
        return agent
    agent = load_agent(run, venv, dataset, folders[-1] / "model.zip")
    agent.replay_buffer = _episodes(folders[-1:])
    _keep(agent, folders[:-1])
    agent.next_task(venv)
    go_to_episode(venv, agent.episodes)  # initial states do not repeat
    return agent


def _folders(job: SequenceRun, number: int) -> list[Path]:
    """Return the folders of the tasks before one."""
    return [run.folder for run in job.runs[:number]]


def _episodes(folders: Sequence[Path]) -> ReplayBuffer:
    """Return the episodes of tasks, in the order of collection."""
    buffer = ReplayBuffer()
    for folder in folders:
        for path in sorted((folder / "replay").glob("episode-*")):
            for trajectory in ReplayBuffer.load(path).trajectories:
                buffer.add(trajectory)
    return buffer


def _keep(agent: BaseAlgorithm, folders: Sequence[Path]) -> None:
    """Give WPT the episodes of earlier tasks as reward-free data."""
    if isinstance(agent, WPT) and folders:
        agent.kept = ReplayBuffer()
        for trajectory in _episodes(folders).trajectories:
            agent.kept.add(replace(trajectory, reward=None))


def policy_of(agent: BaseAlgorithm, task: int) -> PolicyPredictor:
    """Return the policy for a task of the sequence; PackNet has one for each task."""
    return agent.policy_of(task) if isinstance(agent, PackNet) else agent
