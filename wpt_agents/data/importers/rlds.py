"""RLDS episodes as TFDS stores them, for example Open X-Embodiment; TensorFlow is not needed.

Step t holds observation t and the action taken at it, and the resulting reward. The
action of the last step (`is_last`) is meaningless, so T + 1 steps are T actions and T + 1 images.
"""

import os
import re
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from wpt_agents.data.importers.episodes import Episodes, decoded, warn_left_out
from wpt_agents.data.importers.keys import ENCODED
from wpt_agents.data.importers.records import find_records, read_steps
from wpt_agents.data.trajectory import Trajectory
from wpt_agents.files.folders import files_below

# The parts of a dictionary of actions, in the order in which Open X-Embodiment's users concatenate
# them: translation, rotation and gripper. Flags that end an episode and motions of a wheeled base
# are not included.
ORDER = ("world_vector", "rotation_delta", "gripper_closedness_action", "open_gripper")
INSTRUCTIONS = (
    *("language_instruction", "observation/natural_language_instruction"),
    *("language_instruction_2", "language_instruction_3"),  # DROID's, where the first is empty
)


class RldsEpisodes(Episodes):
    """The episodes of one TFRecord file, or of all files below a folder, sorted by name.

    The language instruction becomes the task, unless `task` is set. If actions are a dictionary,
    name its parts: `action_key=["action/world_vector", "action/rotation_delta"]`, or use all of
    them with `action_key="action"`, in the order of `ORDER`.

    :param folder: one version of a dataset, or a TFRecord file
    :param split: only files of this split, `train` for example
    :param options: those of `Episodes`
    """

    def __init__(
        self, folder: str | os.PathLike[str], split: str | None = None, **options: Any
    ) -> None:
        super().__init__(**options)
        path = Path(folder)
        self._folder = path.parent if path.is_file() else path
        pattern = f"*-{split}.tfrecord*" if split else "*.tfrecord*"
        files = [path] if path.is_file() else sorted(files_below(path, pattern))
        if path.is_dir():
            _warn_of_missing(files)
        records = [
            (file, at, size, single) for file in files for at, size, single in find_records(file)
        ]
        if not records:
            raise ValueError(f"{folder} holds no episode in files named {pattern}")
        self._records = [record[:3] for record in records if not record[3]]
        warn_left_out(len(records) - len(self._records), folder)
        self._warned = False

    def __len__(self) -> int:
        return len(self._records)

    def __getitem__(self, i: int) -> Trajectory:
        file, at, size = self._records[i]
        source = f"{file.relative_to(self._folder).as_posix()} at byte {at}"
        with open(file, "rb") as opened:
            opened.seek(at)
            steps = read_steps(opened.read(size), source)
        image = self._images(steps, source)
        reward = steps.get("reward") if self.rewards else None
        over = self._find(steps, self.done_key or "is_terminal", source, [0])
        return self._trajectory(
            image,
            self._actions(steps, len(image), source)[:-1],
            None if reward is None else np.asarray(reward, np.float32)[:-1],
            source,
            terminated=bool(np.any(over[-1:])),
            task=self.task or _instruction(steps),
        )

    def _find(self, steps: dict[str, Any], key: str, source: str, default: Any = None) -> Any:
        if key in steps:
            return steps[key]
        if default is not None and key == "is_terminal":
            return default
        raise ValueError(f"{source} has no {key!r} in its steps; there are: {', '.join(steps)}")

    def _actions(self, steps: dict[str, Any], count: int, source: str) -> np.ndarray:
        """Return (T + 1, A), the concatenated parts."""
        names = self.action_keys or ("action",)
        parts = [name for name in steps if name.startswith("action/")]
        ordered = [f"action/{name}" for name in ORDER if f"action/{name}" in parts]
        if names == ("action",) and "action" not in steps and parts:
            if not self.action_keys:
                raise ValueError(
                    f"{source} has a dictionary of actions; pass action_key, some of its parts, "
                    f"which are concatenated: {','.join(ordered or parts)} (--action-key). "
                    f"There are: {', '.join(parts)}"
                )
            names = tuple(ordered)
            if not names:
                raise ValueError(
                    f"{source} has no action with a known name; pass action_key, one or more of: "
                    f"{', '.join(parts)}"
                )
        arrays = [np.asarray(self._find(steps, name, source)) for name in names]
        if any(array.dtype.kind not in "fiu" for array in arrays):
            raise ValueError(f"{source} has actions that are not numbers: {', '.join(names)}")
        columns = [array.astype(np.float32).reshape(count, -1) for array in arrays]
        return np.concatenate(columns, axis=1)

    def _images(self, steps: dict[str, Any], source: str) -> np.ndarray:
        """Return the episode's images, each resized as soon as it is decoded."""
        encoded = self._encoded(steps, source)
        if encoded[0].startswith(ENCODED[0]) and not self._warned:
            self._warned = True
            warnings.warn(f"The images of {self._folder} are JPEG, which is lossy", stacklevel=4)
        try:
            return decoded(encoded, self._resize)
        except ValueError as error:
            raise ValueError(f"{source}: {error}") from error

    def _encoded(self, steps: dict[str, Any], source: str) -> list[bytes]:
        """Return the encoded images.

        :raises ValueError: if there are none, or several and none is chosen
        """
        pictures = sorted(
            k for k, v in steps.items() if isinstance(v, list) and v and _is_picture(v[0])
        )
        ask = f"pass image_key, one of: {', '.join(pictures) or 'none, it has no images'}"
        key = self.image_key
        if key is not None and "/" not in key:
            key = f"observation/{key}"
        if key is None and len(pictures) != 1:
            raw = [k for k, v in steps.items() if re.search("image|rgb|camera", k)]
            hint = f" ({', '.join(raw)} is not PNG or JPEG)" if raw and not pictures else ""
            raise ValueError(f"{source} has {len(pictures)} images a step{hint}; {ask}")
        encoded: list[bytes] = self._find(steps, key or pictures[0], source)
        if key is not None and key not in pictures:
            raise ValueError(f"{source} has no images under {key!r}; {ask}")
        return encoded


def _warn_of_missing(files: Sequence[Path]) -> None:
    """Warn if the names of files, such as a-train.tfrecord-00000-of-00004, say that some lack."""
    shards: dict[tuple[Path, str, int], set[int]] = {}
    for file in files:
        named = re.fullmatch(r"(.*)-(\d{5,})-of-(\d{5,})", file.name)
        if named:
            shards.setdefault((file.parent, named[1], int(named[3])), set()).add(int(named[2]))
    for (folder, name, total), numbers in shards.items():
        if len(numbers) < total:
            warnings.warn(
                f"{folder / name}: {total - len(numbers)} of {total} files are missing, number "
                f"{min(set(range(total)) - numbers)} for example; the episodes of the others are "
                "read. Was the download complete?",
                stacklevel=3,
            )


def _is_picture(data: bytes) -> bool:
    return data.startswith(ENCODED)


def _instruction(steps: dict[str, Any]) -> str | None:
    """Return the language instruction of the episode's first step, if there is one."""
    for name in INSTRUCTIONS:
        values = steps.get(name)
        if isinstance(values, list) and values and values[0]:
            return bytes(values[0]).decode("utf-8", "replace")
    return None
