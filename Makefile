# Everything runs in .venv, made on first use.
PYTHON ?= python3
BIN := .venv/bin
RUNS ?= $(or $(AIRHOCKEY_OUTPUTS),outputs)

.PHONY: study test test-portable test-slow bench board audit lint types docs hooks third-party clean help
PYTEST := $(BIN)/python -m pytest
FAST := -m 'not slow' --numprocesses auto --dist loadgroup

help:  ## this list
	@grep -E '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:[^#]*##/\t/'

study: .venv/installed .venv/compiled  ## the nine conditions on simulated people: tables, figure, report.html
	$(BIN)/python -m guidance.evaluate

test: .venv/installed .venv/compiled  ## the tests, without the long ones, on all cores
	$(PYTEST) $(FAST)

test-portable: export NUMBA_CPU_NAME = generic
test-portable: export NUMBA_CACHE_DIR = $(CURDIR)/.venv/numba-generic
test-portable: export ATEN_CPU_CAPABILITY = default
test-portable: .venv/installed  ## the same without the vector instructions of this processor: what rounds otherwise
	rm -rf $(NUMBA_CACHE_DIR)
	$(PYTEST) $(FAST)

test-slow: .venv/installed .venv/compiled  ## the long ones
	$(PYTEST) -m slow

bench: .venv/installed .venv/compiled  ## speeds of this machine, as one JSON object
	@$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[bench]'
	@$(BIN)/python -m pip download --quiet --no-deps --no-binary :all: --dest .venv/peers learn2learn==0.2.0 || true
	@$(BIN)/python -m tests.benchmarks

board: .venv/installed  ## TensorBoard on outputs/, or on some of it: make board RUNS=outputs/train
	$(BIN)/tensorboard --logdir $(RUNS)

# strict: without it a pin that the index does not have passes as sound
audit: .venv/installed  ## known vulnerabilities of what is pinned; asks the network
	$(PYTHON) -m venv .venv/audit
	.venv/audit/bin/python -m pip install --quiet pip-audit
	.venv/audit/bin/pip-audit --strict --requirement constraints.txt --no-deps --disable-pip

lint: .venv/installed types  ## style, spelling and types
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/codespell

types: .venv/installed  ## types of the forces, the user model, the league and the algorithms
	$(BIN)/mypy

docs: .venv/installed  ## API reference from the docstrings, in outputs/docs
	$(BIN)/pdoc --math --docformat google --output-directory $(RUNS)/docs airhockey_marl guidance

hooks: .venv/installed  ## lint before each commit
	$(BIN)/pre-commit install

third-party: .venv/installed  ## licenses of all pinned distributions, in .github/THIRD_PARTY.md
	$(BIN)/python .github/third_party.py

clean:  ## remove the environment and compiled code; outputs/ stays
	rm -rf .venv *.egg-info
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

.venv/installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[dev]'
	@touch $@

# numba's cache does not notice that a function which another one calls has changed
.venv/compiled: .venv/installed $(shell grep -rl numba --include='*.py' airhockey_marl guidance)
	@find airhockey_marl guidance -name '*.nb[ic]' -delete
	@touch $@
