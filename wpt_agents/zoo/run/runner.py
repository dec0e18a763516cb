"""One (suite, task, seed, method) -> one run folder, with everything that was done and came out.

A run collects, pre-trains, indexes, fine-tunes and evaluates; `wpt_agents.zoo.run.shared` holds
what runs share. `result.json` is written last: where it stands, the run is finished.
"""

import time
import traceback
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from rich.markup import escape
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger, TensorBoardOutputFormat
from stable_baselines3.common.type_aliases import MaybeCallback
from stable_baselines3.common.vec_env import VecEnv

from wpt_agents.agents.wpt import WPT
from wpt_agents.data.dataset import TrajectoryDataset
from wpt_agents.files.archive import replacing
from wpt_agents.files.names import counted
from wpt_agents.zoo.judge.evaluation import episode_steps, evaluate, film, make_vec_env
from wpt_agents.zoo.judge.untrained import BASELINES
from wpt_agents.zoo.pictures import retrieval, runs
from wpt_agents.zoo.plan.methods import METHODS
from wpt_agents.zoo.plan.runs import Run
from wpt_agents.zoo.provenance import commit, system
from wpt_agents.zoo.report import tables
from wpt_agents.zoo.result import Score
from wpt_agents.zoo.run.checkpoints import (
    LOGS,
    Checkpoint,
    Checkpoints,
    last_checkpoint,
    remove_checkpoints,
)
from wpt_agents.zoo.run.folder import check_folder, clear
from wpt_agents.zoo.run.locks import locked, write_json
from wpt_agents.zoo.run.logs import ContinuedCSV, Evaluations, go_to_episode
from wpt_agents.zoo.run.progress import LearningBar
from wpt_agents.zoo.tasks import short_name
from wpt_agents.zoo.terminal import console, say


def run_all(jobs: Sequence[Run], force: bool = False) -> bool:
    """Does the runs one after the other; one that fails is told and the rest goes on.

    :return: whether all are finished
    """
    for job in jobs:
        check_folder(job, force)
    for number, job in enumerate(jobs, 1):
        say(f"run {number}/{len(jobs)}", f"{short_name(job.task)}, {job.method}, seed {job.seed}")
        try:
            done = run(job, force)
        except Exception as error:  # whatever one run dies of, the others are not to blame
            console.print(f"[red]failed[/red]: {escape(str(error))}")
            if (trace := job.folder / "error.txt").exists():
                console.print(f"Traceback: {escape(str(trace))}")
            continue
        console.print(tables.scores_table(done))
        say("took", ", ".join(f"{k} {v:.0f} s" for k, v in done["seconds"].items()))
        console.print(f"Run folder: [bold]{escape(str(job.folder.resolve()))}[/bold]")
    results = [result for job in jobs if (result := job.result())]
    if len(results) > 1:
        console.print(tables.summary_table(tables.summarise(results)))
    return len(results) == len(jobs)


def run(job: Run, force: bool = False) -> dict[str, Any]:
    """Does what of the run is not done yet and returns its result."""
    check_folder(job, force)
    done = None if force else job.result()
    if done is not None:
        say("run", f"finished before, reused (--force starts anew)  [dim]{job.folder}")
        return done
    with locked(job.folder / "lock"):
        if force:
            clear(job.folder)
        return _begin(job)


def _begin(job: Run) -> dict[str, Any]:
    """Says in the folder what is being done, then does it."""
    (job.folder / "error.txt").unlink(missing_ok=True)
    with replacing(job.folder / "config.yaml") as temporary:
        temporary.write_text(yaml.safe_dump(job.config(), sort_keys=False))
    write_json(job.folder / "system.json", system())
    (job.folder / "command.txt").write_text(job.command + "\n")
    try:
        return _work(job)
    except Exception:
        (job.folder / "error.txt").write_text(traceback.format_exc())
        raise


