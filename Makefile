# `make train` and `make test` work on a fresh machine: they build .venv first, and again only when the dependencies change.
SHELL := /bin/bash
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
# The first interpreter of a supported version; `make PYTHON=/path/to/python train` overrides it.
SUPPORTED := import sys; sys.exit(not (3, 10) <= sys.version_info[:2] <= (3, 14))
PYTHON ?= $(shell for name in python3.11 python3.12 python3.13 python3.10 python3.14 python3 python; do \
	$$name -c '$(SUPPORTED)' 2>/dev/null && { echo $$name; break; }; done)
ARGS ?=
# Processes that run tests side by side; some tests start two or more of their own.
TEST_WORKERS ?= 2
PYTEST = OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n $(TEST_WORKERS) --dist loadfile --no-loadscope-reorder

.PHONY: help install train test test-all test-numpy1 lint typecheck docs check clean
.DEFAULT_GOAL := help

help:
	@echo "make train      install into .venv if need be and train a policy that saves CO2, in some three minutes (ARGS='seed=1 ...')"
	@echo "make test       install and run the quick tests, some five minutes (ARGS='-k name' adds pytest options)"
	@echo "make test-all   the same, then the slow tests: some twenty minutes"
	@echo "make docs       build the documentation site into build/site (Python 3.11 or newer)"
	@echo "make check      all tests, lint, type check and documentation: what CI runs"
	@echo "make install | lint | typecheck | clean"

install: $(STAMP)

$(STAMP): pyproject.toml constraints.txt
	@test -n "$(PYTHON)" || { echo "izoo needs Python 3.10 to 3.14; none was found on PATH. \
	Install one, or name it: make PYTHON=/path/to/python3.11" >&2; exit 2; }
	@echo "Installing into $(VENV); the first time takes some minutes (PyTorch and SUMO are large)."
	$(PYTHON) -m venv --clear $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade-strategy only-if-needed -c constraints.txt -e '.[dev]'
	@touch $@

# A run that is resumed has its own options.
train: $(STAMP)
	$(BIN)/python -m izoo.train $(if $(findstring resume=,$(ARGS)),,task=busy_lane algo=ppo_vehicle) $(ARGS)

test: $(STAMP)
	$(PYTEST) -m 'not slow' $(ARGS)

test-all: test
	$(PYTEST) -m slow $(ARGS)

# numpy 1.26, the oldest that is supported (Python 3.10 to 3.12), in front of .venv's. neuralmoves, which asks for it,
# is there too, so what izoo carries of it is compared with it.
test-numpy1: $(STAMP)
	$(BIN)/python -m pip install --quiet --no-deps --upgrade --target build/numpy1 numpy==1.26.4 neuralmoves==0.4.0
	PYTHONPATH=$(CURDIR)/build/numpy1 $(PYTEST) -m 'not slow' tests/emissions tests/contexts/test_weather.py tests/traffic \
		tests/metrics tests/results/test_store.py tests/envs/test_model_version.py

lint: $(STAMP)
	$(BIN)/python -m ruff check .
	$(BIN)/python -m ruff format --check .

# Type checkers do not see through the package mapping of an editable install, so an installed wheel is checked.
typecheck: $(STAMP)
	rm -rf build/typecheck build/lib
	$(BIN)/python -m pip install --quiet --no-deps --no-build-isolation --target build/typecheck .
	cd build/typecheck && MYPYPATH=. ../../$(BIN)/python -m mypy --config-file ../../pyproject.toml \
		--cache-dir ../../.mypy_cache -p izoo

# Warnings are errors; nothing is fetched from the network, here or when the pages are read.
docs: $(STAMP)
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict --quiet
	@echo "Documentation: build/site/index.html"

check: test-all lint typecheck docs

clean:
	rm -rf $(VENV) build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache
