# `make demo` runs the main job, `make test` passes the tests: nothing else is asked of a fresh machine
# but Python 3.11+, make and a C compiler. PYTHON=... chooses another interpreter.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
DEMO_STAMP := $(VENV)/.installed-demo
STAMP := $(VENV)/.installed

.PHONY: demo docs test test-long lint bench bench-tiles bench-exports kernels simulate quality reliability clean

$(BIN)/python:
	$(PYTHON) -c 'import sys; sys.exit("citystitch needs Python 3.11 or newer, this is " + sys.version) if sys.version_info < (3, 11) else None'
	$(PYTHON) -m venv $(VENV)

# The demo needs the package and its pictures alone; the tests have an installation of their own, in the same folder.
$(DEMO_STAMP): pyproject.toml | $(BIN)/python
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e '.[pictures]'
	touch $@

$(STAMP): pyproject.toml | $(BIN)/python
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e '.[test]'
	touch $@

demo: $(DEMO_STAMP)
	$(BIN)/citystitch demo --out demo

docs: $(STAMP)
	$(BIN)/python docs/site/build.py docs/_build

test: $(STAMP)
	$(BIN)/python -m pytest -n 2 -m 'not long'

test-long: $(STAMP)
	$(BIN)/python -m pytest -n 3 -m long

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

bench: $(STAMP)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check py-spy
	$(BIN)/python -m tests.benchmarks.bench
	$(BIN)/python -m pytest -o addopts= tests/benchmarks

kernels: $(STAMP)
	$(BIN)/python -m pytest -o addopts= -q --benchmark-disable tests/benchmarks

bench-tiles: $(STAMP)
	$(BIN)/python -m tests.benchmarks.tiles

bench-exports: $(STAMP)
	$(BIN)/python -m tests.benchmarks.exports

simulate: $(STAMP)
	$(BIN)/python -m tests.benchmarks.simulate virtual netherlands 1000
	$(BIN)/python -m tests.benchmarks.simulate dask netherlands 64

quality: $(STAMP)
	$(BIN)/python -m tests.benchmarks.quality

reliability: $(STAMP)
	$(BIN)/python -m tests.benchmarks.reliability

clean:
	rm -rf $(VENV) demo out docs/_build .pytest_cache .mypy_cache .ruff_cache