class Clock:
    """The wall seconds of each stage."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        """Times a stage."""
        start = time.perf_counter()
        yield
        self.seconds[stage] = round(time.perf_counter() - start, 1)


def _work(job: Run) -> dict[str, Any]:
    """The stages, one after the other."""
    method, clock, dataset, start = METHODS[job.method], Clock(), None, None
    if method.needs_data:
        with clock("collect"):
            dataset = job.shared.data()
    if method.pretrained:
        assert dataset is not None, method
        with clock("pretrain"):
            start = job.shared.model(dataset)
    checkpoint = last_checkpoint(job.folder)
    if checkpoint is None:
        remove_checkpoints(job.folder)  # damaged ones, or what others have left
        for name in LOGS:
            (job.folder / name).unlink(missing_ok=True)
    else:
        checkpoint.restore_logs(job.folder)
    with closing(_training_env(job)) as venv:
        model = make_model(job, venv, dataset, start, checkpoint)
        if dataset is not None and checkpoint is None:  # else it has retrieved already
            with clock("index"):
                job.shared.index(model)
                if job.retrieves and model.retrieval == "nearest":
                    picture = job.folder / "retrieval.png"
                    retrieval.sheet_of_run(picture, model, job.task, job.shared.env, job.seed)
        clock.seconds["learn"] = round(_learn(job, model, checkpoint), 1)
        model.save(job.folder / "model.zip")
    with clock("evaluate"):
        model, scores = _evaluate(job, model)
    with clock("pictures"):
        _draw(job, model, scores)
    result = _result(job, scores, clock.seconds)
    write_json(job.folder / "result.json", result)
    remove_checkpoints(job.folder)
    return result


def _training_env(job: Run) -> VecEnv:
    """The task to learn; in a process of its own where updates are made while it steps."""
    monitor = str(job.folder / "0.monitor.csv")
    overlap = job.preset.learn.overlap and job.wpt.get("train_freq") == "step"
    return make_vec_env(job.task.id, job.shared.env, job.seed, monitor=monitor, workers=overlap)


def make_model(
    job: Run,
    venv: VecEnv,
    dataset: TrajectoryDataset | None,
    start: Path | None,
    checkpoint: Checkpoint | None = None,
) -> WPT:
    """The model to fine-tune: from where the run stood, pre-trained, or fresh."""
    keywords = {"dataset": dataset, "seed": job.seed, "device": job.device, **job.wpt}
    keywords["embodiment"] = job.task.embodiment
    keywords["episode_length"] = episode_steps(job.task.id, job.shared.env)
    if checkpoint is not None:
        return _Watched.load(checkpoint.model, env=venv, **keywords)
    if start is None:
        return _Watched("WPTPolicy", venv, **keywords)
    model = _Watched.load(start, env=venv, **keywords)
    model.reset_task()  # heads, actor and critic are drawn by this run's seed, not pre-training's
    return model


class _Watched(WPT):
    """WPT without SB3's progress bar: the runner's stands among the callbacks."""

    def _init_callback(self, callback: MaybeCallback, progress_bar: bool = False) -> BaseCallback:
        return super()._init_callback(callback)


def _learn(job: Run, model: WPT, checkpoint: Checkpoint | None) -> float:
    """Stage 4: fine-tuning, evaluated in between where the preset says so; its seconds."""
    frames, steps, given = job.preset.learn.frames, job.preset.steps, job.preset.learn
    done = model.num_timesteps * job.preset.env.action_repeat
    state = f"continued at {done:,} of " if checkpoint else ""
    text = f"{state}{frames:,} frames, {steps:,} steps of {short_name(job.task)}"
    say("learn", f"{text}, method {job.method}, seed {job.seed}")
    outputs = [ContinuedCSV(job.folder / "progress.csv"), TensorBoardOutputFormat(str(job.folder))]
    logger = Logger(str(job.folder), outputs)
    model.set_logger(logger)
    if checkpoint is not None:
        checkpoint.restore(model, job.folder)
        assert model.env is not None
        go_to_episode(model.env, model.episodes)
    with closing(logger), _evaluation(job) as evaluation:
        repeat = job.preset.env.action_repeat
        before = checkpoint.state["seconds"] if checkpoint else 0.0
        checkpoints = Checkpoints(job.folder, given.checkpoint_every // repeat, before)
        callbacks = [LearningBar(repeat), *evaluation, checkpoints]
        left = steps - model.num_timesteps
        model.learn(
            left, callback=callbacks, log_interval=1, reset_num_timesteps=False, progress_bar=True
        )
        return checkpoints.seconds


@contextmanager
def _evaluation(job: Run) -> Iterator[list[BaseCallback]]:
    """SB3's evaluation every so many frames, into `evaluations.npz`; none if none is wanted."""
    given = job.preset.evaluate
    if not given.every:
        yield []
        return
    seed = job.evaluation_seed + 10_000  # apart from training and from the scores at the end
    with closing(make_vec_env(job.task.id, job.shared.env, seed)) as venv:
        callback = Evaluations(
            venv,
            n_eval_episodes=given.during_episodes,
            eval_freq=max(1, given.every // job.preset.env.action_repeat),
            log_path=str(job.folder),
            best_model_save_path=str(job.folder) if given.keep_best else None,
            deterministic=True,
            verbose=0,
        )
        yield [callback]


def _evaluate(job: Run, model: WPT) -> tuple[WPT, dict[str, Score]]:
    """Stage 5: the returns of doing nothing, random actions, the prior actor and WPT.

    :return: the model that counts, the best in between or the last, and all scores
    """
    episodes, seed = job.preset.evaluate.episodes, job.evaluation_seed
    say("evaluate", f"{counted(episodes, 'episode')} of each policy, from the same initial states")
    scores = {name: job.shared.baseline(name, job.task, seed) for name in BASELINES}
    policies = {"prior actor": model.prior, "WPT": model}
    best = job.folder / "best_model.zip"
    if best.exists():
        policies |= {"WPT, last": model, "WPT": WPT.load(best, device=job.device)}
    for name, policy in policies.items():
        if policy is not None:
            scores[name] = evaluate(policy, job.task.id, job.shared.env, episodes, seed, name)
    counts = policies["WPT"]
    assert isinstance(counts, WPT)
    return counts, scores


def _draw(job: Run, model: WPT, scores: Mapping[str, Score]) -> None:
    """Stage 6: the learning curve, a video and a strip of predictions."""
    say("pictures", "learning_curve.png, policy.mp4, predictions.png")
    title = f"{short_name(job.task)}, {job.method}, preset {job.preset_name}, seed {job.seed}"
    monitor = np.genfromtxt(job.folder / "0.monitor.csv", delimiter=",", skip_header=1, names=True)
    training, repeat = np.atleast_1d(monitor), job.preset.env.action_repeat
    frames, returns = training["l"].cumsum() * repeat, training["r"]
    path, between = job.folder / "evaluations.npz", None
    if path.exists():
        with np.load(path) as held:
            between = held["timesteps"] * repeat, held["results"]
    curve = job.folder / "learning_curve.png"
    runs.learning_curve(curve, title, frames, returns, scores, between)
    trajectory, shots, fps = film(model, job.task.id, job.shared.env, job.evaluation_seed)
    runs.video(job.folder / "policy.mp4", shots, fps)
    context = 5
    predicted = model.open_loop(trajectory, context=context, horizon=40)
    true = trajectory.image[: len(predicted)]
    runs.prediction_strip(job.folder / "predictions.png", title, true, predicted, context)


def _result(job: Run, scores: Mapping[str, Score], seconds: dict[str, float]) -> dict[str, Any]:
    """What `result.json` holds."""
    return {
        "suite": job.task.suite,
        "task": short_name(job.task),
        "method": job.method,
        "preset": job.label,
        "seed": job.seed,
        "frames": job.preset.learn.frames,
        "steps": job.preset.steps,
        "metric": job.task.metric,
        "scores": {name: score.as_dict() for name, score in scores.items()},
        "seconds": seconds,
        "commit": commit(),
    }
