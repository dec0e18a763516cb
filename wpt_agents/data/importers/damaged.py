"""Find the episodes of a source that cannot be converted, so that one error can name them all."""

import time

from wpt_agents.data.importers.episodes import Episodes
from wpt_agents.data.trajectory import Trajectory

SECONDS = 30.0  # how long to look for further damaged episodes
ALIKE = 10  # failures in a row, after which the options are probably wrong


def converted(episodes: Episodes, i: int) -> Trajectory:
    """Return episode `i`.

    :raises ValueError: if it cannot be converted; names the numbers of all others after it that
        cannot, as far as they are found in 30 seconds, and how to leave them out
    """
    try:
        return episodes[i]
    except ValueError as error:
        others = _others(episodes, i + 1)
        if i == 0 and others is None:  # what is wrong with the first one is wrong with all
            raise
        failed = [i, *(others or {})]
        numbers = [episodes.number(k) for k in failed]
        before = "The episodes before it are converted; " if i else ""
        also, leaves = "", "leaves this one out"
        if others:
            also = f"{len(others)} after it cannot be converted either; "
            leaves = "leaves them out"
        raise ValueError(
            f"{error}. {before}{also}skip={numbers} (--skip={','.join(map(str, numbers))}) {leaves}"
        ) from error


def _others(episodes: Episodes, start: int) -> dict[int, ValueError] | None:
    """Return the errors of the episodes from `start`; None if the options seem to be wrong."""
    errors: dict[int, ValueError] = {}
    end = time.monotonic() + SECONDS
    for k in range(start, len(episodes)):
        try:
            episodes[k]
        except ValueError as error:
            errors[k] = error
        if len(errors) == ALIKE == k - start + 1:
            return None
        if time.monotonic() > end:
            break
    none_converted = start == 1 and len(errors) == len(episodes) - start
    return None if none_converted else errors
