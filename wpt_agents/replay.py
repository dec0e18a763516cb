"""D_on and D_retrieval: whole episodes in memory, and `mix`, experience rehearsal's batch of both.

Example::

    replay = ReplayBuffer()
    replay.add(trajectory)
    batch = replay.sample(16, 64, action_width=12, rng=np.random.default_rng(0))
"""

import json
import os
import zipfile
from io import BytesIO

import numpy as np

from wpt_agents.atomic import replacing
from wpt_agents.trajectory import Batch, Trajectory
from wpt_agents.windows import Row, Windows, make_batch

FORMAT, VERSION = "wpt_agents.ReplayBuffer", 1
LABELS = ("terminated", "action_dim", "embodiment", "task", "source")


class ReplayBuffer:
    """Whole episodes in memory; as many as there is memory for.

    :ivar trajectories: what was added, in order; add with `add` only
    """

    def __init__(self) -> None:
        self.trajectories: list[Trajectory] = []
        self._transitions = 0
        self._windows: Windows | None = None

    def add(self, trajectory: Trajectory) -> None:
        """Appends one episode, which is kept as it is, not copied.

        :raises ValueError: images of another size than those already here
        """
        size = trajectory.image.shape[1:]
        if self.trajectories and size != self.trajectories[0].image.shape[1:]:
            raise ValueError(
                f"The replay buffer holds images of {self.trajectories[0].image.shape[1:]}, "
                f"got {size}; resize them"
            )
        self.trajectories.append(trajectory)
        self._transitions += len(trajectory)
        self._windows = None

    def __len__(self) -> int:
        """The number of transitions (actions), not of episodes."""
        return self._transitions

    def sample(
        self, batch_size: int, length: int, action_width: int, rng: np.random.Generator
    ) -> Batch:
        """Windows drawn by the rule of `wpt_agents.windows`.

        :raises ValueError: an empty buffer, or a trajectory with more actions than `action_width`
        """
        return make_batch(self.draw(batch_size, length, rng), action_width)

    def draw(self, batch_size: int, length: int, rng: np.random.Generator) -> list[Row]:
        """The pieces `sample` would copy."""
        if not self.trajectories:
            raise ValueError("The replay buffer is empty; add a trajectory before sampling")
        if self._windows is None:
            lengths = np.array([len(t) for t in self.trajectories])
            self._windows = Windows(lengths, np.array([t.action_dim for t in self.trajectories]))
        rows = self._windows.draw(batch_size, length, rng)
        return [[(self.trajectories[i], start, stop) for i, start, stop in row] for row in rows]

    def save(self, path: str | os.PathLike[str]) -> None:
        """Writes one file (a zip of arrays and JSON, no pickle), whole or not at all."""
        episodes = [{k: getattr(t, k) for k in LABELS} for t in self.trajectories]
        with replacing(path) as temporary, zipfile.ZipFile(temporary, "w") as archive:
            for i, trajectory in enumerate(self.trajectories):
                for name in ("image", "action", "reward"):
                    if (array := getattr(trajectory, name)) is not None:
                        with archive.open(f"{i}/{name}.npy", "w", force_zip64=True) as member:
                            np.lib.format.write_array(member, array, allow_pickle=False)
            about = {"format": FORMAT, "version": VERSION, "episodes": episodes}
            archive.writestr("replay.json", json.dumps(about))

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> "ReplayBuffer":
        """Reads what `save` wrote; every byte is checked.

        :raises ValueError: a file that is cut short, damaged, or not a replay buffer
        """
        replay = cls()
        try:
            with zipfile.ZipFile(path) as archive:
                about = json.loads(archive.read("replay.json"))
                if about.get("format") != FORMAT or about["version"] > VERSION:
                    raise ValueError(f"format {about.get('format')} version {about.get('version')}")
                names = set(archive.namelist())
                for i, labels in enumerate(about["episodes"]):
                    arrays = {
                        name: _array(archive.read(f"{i}/{name}.npy"))
                        for name in ("image", "action", "reward")
                        if f"{i}/{name}.npy" in names
                    }
                    replay.add(Trajectory(**arrays, **labels))
        except (zipfile.BadZipFile, KeyError, EOFError, TypeError, ValueError) as error:
            raise ValueError(
                f"{path} is not a replay buffer of this version, or is damaged ({error}); "
                "save it again"
            ) from error
        return replay


def _array(content: bytes) -> np.ndarray:
    return np.lib.format.read_array(BytesIO(content), allow_pickle=False)


def mix(
    online: ReplayBuffer,
    retrieved: ReplayBuffer | None,
    ratio: float,
    batch_size: int,
    length: int,
    action_width: int,
    rng: np.random.Generator,
) -> Batch:
    """Experience rehearsal: a batch of `online`, then `batch_size * ratio` rows of `retrieved`.

    The rewards of `retrieved` are of other tasks or of none, so they are hidden.
    """
    if not 0 <= ratio <= 1:
        raise ValueError(f"The share of retrieved data must be in [0, 1], got {ratio}")
    others = round(batch_size * ratio) if retrieved else 0
    rows = online.draw(batch_size - others, length, rng) if others < batch_size else []
    if retrieved and others:
        rows = rows + retrieved.draw(others, length, rng)
    batch = make_batch(rows, action_width)
    batch.reward[batch_size - others :] = 0
    batch.reward_known[batch_size - others :] = False
    return batch
