"""Callbacks that evaluate on the same entry of Dict observations as the agent sees."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from gymnasium import spaces
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.vec_env import VecEnv, VecExtractDictObs


def evaluators(callback: Any) -> Iterator[EvalCallback]:
    """Yield the EvalCallbacks of what `learn` takes as callbacks, also those inside of others."""
    if isinstance(callback, EvalCallback):
        yield callback
    inner = [*getattr(callback, "callbacks", []), getattr(callback, "callback", None)]
    for part in callback if isinstance(callback, list) else inner:
        if part is not None:
            yield from evaluators(part)


@contextmanager
def showing_same_entry(callback: Any, env: VecEnv) -> Iterator[None]:
    """Wrap the environments of EvalCallbacks as the agent's is, so that both show the same entry.

    SB3 warns if they differ in type, and copies the averages of VecNormalize wrapper by wrapper.
    At the end, also after an error, the callbacks have their own environments again.

    :param callback: what `learn` takes
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
