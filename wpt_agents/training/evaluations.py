"""Let callbacks evaluate on the entry of Dict observations that the agent uses."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from gymnasium import spaces
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.vec_env import VecEnv, VecExtractDictObs


def evaluators(callback: Any) -> Iterator[EvalCallback]:
    """Yield all EvalCallbacks in the argument `callback` of `learn`, also nested ones."""
    if isinstance(callback, EvalCallback):
        yield callback
    inner = [*getattr(callback, "callbacks", []), getattr(callback, "callback", None)]
    for part in callback if isinstance(callback, list) else inner:
        if part is not None:
            yield from evaluators(part)


@contextmanager
def showing_same_entry(callback: Any, env: VecEnv) -> Iterator[None]:
    """Wrap the environments of EvalCallbacks like the agent's, for the same observations.

    SB3 warns if they differ in type, and copies the averages of VecNormalize wrapper by wrapper.
    At the end, also after an error, the callbacks have their own environments again.

    :param callback: the argument of `learn`
    :param env: the agent's environment
    """
    before: dict[EvalCallback, VecEnv] = {}
    try:
        if isinstance(env, VecExtractDictObs):
            for evaluator in evaluators(callback):
                space = evaluator.eval_env.observation_space
                if isinstance(space, spaces.Dict) and env.key in space.spaces:
                    before[evaluator] = evaluator.eval_env
                    evaluator.eval_env = VecExtractDictObs(evaluator.eval_env, env.key)
        yield
    finally:
        for evaluator, eval_env in before.items():
            evaluator.eval_env = eval_env
