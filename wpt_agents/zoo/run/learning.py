"""Stages 3 and 4 of a run: the index over the data, and fine-tuning."""

from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger, TensorBoardOutputFormat
from stable_baselines3.common.type_aliases import MaybeCallback
from stable_baselines3.common.vec_env import VecEnv

from wpt_agents.agents.wpt import WPT
from wpt_agents.data.dataset import TrajectoryDataset
from wpt_agents.training.logs import ContinuedCSV
from wpt_agents.zoo.judge.evaluation import episode_steps
from wpt_agents.zoo.learning_curves import MONITOR
from wpt_agents.zoo.pictures import retrieval
from wpt_agents.zoo.plan.runs import Run
from wpt_agents.zoo.run.checkpoints import (
    BEST_MODEL,
    Checkpoint,
    Checkpoints,
    HeadStart,
    Origin,
    resumes,
)
from wpt_agents.zoo.run.logs import EvaluationCallback, go_to_episode
from wpt_agents.zoo.run.progress import LearningBar
from wpt_agents.zoo.tasks import metric_of, name_in_data, short_name
from wpt_agents.zoo.terminal import say
from wpt_agents.zoo.vec_envs import make_vec_env

APART = 10_000  # offset between the seeds of evaluations during and after fine-tuning


@dataclass(frozen=True)
class Effort:
    """The cost of learning, over all successive processes.

    :param seconds: wall-clock time
    :param cpu_seconds: CPU time of the learner's process, all its threads
    """

    seconds: float
    cpu_seconds: float


def make_training_env(run: Run) -> VecEnv:
    """Make the task to learn, in its own process if updates are made while it steps."""
    overlap = run.preset.learn.overlap and run.keywords.get("train_freq") == "step"
    monitor = str(run.folder / MONITOR)
    venv = make_vec_env(run.task.id, run.shared.env, run.seed, monitor=monitor, workers=overlap)
    return run.algorithm.wrap(venv)


def make_agent(
    run: Run,
    venv: VecEnv,
    dataset: TrajectoryDataset | None,
    start: Path | None,
    checkpoint: Checkpoint | None = None,
) -> BaseAlgorithm:
    """Make the agent to fine-tune: from the checkpoint, from the pre-trained model, or new."""
    if checkpoint is not None:
        return load_agent(run, venv, dataset, checkpoint.model)
    if start is None:
        agent = without_progress_bar(run.algorithm.agent)
        return agent(run.algorithm.policy, venv, **_keywords(run, dataset))
    model: Any = load_agent(run, venv, dataset, start)
    model.reset_task()  # heads, actor and critic are initialised with the seed of this run
    return model


def load_agent(
    run: Run, venv: VecEnv, dataset: TrajectoryDataset | None, path: Path
) -> BaseAlgorithm:
    """Read the agent's model file, with the keywords of the run."""
    agent = without_progress_bar(run.algorithm.agent)
    return agent.load(path, env=venv, **_keywords(run, dataset))


def _keywords(run: Run, dataset: TrajectoryDataset | None) -> dict[str, Any]:
    task = {
        "dataset": dataset,
        "embodiment": run.task.embodiment,
        "episode_length": episode_steps(run.task.id, run.shared.env),
    }
    known = {name: value for name, value in task.items() if run.algorithm.takes(name)}
    specific = deepcopy(run.keywords)  # SB3's agents modify `policy_kwargs`
    if dataset is not None and run.algorithm.takes("task"):
        specific.setdefault("task", name_in_data(run.task, dataset.tasks))
    return {"seed": run.seed, "device": run.device, **specific, **known}


def without_progress_bar(agent: type[BaseAlgorithm]) -> type[BaseAlgorithm]:
    """Return the class without SB3's progress bar, because the runner has its own callback."""

    def init_callback(
        self: BaseAlgorithm, callback: MaybeCallback, progress_bar: bool = False
    ) -> BaseCallback:
        return agent._init_callback(self, callback)

    return type(agent.__name__, (agent,), {"_init_callback": init_callback})


