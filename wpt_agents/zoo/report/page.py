"""The report as one HTML page: no network, no script that it needs, light and dark, any width."""

import json
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import jinja2
import yaml

from wpt_agents.files.archive import replacing
from wpt_agents.files.names import counted, unknown_name
from wpt_agents.zoo.report import aggregates, sections, tables
from wpt_agents.zoo.report.folders import Finished, Unfinished, find_finished, find_unfinished
from wpt_agents.zoo.report.sections import Names

MEDIA = ("first", "all", "none")


def write_page(folder: Path, path: Path, media: str = "first") -> None:
    """Writes the page about all runs below `folder` to `path`, whole or not at all.

    :param media: videos and pictures of "all" runs, of the "first" of each task (its best-known
        method's first seed), or of "none"; they make up most of the page's size
    """
    if media not in MEDIA:
        raise unknown_name("choice of media", media, MEDIA)
    page = render(find_finished(folder), find_unfinished(folder), media)
    with replacing(path) as temporary:
        temporary.write_text(page)


def render(runs: Sequence[Finished], unfinished: Sequence[Unfinished], media: str = "first") -> str:
    """The page's HTML."""
    loader = jinja2.PackageLoader("wpt_agents.zoo.report", ".")
    env = jinja2.Environment(loader=loader, autoescape=True, undefined=jinja2.StrictUndefined)
    env.filters |= {
        "number": tables.number,
        "share": "{:.2f}".format,
        "count": "{:,}".format,
        "counted": counted,
    }
    runs = sorted(runs, key=_order)
    names, results = Names(run.experiment for run in runs), [run.result for run in runs]
    suites = dict.fromkeys(run.result["suite"] for run in runs)
    return env.get_template("page.html.jinja").render(
        made=datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
        suites=[sections.suite(name, runs, names) for name in suites],
        tables=sections.paper_tables(runs, names),
        policies=tables.by_task(tables.policies(results)),
        policy_cells=tables.policy_cells,
        policy_headings=tables.POLICY_HEADINGS,
        runs=[card(run, names, media in illustrated(run, runs)) for run in runs],
        unfinished=unfinished,
        headline=sections.headline(results),
        both=sections.both_suites(results),
        commits=sorted({run.result.get("commit") or "unknown" for run in runs}),
        seeds=sorted({run.result["seed"] for run in runs}),
        paper_budget=150_000,
    )


def _order(run: Finished) -> tuple[Any, ...]:
    suite, *others = aggregates.order(run.experiment)
    return suite, run.result["task"], *others, run.result["seed"]


def illustrated(run: Finished, runs: Sequence[Finished]) -> set[str]:
    """Under which choices of media the run is shown with its pictures."""
    first = next(one for one in runs if one.result["task"] == run.result["task"])
    return {"all", "first"} if run is first else {"all"}


def card(run: Finished, names: Names, pictures: bool) -> dict[str, Any]:
    """Everything about one run: scores, command, seed, commit, versions, pictures."""
    system = json.loads(run.text("system.json") or "{}")
    scores = {tables.POLICIES.get(n, n): s for n, s in run.result["scores"].items()}
    return {
        "id": run.name,
        "name": names(run.experiment),
        "score": aggregates.score_of(run.result),
        "result": run.result,
        "scores": scores,
        "command": run.text("command.txt"),
        "config": run.text("config.yaml"),
        "system": yaml.safe_dump(system, sort_keys=False) if system else "",
        "media": run.media() if pictures else {},
        "seconds": sum(run.result["seconds"].values()),
    }
