# Three commands on a bare machine (Python 3.12 or 3.11, git, a shell):
#   make demo       installs, then fine-tunes the shipped world model on one task in minutes
#   make test       installs, then runs the tests on up to eight cores
#   make learn      the test that learns from scratch, three seeds of some minutes each
# For contributors:
#   make check      lint, types and the fast tests, on up to eight cores
#   make format     formats the code and applies automatic fixes
#   make lint       ruff, codespell and mypy
#   make types      mypy alone
#   make nightly    notebooks, browser, packaging and other long checks
#   make docs       the documentation site, with warnings as errors
#   make linkcheck  looks up every link of the documentation, if there is a network
# They make .venv when it is not there. Nothing outside this folder is written.

# The simulators have wheels for Python 3.11 and 3.12: 3.12 is taken if both are here.
RIGHT_PYTHON := import sys; print(sys.version_info[:2] in ((3, 11), (3, 12)) or '')
PYTHON ?= $(firstword $(foreach p,python3.12 python3.11 python3,$(if $(shell $(p) -c "$(RIGHT_PYTHON)" 2>/dev/null),$(p))))
VENV := .venv
BIN := $(VENV)/bin
INSTALLED := $(VENV)/.installed
PIP := $(BIN)/python -m pip --disable-pip-version-check

# torch comes before everything else, and alone, so that pip takes the build that is offered for this
# machine (a local CPU wheel, say) and the rest only finds it installed. TORCH_ARGS hands pip further
# options, such as the index of PyTorch's small CPU builds.
TORCH ?= torch==2.13.0
TORCH_RANGE := torch>=2.8,<2.14
TORCH_ARGS ?=
DEMO_ARGS ?=
TEST_ARGS ?=

.PHONY: help demo test learn lint install rendering clean format types check nightly docs linkcheck

help:
	@sed -n "s/^#   \(make [a-z]*  \)/  \1/p" Makefile

install: $(INSTALLED)

$(INSTALLED): pyproject.toml
	@test -n "$(PYTHON)" && test -n "$$($(PYTHON) -c "$(RIGHT_PYTHON)")" || { \
	  echo "Python 3.12 or 3.11 is needed, for the simulators, and $(or $(PYTHON),python3) is $$($(or $(PYTHON),python3) --version 2>&1): install one, or name it by make PYTHON=/path/to/python3.12"; exit 1; }
	@echo "[install 1/4] an environment in $(VENV), from $(PYTHON) ($$($(PYTHON) --version))"
	@test -x $(BIN)/python || $(PYTHON) -m venv $(VENV) || { rm -rf $(VENV); \
	  echo "Could not make $(VENV). On Debian and Ubuntu: apt-get install python3-venv"; exit 1; }
	@echo "[install 2/4] $(TORCH) (the largest download, a few minutes)"
	@$(PIP) install -qq $(TORCH_ARGS) "$(TORCH)" || { \
	  echo "              not to be had; taking the newest of $(TORCH_RANGE)"; \
	  $(PIP) install -qq $(TORCH_ARGS) "$(TORCH_RANGE)"; }
	@echo "[install 3/4] wpt-agents and what it needs (simulators, Stable-Baselines3, tools)"
	@$(PIP) install -qq -e ".[all,dev]"
	@echo "[install 4/4] a check that the parts fit together"
	@$(PIP) check || echo "              pip names a conflict above; going on"
	@$(BIN)/python -c "import torch, mujoco, stable_baselines3 as sb3; print('              torch', torch.__version__ + ', mujoco', mujoco.__version__ + ', stable-baselines3', sb3.__version__)"
	@touch $@

# The simulators draw without a display, by EGL or OSMesa. Which one is chosen, or what to install.
rendering: $(INSTALLED)
	@$(BIN)/python -c "import os; from wpt_envs import headless; headless.choose(); print('[rendering] by', os.environ.get('MUJOCO_GL', 'the window system'))" \
	  2> $(VENV)/rendering.log || { echo "[rendering] $$(tail -n 1 $(VENV)/rendering.log)"; exit 1; }

demo: rendering
	@echo "[demo] collect, retrieve, clone, fine-tune, evaluate: python -m wpt_agents.zoo run $(DEMO_ARGS)"
	@$(BIN)/python -m wpt_agents.zoo run --suite metaworld --tasks drawer-close --preset demo $(DEMO_ARGS)

# A worker for each core, eight at most; the processes that tests start must not take more than theirs.
PYTEST := OMP_NUM_THREADS=1 $(BIN)/python -m pytest
WORKERS := -n auto --maxprocesses 8 --dist worksteal

test: rendering
	@echo "[test] pytest -m 'not nightly' $(WORKERS) $(TEST_ARGS)"
	@$(PYTEST) $(WORKERS) -m "not nightly" $(TEST_ARGS)

learn: $(INSTALLED)
	@$(BIN)/python -m pytest tests/agents/test_learning.py --seeds 3 -v --durations 3

lint: $(INSTALLED)
	@$(BIN)/ruff check . && $(BIN)/ruff format --check . && $(BIN)/codespell && $(BIN)/mypy wpt_agents envs

types: $(INSTALLED)
	@$(BIN)/mypy wpt_agents envs

format: $(INSTALLED)
	@$(BIN)/ruff check --fix . ; $(BIN)/ruff format .

check: lint rendering
	@$(PYTEST) $(WORKERS) -m "not slow and not nightly" $(TEST_ARGS)

nightly: rendering $(VENV)/.docs
	@$(BIN)/python -m pytest -m nightly -v -rs $(TEST_ARGS)

# The documentation needs packages of its own: the extra `docs`.
$(VENV)/.docs: $(INSTALLED)
	@echo "[docs] the packages of the documentation"
	@$(PIP) install -qq -e ".[docs]" && touch $@

docs: $(VENV)/.docs
	@$(BIN)/python -m sphinx -W --keep-going -q -b html docs docs/_build/html
	@echo "[docs] docs/_build/html/index.html"

# Without a network there is nothing to look up, which is not an error of the documentation.
ONLINE := import socket; socket.create_connection(("arxiv.org", 443), 10)

linkcheck: $(VENV)/.docs
	@$(BIN)/python -c '$(ONLINE)' 2> /dev/null || { echo "[linkcheck] no network: no link was looked up"; exit 0; } && \
	  $(BIN)/python -m sphinx -W --keep-going -q -b linkcheck docs docs/_build/linkcheck

clean:
	rm -rf $(VENV) .pytest_cache .ruff_cache .mypy_cache docs/_build
