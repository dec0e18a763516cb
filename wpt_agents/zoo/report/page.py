"""The report as one HTML page, which works offline and without scripts."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime

import jinja2
import yaml

from wpt_agents.files.names import counted, unknown_name
from wpt_agents.zoo import numbers
from wpt_agents.zoo.report import (
    aggregates,
    figure2,
    headline,
    paper_tables,
    sections,
    steadiness,
    tables,
)
from wpt_agents.zoo.report.figure4 import Figure4
from wpt_agents.zoo.report.folders import Finished, Unfinished
from wpt_agents.zoo.report.names import MEANINGS, policy_name, policy_title
from wpt_agents.zoo.report.sections import Names
from wpt_agents.zoo.result import Result, Score, Variant

MEDIA = ("first", "all", "none")


def check_media(media: str) -> None:
    """Raise an error for an unknown choice of media."""
    if media not in MEDIA:
        raise unknown_name("choice of media", media, MEDIA)


def render(
    runs: Sequence[Finished],
    unfinished: Sequence[Unfinished],
    sequences: Sequence[Figure4],
    media: str = "first",
) -> str:
    """Return the page's HTML.

    :param media: show videos and pictures of "all" runs, of the "first" run of each task (the first
        seed of its best-known method), or of "none"; they make up most of the page's size
    """
    loader = jinja2.PackageLoader("wpt_agents.zoo.report", ".")
    env = jinja2.Environment(loader=loader, autoescape=True, undefined=jinja2.StrictUndefined)
    env.filters |= {
        "number": numbers.number,
        "share": "{:.2f}".format,
        "count": "{:,}".format,
        "counted": counted,
        "interval": interval_of,
    }
    runs = sorted(runs, key=_order)
    names = Names(run.experiment for run in runs)
    results = [run.result for run in runs]
    methods = {result.method for result in results}.union(*(one.names for one in sequences))
    return env.get_template("page.html.jinja").render(
        made=datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
        suites=[
            sections.section(suite, runs, names)
            for suite in dict.fromkeys(result.suite for result in results)
        ],
        figure_2=figure2.figure_2(runs, names),
        figures_4=sequences,
        tables=paper_tables.paper_tables(runs, names),
        policies=tables.by_task(tables.policies(results)),
        policy_cells=tables.policy_cells,
        policy_headings=tables.POLICY_HEADINGS,
        policy_note=tables.policy_note,
        steadiness=steadiness.steadiness(runs),
        steadiness_cells=steadiness.cells,
        steadiness_headings=steadiness.HEADINGS,
        steadiness_considered=steadiness.CONSIDERED,
        steadiness_note=steadiness.NOTE,
        policies_note=tables.POLICY_NOTE,
        rule=numbers.RULE,
        meanings={method: text for method, text in MEANINGS.items() if method in methods},
        runs=[card(run, names, media in illustrated(run, runs)) for run in runs],
        unfinished=unfinished,
        headline=headline.headlines(results),
        both=headline.both_suites(results),
        commits=sorted({result.commit_name for result in results}),
        seeds=sorted({result.seed for result in results}),
        paper_budget=aggregates.PAPER_BUDGET,
    )


def interval_of(score: Score) -> str:
    """Format the 95 % interval of a score over its episodes."""
    _, low, high = score.interval
    return "–" if low is None else numbers.interval_text(low, high)


def _order(run: Finished) -> tuple[str, str, Variant, int, int, int]:
    suite, variant, frames, method = aggregates.order(run.experiment)
    return suite, run.result.task, variant, frames, method, run.result.seed


def illustrated(run: Finished, runs: Sequence[Finished]) -> set[str]:
    """Return the values of `media` that include the run's pictures."""
    first = next(one for one in runs if one.result.task == run.result.task)
    return {"all", "first"} if run is first else {"all"}


@dataclass(frozen=True)
class Card:
    """Everything about one run: scores, command, seed, commit, versions, pictures."""

    id: str
    name: str
    result: Result
    scores: Mapping[str, Score]
    command: str
    config: str
    system: str
    media: Mapping[str, str]
    seconds: float


def card(run: Finished, names: Names, pictures: bool) -> Card:
    """Return the card of a run."""
    result = run.result
    system = run.system()
    return Card(
        id=run.name,
        name=names(run.experiment),
        result=result,
        scores={policy_title(policy_name(result, p)): s for p, s in result.scores.items()},
        command=run.text("command.txt"),
        config=run.text("config.yaml"),
        system=yaml.safe_dump(system, sort_keys=False) if system else "",
        media=run.media() if pictures else {},
        seconds=sum(result.seconds.values()),
    )
