"""Other libraries beside ours: what is asked wrongly; their updates where they are installed."""

import json
import sys

import pytest
from typer.testing import CliRunner

from wpt_agents.zoo.bench import peers
from wpt_agents.zoo.commands.app import app

pytestmark = pytest.mark.slow  # it runs simulators or whole runs


@pytest.mark.parametrize("peer", peers.PEERS)
@pytest.mark.filterwarnings("ignore")  # the peers' own
def test_a_peer_learns_from_the_same_batch_beside_ours(peer):
    pytest.importorskip(peer, reason="the extra `peers` is not installed")
    ran = CliRunner().invoke(app, ["bench", "model", "--peer", peer, "--quick", "--json"])
    assert ran.exit_code == 0, ran.output
    rows = [json.loads(line) for line in ran.stdout.splitlines() if line.startswith("{")]
    assert [row["what"] for row in rows] == 2 * ["world model"] + 2 * ["whole update"]
    for mine, theirs in (rows[:2], rows[2:]):
        assert mine["library"] == "wpt_agents" and theirs["library"].startswith(f"{peer} ")
        assert mine["ratio_to_ours"] == 1
        assert theirs["ratio_to_ours"] == pytest.approx(theirs["median_s"] / mine["median_s"])
        assert theirs["params"] == pytest.approx(mine["params"], rel=0.35)
        assert theirs["gflop"] > 0 and theirs["rss_mb"] > 0
    assert [row["imagined"] for row in rows] == [0, 0, 16 * 16, 16 * 15]  # a batch of 2 x 8


@pytest.mark.filterwarnings("ignore")  # of the peer's package, where it is installed
def test_a_peer_that_is_not_here_is_named_with_the_line_that_installs_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "sheeprl.algos.dreamer_v3.dreamer_v3", None)
    ran = CliRunner().invoke(app, ["bench", "model", "--peer", "sheeprl", "--quick"])
    assert isinstance(ran.exception, ValueError)
    assert 'pip install "wpt-agents[peers]"' in str(ran.exception)


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (
            ["policy", "--peer", "sheeprl"],
            "--peer is an option of bench model, not of bench policy",
        ),
        (["--peer", "sheeprl"], "not of bench all"),
        (["model", "--peer", "sheeprl", "--precision", "bf16"], "--peer measures in fp32"),
        (
            ["policy", "--compile"],
            "--compile is an option of bench model and bench gpu, without --peer",
        ),
        (["scaling", "--plot", "x.txt"], "--plot x.txt: a picture can be of the types eps, "),
        (["model", "--plot", "x.png"], "--plot is an option of bench scaling, not of bench model"),
    ],
)
def test_options_that_do_not_go_together_are_refused(arguments, complaint):
    ran = CliRunner().invoke(app, ["bench", *arguments])
    assert isinstance(ran.exception, ValueError) and complaint in str(ran.exception)


def test_an_unknown_peer_is_refused_with_those_that_there_are():
    ran = CliRunner().invoke(app, ["bench", "model", "--peer", "shepherd"])
    assert ran.exit_code == 2 and "sheeprl" in ran.stderr and "torchrl" in ran.stderr
