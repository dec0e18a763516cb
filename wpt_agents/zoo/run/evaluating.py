"""Stage 5 of a run: the scores of all its policies, and pictures of the final one."""

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.type_aliases import PolicyPredictor

from wpt_agents.agents.wpt import WPT
from wpt_agents.files.names import counted
from wpt_agents.zoo.judge.evaluation import evaluate, film
from wpt_agents.zoo.judge.prediction import CONTEXT, HORIZON
from wpt_agents.zoo.judge.trained import actor_alone
from wpt_agents.zoo.judge.untrained import BASELINES
from wpt_agents.zoo.learning_curves import EVALUATIONS, MONITOR, Evaluations, TrainingEpisodes
from wpt_agents.zoo.pictures import runs as pictures
from wpt_agents.zoo.plan.runs import Run
from wpt_agents.zoo.result import BEST, HEAD_START, IMITATION, LAST, PRIOR_ACTOR, Score
from wpt_agents.zoo.run.checkpoints import BEST_MODEL, HEAD_START_MODEL, checksum
from wpt_agents.zoo.run.shared import play_untrained
from wpt_agents.zoo.tasks import short_name
from wpt_agents.zoo.terminal import say


def evaluate_policies(run: Run, agent: BaseAlgorithm) -> dict[str, Score]:
    """Stage 5: score every policy of the run, from the same initial states."""
    episodes = counted(run.preset.evaluate.episodes, "episode")
    say("evaluate", f"{episodes} of each policy, from the same initial states")
    scores = {
        name: play_untrained(run.shared, name, run.task, run.evaluation_seed) for name in BASELINES
    }
    return scores | {name: play(run, policy, name) for name, policy in policies(run, agent).items()}


def play(run: Run, policy: PolicyPredictor, label: str) -> Score:
    """Score a policy on the task of a run, from the initial states of all its policies."""
    episodes = run.preset.evaluate.episodes
    seed = run.evaluation_seed
    return evaluate(policy, run.task.id, run.shared.env, episodes, seed, label, run.algorithm.wrap)


def policies(run: Run, agent: BaseAlgorithm) -> dict[str, PolicyPredictor]:
    """Return the trained policies of the run, by name."""
    load = partial(run.algorithm.agent.load, device=run.device)
    trained: dict[str, PolicyPredictor] = {}
    prior: PolicyPredictor | None = getattr(agent, "prior", None)
    if prior is not None:
        trained[PRIOR_ACTOR] = prior
    if (head_start := run.folder / HEAD_START_MODEL).exists():
        agent_then: Any = load(head_start)
        trained[HEAD_START] = agent_then
        if agent_then.policy.sees_frames:  # of which the prior actor is a part
            trained[IMITATION] = actor_alone(load(head_start))
    trained[LAST] = agent
    if (best := run.folder / BEST_MODEL).exists():
        trained[BEST] = load(best)
    return trained


def final_agent(run: Run, agent: BaseAlgorithm) -> BaseAlgorithm:
    """Return the final agent: the best one if it was kept, else the last."""
    best = run.folder / BEST_MODEL
    return run.algorithm.agent.load(best, device=run.device) if best.exists() else agent


def file_hash(path: Path) -> str:
    """Return the first digits of a file's SHA-256."""
    return checksum(path)[:12]


def draw(run: Run, agent: BaseAlgorithm, scores: Mapping[str, Score]) -> None:
    """Draw the learning curve and the model's predictions, and film the final policy."""
    say("pictures", "learning_curve.png, policy.mp4, predictions.png")
    title = f"{short_name(run.task)}, {run.method}, preset {run.preset_name}, seed {run.seed}"
    _draw_curve(run, title, scores)
    final = final_agent(run, agent)
    trajectory, shots, fps = film(
        final, run.task.id, run.shared.env, run.evaluation_seed, wrap=run.algorithm.wrap
    )
    pictures.video(run.folder / "policy.mp4", shots, fps)
    if isinstance(final, WPT):
        predicted = final.open_loop(trajectory, CONTEXT, HORIZON)
        true = trajectory.image[: len(predicted)]
        path = run.folder / "predictions.png"
        pictures.prediction_strip(path, title, true, predicted, CONTEXT)


def _draw_curve(run: Run, title: str, scores: Mapping[str, Score]) -> None:
    repeat = run.preset.env.action_repeat
    training = TrainingEpisodes.read(run.folder / MONITOR)
    evaluated = Evaluations.read(run.folder / EVALUATIONS)
    pictures.learning_curve(
        run.folder / "learning_curve.png",
        title,
        training.lengths.cumsum() * repeat,
        training.returns,
        scores,
        (evaluated.steps * repeat, evaluated.returns) if evaluated else None,
    )
