"""Experience retrieval, Eq. (5): the trajectories whose first images are most like the task's.

Example::

    retriever = Retriever.build(dataset, embed, encoder_id)
    indices, distances = retriever.search(embed(obs[None])[0], k=500, embodiment="walker")
    retrieved = dataset.subset(indices)
"""

import os
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch  # noqa: F401  # before faiss: the other way round crashes on some builds

from wpt_agents.data.bars import StageBar
from wpt_agents.data.dataset import TrajectoryDataset
from wpt_agents.files.archive import load_arrays, save_arrays

CHUNK = 4096  # trajectories that are compared at a time


class Retriever:
    """The features e(o_0) of every trajectory's first image, searched exactly.

    :param features: (N, E) float32
    :param action_dims: (N,) int, the widths of the actions
    :param embodiments: N names of robots, None where unknown
    :param encoder_id: an identifier of the encoder of the features, such as a hash of its weights
    :param dataset_id: an identifier of the trajectories, such as the dataset's fingerprint
    """

    def __init__(
        self,
        features: np.ndarray,
        action_dims: np.ndarray,
        embodiments: Sequence[str | None],
        encoder_id: str,
        dataset_id: str = "",
    ) -> None:
        assert len(features) == len(action_dims) == len(embodiments), len(features)
        if not np.isfinite(features).all():
            raise ValueError("The encoder's features hold NaN or infinity; train it again")
        self.features = np.ascontiguousarray(features, np.float32)
        self.action_dims = np.asarray(action_dims)
        self.embodiments = list(embodiments)
        self.encoder_id = encoder_id
        self.dataset_id = dataset_id

    @classmethod
    def build(
        cls,
        dataset: TrajectoryDataset,
        embed: Callable[[np.ndarray], np.ndarray],
        encoder_id: str,
        progress_bar: bool = False,
    ) -> "Retriever":
        """Embed the first image of every trajectory.

        :param dataset: the trajectories
        :param embed: (n, 64, 64, 3) uint8 -> (n, E) float32
        :param encoder_id: an identifier of the encoder, such as a hash of its weights
        :param progress_bar: show a progress bar
        """
        features = np.zeros((len(dataset), 0), np.float32)
        at = 0
        with StageBar(len(dataset), "index", progress_bar) as bar:
            for image in dataset.first_observations():
                feature = np.asarray(embed(image), np.float32)
                assert feature.ndim == 2 and len(feature) == len(image), (
                    feature.shape,
                    image.shape,
                )
                if at == 0:
                    features = np.empty((len(dataset), feature.shape[1]), np.float32)
                features[at : at + len(image)] = feature
                at += len(image)
                bar.update(len(image))
        labels = dataset.action_dims, dataset.embodiments
        return cls(features, *labels, encoder_id, dataset.fingerprint)

    @classmethod
    def beside(
        cls,
        dataset: TrajectoryDataset,
        embed: Callable[[np.ndarray], np.ndarray],
        encoder_id: str,
        progress_bar: bool = False,
    ) -> "Retriever":
        """Load the index in the dataset's folder; build it if missing, damaged or out of date.

        The index of a subset is always built, since the folder stores that of the whole dataset.

        :param dataset: the trajectories
        :param embed: (n, 64, 64, 3) uint8 -> (n, E) float32
        :param encoder_id: an identifier of the encoder, such as a hash of its weights
        :param progress_bar: show a progress bar
        """
        # Named by its encoder, so that models do not overwrite each other's index.
        path = Path(dataset.path) / f"retrieval-{encoder_id[:12]}.index"
        whole = not dataset.is_subset
        if whole and path.exists():
            try:
                retriever = cls.load(path, encoder_id)
                if retriever.dataset_id == dataset.fingerprint:
                    return retriever
            except ValueError as error:
                warnings.warn(f"The index is built again: {error}", stacklevel=2)
        retriever = cls.build(dataset, embed, encoder_id, progress_bar)
        try:
            if whole:
                retriever.save(path)
        except OSError as error:
            warnings.warn(f"The index is kept in memory only: {error}", stacklevel=2)
        return retriever

    def __len__(self) -> int:
        """The number of trajectories."""
        return len(self.features)

    def search(
        self,
        embed: np.ndarray,
        k: int,
        embodiment: str | None = None,
        action_dim: int | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the `k` trajectories that are nearest by Eq. (5), each once.

        :param embed: (E,), the features of the task's first observation, or (Q, E), those of the
            first observations of Q episodes, which take their nearest trajectories in turns
        :param k: number of trajectories
        :param embodiment: only trajectories of this robot, or that name none
        :param action_dim: only trajectories of this action width
        :return: indices (k',) and their distances (k',) to the query that found them, nearest
            first; k' < k if there are no more. With several queries, the nearest trajectories of
            all queries come first, then the second nearest, and so on
        """
        queries = np.ascontiguousarray(np.atleast_2d(embed), np.float32)
        if queries.ndim != 2 or queries.shape[1:] != self.features.shape[1:]:
            raise ValueError(
                f"The query has shape {embed.shape}, the index holds features of "
                f"{self.features.shape[1:]}; embed one observation with the index's encoder"
            )
        candidates = self._candidates(embodiment, action_dim)
        if len(candidates) == 0 or k < 1:
            return np.zeros(0, np.int64), np.zeros(0, np.float32)
        indices, squared = in_turns(*nearest(queries, self.features, candidates, k), k)
        return indices, np.sqrt(squared)

    def draw(
        self,
        k: int,
        rng: np.random.Generator,
        embodiment: str | None = None,
        action_dim: int | None = None,
    ) -> np.ndarray:
        """Draw `k` of the candidates of `search` at random, without replacement.

        :param k: number of trajectories
        :param rng: source of the random numbers
        :param embodiment: only trajectories of this robot, or that name none
        :param action_dim: only trajectories of this action width
        :return: indices (k',); k' < k if there are no more
        """
        candidates = self._candidates(embodiment, action_dim)
        return rng.permutation(candidates)[:k]

    def own_share(self, k: int = 10, queries: int = 100) -> float | None:
        """Measure how well the features alone distinguish robots.

        :param k: number of neighbours
        :param queries: number of trajectories with a name to use as queries, evenly spread
        :return: the share of robots of the same name among the `k` nearest other trajectories with
            a name; None if fewer than two robots are named
        """
        named = [i for i, name in enumerate(self.embodiments) if name is not None]
        names = np.array(self.embodiments)[named]
        if len(set(names)) < 2:
            return None
        others = Retriever(self.features[named], self.action_dims[named], [None] * len(named), "")
        same = []
        for i in np.unique(np.linspace(0, len(named) - 1, queries).round().astype(int)):
            near = others.search(others.features[i], k + 1)[0]
            same += (names[near[near != i][:k]] == names[i]).tolist()
        return float(np.mean(same))

    def _candidates(self, embodiment: str | None, action_dim: int | None) -> np.ndarray:
        fits = np.ones(len(self), bool)
        if embodiment is not None:
            fits &= np.array([e is None or e == embodiment for e in self.embodiments], bool)
        if action_dim is not None:
            fits &= self.action_dims == action_dim
        return np.flatnonzero(fits)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write one file atomically.

        :param path: the file
        """
        head = {
            "encoder_id": self.encoder_id,
            "dataset_id": self.dataset_id,
            "embodiments": self.embodiments,
        }
        arrays = {"features": self.features, "action_dims": self.action_dims}
        save_arrays(path, "Retriever", head, arrays)

    @classmethod
    def load(cls, path: str | os.PathLike[str], encoder_id: str) -> "Retriever":
        """Read a file of `save`.

        :param path: the file
        :param encoder_id: the identifier of the encoder that the features must be of
        :raises ValueError: an index of another encoder, or a damaged file
        """
        head, arrays = load_arrays(path, "Retriever")
        if head["encoder_id"] != encoder_id:
            raise ValueError(
                f"{path} was built with the encoder {head['encoder_id']}, not with {encoder_id}; "
                "it needs to be built again"
            )
        labels = arrays["action_dims"], head["embodiments"]
        return cls(arrays["features"], *labels, encoder_id, head.get("dataset_id", ""))


def nearest(
    queries: np.ndarray, features: np.ndarray, candidates: np.ndarray, k: int
) -> tuple[np.ndarray, np.ndarray]:
    """Eq. (5): the candidates with the smallest D = ||e(o_on) - e(o_off)||_2 to each query.

    :param queries: (Q, E) float32, e(o_on)
    :param features: (N, E) float32, e(o_off)
    :param candidates: (M,), which rows of `features` to compare; at least one
    :return: the rows (Q, k') and their D^2 (Q, k'), nearest first; k' < k if there are no more
    """
    import faiss

    parts = []
    for at in range(0, len(candidates), CHUNK):  # never a second copy of all features
        chunk = candidates[at : at + CHUNK]
        # exact search, as the authors' IndexFlatL2
        squared, near = faiss.knn(queries, features[chunk], min(k, len(chunk)))
        parts.append((chunk[near], squared))
    indices, squared = (np.concatenate(part, 1) for part in zip(*parts, strict=True))
    order = np.lexsort((indices, squared))[:, :k]  # equally near: in the dataset's order
    return np.take_along_axis(indices, order, 1), np.take_along_axis(squared, order, 1)


def in_turns(indices: np.ndarray, squared: np.ndarray, k: int) -> tuple[np.ndarray, np.ndarray]:
    """Merge the answers to several queries: first all nearest ones, then all second ones, ...

    :param indices: (Q, N), a row for each query, nearest first
    :param squared: (Q, N), the squared distances of these
    :return: at most `k` indices, none twice, and their squared distances
    """
    rank = np.broadcast_to(np.arange(indices.shape[1]), indices.shape)
    order = np.lexsort((indices.ravel(), squared.ravel(), rank.ravel()))
    first = np.unique(indices.ravel()[order], return_index=True)[1]  # where each occurs first
    chosen = order[np.sort(first)[:k]]
    return indices.ravel()[chosen], squared.ravel()[chosen]
