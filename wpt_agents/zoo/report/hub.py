"""Run folders to and from the Hugging Face Hub, with a model card. Needs the extra `hub`."""

import re
import shutil
import tempfile
from pathlib import Path

import yaml

from wpt_agents.zoo.judge.trained import find_trained
from wpt_agents.zoo.machine import import_extra
from wpt_agents.zoo.report import tables
from wpt_agents.zoo.result import Result, read_result

# The files to upload; logs, replay and checkpoints are not uploaded.
FILES = (
    *("model.zip", "best_model.zip", "config.yaml", "result.json", "system.json"),
    *("evaluations.npz", "0.monitor.csv", "policy.mp4", "learning_curve.png", "predictions.png"),
    "retrieval.png",
)
VIDEO = "replay.mp4"  # the file name under which the hub shows a policy's video


def push(folder: Path, name: str, private: bool = False) -> str:
    """Upload a finished run and its card; create the repository if it does not exist.

    :param name: `user/repository`
    :return: the address
    """
    _check(name)
    find_trained(folder)  # raises an error before anything is created
    result = read_result(folder)
    if result is None:
        raise ValueError(f"{folder} has no result.json: only finished runs are pushed")
    api = import_extra("huggingface_hub", "hub").HfApi()
    with tempfile.TemporaryDirectory() as aside:
        for file in FILES:
            if (folder / file).exists():
                shutil.copy2(folder / file, Path(aside) / file)
        config = yaml.safe_load((folder / "config.yaml").read_text(encoding="utf-8"))
        config.pop("data", None)  # in older runs it is a local path
        (Path(aside) / "config.yaml").write_text(
            yaml.safe_dump(config, sort_keys=False), encoding="utf-8"
        )
        if (folder / "policy.mp4").exists():
            shutil.copy2(folder / "policy.mp4", Path(aside) / VIDEO)
        (Path(aside) / "README.md").write_text(card(result, name), encoding="utf-8")
        address = api.create_repo(name, private=private, exist_ok=True)
        api.upload_folder(repo_id=name, folder_path=aside, commit_message="Upload a run")
    return str(address)


def pull(name: str, out: Path) -> Path:
    """Download the files of `push` into the folder `out`, which must be new or empty."""
    _check(name)
    if out.exists() and any(out.iterdir()):
        raise ValueError(f"{out} is not empty; choose a new folder with --out")
    hub = import_extra("huggingface_hub", "hub")
    hub.snapshot_download(name, local_dir=out, allow_patterns=list(FILES))
    if not (out / "config.yaml").exists():
        raise ValueError(f"{name} holds no run of wpt_agents: it has no config.yaml")
    return out


def _check(name: str) -> None:
    if not re.fullmatch(r"[\w.-]+/[\w.-]+", name):
        raise ValueError(f"{name!r} is not the name of a repository: write user/name")


def card(result: Result, name: str) -> str:
    """Return the model card: metadata for the hub, the scores of all policies, how to load it."""
    metric = result.metric
    value = {"type": metric, "name": f"mean {metric}", "value": result.counted()}
    scored = {
        "task": {"type": "reinforcement-learning", "name": result.task},
        "dataset": {"type": result.suite, "name": result.task},
        "metrics": [value],
    }
    repository = name.split("/")[1]
    metadata = {
        "library_name": "wpt-agents",
        "license": "mit",
        "tags": ["reinforcement-learning", "world-model", "stable-baselines3", result.task],
        "model-index": [{"name": repository, "results": [scored]}],
    }
    rows = tables.policies([result])
    return _CARD.format(
        metadata=yaml.safe_dump(metadata, sort_keys=False),
        table=tables.markdown_table(tables.POLICY_HEADINGS, map(tables.policy_cells, rows)),
        name=name,
        folder=repository,
        result=result,
    )


_CARD = """---
{metadata}---
# {result.task}, {result.method}

An agent of [wpt_agents](https://arxiv.org/abs/2502.19544), preset `{result.variant}`,
seed {result.seed}, after {result.frames:,} simulator frames of `{result.task}`.

{table}
Commit {result.commit_name}. Made by:

```bash
{result.command}
```

Watch it:

```bash
python -m wpt_agents.zoo pull {name} --out {folder}
python -m wpt_agents.zoo enjoy {folder}
```
"""
