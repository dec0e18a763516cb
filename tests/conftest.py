"""Options of the test run."""

import pytest
import torch

torch.set_num_threads(1)  # the networks here are so small that threads would only wait


def pytest_addoption(parser):
    parser.addoption("--seeds", type=int, default=0, help="seeds of the minutes-long learning test")


def pytest_generate_tests(metafunc):
    if "learning_seed" in metafunc.fixturenames:
        seeds = metafunc.config.getoption("--seeds")
        asked = pytest.mark.skip(reason="takes minutes a seed: ask for it with --seeds 3")
        metafunc.parametrize(
            "learning_seed", range(seeds) if seeds else [pytest.param(0, marks=asked)]
        )
