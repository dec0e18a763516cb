"""The folder of a run: its lock, whose settings it holds, and how it is cleared."""

import json
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from wpt_agents.zoo.plan.presets import wpt_keywords
from wpt_agents.zoo.plan.runs import Run


def clear(folder: Path) -> None:
    """Deletes what a run has left, all but its lock; first what says that it is finished."""
    (folder / "result.json").unlink(missing_ok=True)
    for path in folder.iterdir():
        if path.is_dir():
            shutil.rmtree(path)
        elif path.name != "lock":
            path.unlink()


def check_folder(job: Run, force: bool) -> None:
    """Refuses to take a folder that is not this run's."""
    path = job.folder / "config.yaml"
    others = {each.name for each in job.folder.glob("[!.]*")} - {"lock", "log.txt"}
    if others and not path.exists():
        raise ValueError(f"{job.folder} is no run folder: it has no config.yaml; use another --out")
    if path.exists() and not force:
        usual = {f"wpt.{name}": value for name, value in wpt_keywords().items()}
        before = usual | _flat(yaml.safe_load(path.read_text()))
        wanted = usual | _flat(json.loads(json.dumps(job.config())))
        differ = sorted(k for k in before.keys() | wanted if before.get(k) != wanted.get(k))
        if differ:
            raise ValueError(
                f"{job.folder} holds a run with other settings ({', '.join(differ)}); "
                "use another --out, or --force to replace it"
            )


def _flat(config: Mapping[str, Any]) -> dict[str, Any]:
    """{'wpt': {'gamma': 1}} -> {'wpt.gamma': 1}."""
    flat: dict[str, Any] = {}
    for name, value in config.items():
        sections = isinstance(value, dict)
        flat |= {f"{name}.{k}": v for k, v in value.items()} if sections else {name: value}
    return flat
