"""Other people's environments by the two lines that docs/environments.md gives for each."""

from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import pytest
from strangers import STRANGERS, lives_through

DOCS = Path(__file__).parents[2] / "docs" / "environments.md"


@pytest.mark.parametrize("stranger", STRANGERS, ids=lambda stranger: stranger.make)
def test_the_two_lines_stand_in_the_documentation(stranger):
    assert f"`{stranger.make}`<br>`{stranger.wrap}`" in DOCS.read_text()


@pytest.mark.nightly
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("stranger", STRANGERS, ids=lambda stranger: stranger.make)
def test_it_is_recorded_pretrained_on_learnt_saved_and_loaded(stranger, tmp_path):
    try:
        version(stranger.package)
    except PackageNotFoundError:
        pytest.skip(f"needs: pip install '{stranger.name}'")
    results = lives_through(stranger, tmp_path)
    assert results["updates"] >= 4 and results["episodes"] >= 3
    assert results["contrast"] > 3 and results["moved"] > 10  # neither blank nor frozen
