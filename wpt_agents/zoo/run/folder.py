"""The folder of a run: check its settings, clear it, and write what belongs to every run."""

import json
import shutil
import traceback
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import yaml

from wpt_agents.zoo.plan.methods import defaults
from wpt_agents.zoo.plan.presets import Preset
from wpt_agents.zoo.plan.runs import Run
from wpt_agents.zoo.provenance import system
from wpt_agents.zoo.text_files import write_atomically, write_json


def clear(folder: Path) -> None:
    """Delete the files of a run or a sequence except its lock.

    Results are deleted first and `config.yaml` last, because a folder without it is not accepted:
    if this is interrupted, the same command can start again.
    """
    config = folder / "config.yaml"
    for path in (folder / "result.json", folder / "sequence.json", *folder.glob("*/scores.json")):
        path.unlink(missing_ok=True)
    for path in folder.iterdir():
        if path.is_dir():
            shutil.rmtree(path)
        elif path.name not in ("lock", config.name):
            path.unlink()
    config.unlink(missing_ok=True)


@contextmanager
def described(folder: Path, config: Mapping[str, Any], command: str) -> Iterator[None]:
    """Write settings, machine and command, then do the block; its error goes to `error.txt`."""
    failure = folder / "error.txt"
    failure.unlink(missing_ok=True)
    write_atomically(folder / "config.yaml", yaml.safe_dump(config, sort_keys=False))
    write_json(folder / "system.json", system())
    (folder / "command.txt").write_text(command + "\n", encoding="utf-8")
    try:
        yield
    except Exception:
        failure.write_text(traceback.format_exc(), encoding="utf-8")
        raise


def check_folder(job: Run, force: bool) -> None:
    """Raise an error for a folder that is not this run's.

    :raises ValueError: if it is no run folder, or has other settings and `force` is off
    """
    check_config(job.folder, job.config(), job, force)


def check_config(folder: Path, config: Mapping[str, Any], job: Run, force: bool) -> None:
    """Raise an error for a folder whose `config.yaml` has other settings.

    :param config: the settings
    :param job: the run or sequence
    :raises ValueError: if it is no run folder, or has other settings and `force` is off
    """
    path = folder / "config.yaml"
    others = {item.name for item in folder.glob("[!.]*")} - {"lock", "log.txt"}
    if others and not path.exists():
        raise ValueError(f"{folder} is not a run folder: it has no config.yaml; use another --out")
    if path.exists() and not force:
        section = job.algorithm.section
        keywords = {section: dict(defaults(job.algorithm.agent))}
        usual = _flat(Preset().as_dict() | keywords)  # for keys that older versions do not have
        before = usual | _flat(_stored(path))
        now = usual | _flat(json.loads(json.dumps(config)))
        differ = sorted(k for k in before.keys() | now if before.get(k) != now.get(k))
        if differ:
            raise ValueError(
                f"{folder} holds a run with other settings ({', '.join(differ)}); "
                "use another --out, or --force to replace it"
            )


def _stored(path: Path) -> dict[str, Any]:
    """Read the settings that a run folder was made with."""
    try:
        return dict(yaml.safe_load(path.read_text(encoding="utf-8")))
    except (yaml.YAMLError, TypeError, ValueError) as error:
        raise ValueError(
            f"{path} is not the configuration of a run ({error!r}); use another --out, or --force "
            "to replace it"
        ) from None


def _flat(config: Mapping[str, Any]) -> dict[str, Any]:
    """Flatten {'wpt': {'gamma': 1}} into {'wpt.gamma': 1}."""
    flat: dict[str, Any] = {}
    for name, value in config.items():
        if isinstance(value, dict):
            flat |= {f"{name}.{key}": item for key, item in value.items()}
        else:
            flat[name] = value
    return flat
