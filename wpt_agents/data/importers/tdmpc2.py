"""TD-MPC2's `.pt` files: dictionaries of tensors (episodes, T + 1, ...), saved by torch.

Action t is the one that *led to* observation t, and each episode's first action is NaN: so our
action t is their action t + 1. The published data contain only states, which raise an error.
"""

import os
import pickle
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from wpt_agents.data.importers.episodes import Episodes
from wpt_agents.data.importers.keys import ACTIONS, IMAGES, REWARDS, first, natural
from wpt_agents.data.importers.rows import between_images
from wpt_agents.data.trajectory import Trajectory
from wpt_agents.files.folders import files_below


class TdMpc2Episodes(Episodes):
    """The episodes of a `.pt` file, or of all files in a folder.

    :param file: a file, or a folder of them
    :param trust: load a file that is a pickle, which can run any code
    :param shifted: whether row t holds the action that led to observation t, as by default,
        instead of the one that was taken at it
    :param options: those of `Episodes`
    """

    def __init__(
        self,
        file: str | os.PathLike[str],
        trust: bool = False,
        shifted: bool | None = None,
        **options: Any,
    ) -> None:
        super().__init__(**options)
        self._shifted = shifted
        self._refuse_done_key("TD-MPC2")
        path = Path(file)
        self._root = path
        self._trust = trust
        files = [path] if path.is_file() else sorted(files_below(path, "*.pt"), key=natural)
        if not files:
            raise ValueError(f"{file} holds no .pt file")
        self._opened: tuple[Path, Mapping[str, Any]] | None = None
        self._places: list[tuple[Path, int]] = []
        for part in files:
            self._places += [(part, row) for row in range(len(self._find(part)[0]))]

    def _load(self, file: Path) -> Mapping[str, Any]:
        if self._opened is not None and self._opened[0] == file:
            return self._opened[1]
        try:
            content: Any = torch.load(file, map_location="cpu", weights_only=not self._trust)
        except pickle.UnpicklingError as error:
            if self._trust:
                raise ValueError(f"{file} cannot be read by torch.load: {error}") from error
            raise ValueError(
                f"{file} is a pickle of more than tensors (.pt), and loading it can run any "
                "code; if you trust it, pass trust=True (--trust)"
            ) from error
        except Exception as error:  # torch raises many types of exceptions for invalid files
            raise ValueError(f"{file} cannot be read by torch.load: {error}") from error
        if not isinstance(content, Mapping) and not hasattr(content, "keys"):
            raise ValueError(f"{file} holds a {type(content).__name__}, not a dictionary")
        loaded: Mapping[str, Any] = content
        self._opened = file, loaded
        return loaded

    def _find(self, file: Path) -> tuple[Any, list[Any], Any]:
        """Return images, actions and rewards of all episodes of a file: (E, T + 1, ...)."""
        content = self._load(file)
        names = [str(name) for name in content.keys()]  # iterating a TensorDict yields rows
        image = self.image_key or first(IMAGES, names)
        actions = self.action_keys or (first(ACTIONS, names) or "action",)
        for name in (image, *actions):
            if name not in names:
                raise ValueError(f"{file} has no {name!r}; there are: {', '.join(names)}")
        reward = first(REWARDS, names)
        return (
            content[str(image)],
            [content[name] for name in actions],
            None if reward is None else content[reward],
        )

    def __len__(self) -> int:
        return len(self._places)

    def __getitem__(self, i: int) -> Trajectory:
        file, row = self._places[i]
        images, actions, rewards = self._find(file)
        image = np.asarray(images[row])
        source = f"{file.name} episode {row}"
        parts = [np.asarray(action[row]) for action in actions]
        taken = between_images(parts, len(image), self._shifted, source)
        return self._trajectory(
            image,
            np.concatenate([part[taken].reshape(len(part[taken]), -1) for part in parts], axis=1),
            None if rewards is None else np.ravel(np.asarray(rewards[row]))[taken],
            source=source,
        )