def build_index(run: Run, agent: BaseAlgorithm) -> None:
    """Stage 3: index the features of every first image, stored beside the dataset; draw a sheet."""
    if not isinstance(agent, WPT) or agent.dataset is None:
        return
    folder = Path(agent.dataset.path)
    before = set(folder.iterdir())
    retriever = agent.build_index(progress_bar=True)
    state = "made" if set(folder.iterdir()) - before else "reused"
    share = retriever.own_share()
    same = "" if share is None else f", {share:.0%} of the nearest are of the query's own robot"
    say("index", f"{state}, {len(retriever)} first images{same}", folder)
    if run.retrieves and agent.retrieval == "nearest":
        picture = run.folder / "retrieval.png"
        retrieval.sheet_of_run(picture, agent, run.task, run.shared.env, run.seed)


def learn(run: Run, agent: BaseAlgorithm, checkpoint: Checkpoint | None, origin: Origin) -> Effort:
    """Stage 4: fine-tuning, with evaluations if the preset requests them.

    :param origin: what was done before, for the checkpoints
    """
    repeat = run.preset.env.action_repeat
    steps = run.preset.steps
    done = agent.num_timesteps * repeat
    state = f"continued at {done:,} of " if checkpoint else ""
    length = f"{state}{run.preset.learn.frames:,} frames, {steps:,} steps"
    say("learn", f"{length} of {short_name(run.task)}, method {run.method}, seed {run.seed}")
    outputs = [ContinuedCSV(run.folder / "progress.csv"), TensorBoardOutputFormat(str(run.folder))]
    logger = Logger(str(run.folder), outputs)
    agent.set_logger(logger)
    before = Effort(0.0, 0.0)
    if checkpoint is not None:
        before = Effort(checkpoint.state.seconds, checkpoint.state.cpu_seconds)
        resume(run, agent, checkpoint)
    every = -(-run.preset.learn.checkpoint_every // repeat)  # rounded up, so that only 0 stays 0
    checkpoints = Checkpoints(
        run.folder, every if resumes(agent) else None, before.seconds, before.cpu_seconds, origin
    )
    with ExitStack() as stack:
        stack.enter_context(closing(logger))
        stack.push(checkpoints.signals)  # a signal in the last episode takes effect at the end
        evaluation = stack.enter_context(evaluations(run))
        callbacks = [LearningBar(repeat), *evaluation, HeadStart(run.folder), checkpoints]
        agent.learn(
            steps - agent.num_timesteps,
            callback=callbacks,
            log_interval=1,
            reset_num_timesteps=False,
            progress_bar=True,
        )
    return Effort(checkpoints.seconds, checkpoints.cpu_seconds)


def resume(run: Run, agent: Any, checkpoint: Checkpoint) -> None:
    """Restore the state of agent and environment that the model file does not contain."""
    checkpoint.restore(agent, run.folder)
    go_to_episode(agent.env, first_episode(agent) + agent.episodes)


def first_episode(agent: Any) -> int:
    """Return the number of the first episode that was collected for the task.

    Earlier ones were only started, for the first images that retrieval compares.
    """
    looked = isinstance(agent, WPT) and agent.progress.retrieved_ids
    return agent.retrieval_images - 1 if looked else 0


@contextmanager
def evaluations(run: Run) -> Iterator[list[BaseCallback]]:
    """Make the callback that evaluates every `evaluate.every` frames, into `evaluations.npz`."""
    settings = run.preset.evaluate
    if not settings.every:
        yield []
        return
    venv = make_vec_env(run.task.id, run.shared.env, run.evaluation_seed + APART)
    with closing(run.algorithm.wrap(venv)) as wrapped:
        callback = EvaluationCallback(
            wrapped,
            metric=metric_of(run.task),
            keep=run.folder / BEST_MODEL if settings.keep_best else None,
            n_eval_episodes=settings.during_episodes,
            eval_freq=max(1, settings.every // run.preset.env.action_repeat),
            log_path=str(run.folder),
            deterministic=True,
            verbose=0,
        )
        yield [callback]
