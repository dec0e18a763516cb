"""Options of the test run."""


def pytest_addoption(parser):
    parser.addoption("--seeds", type=int, default=1, help="seeds of each learning test")


def pytest_generate_tests(metafunc):
    if "learning_seed" in metafunc.fixturenames:
        metafunc.parametrize("learning_seed", range(metafunc.config.getoption("--seeds")))
