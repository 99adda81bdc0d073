# make demo   from nothing to four verified data sets, a trained model, its scores, a leaderboard page
# make test   install and run the tests; make test-all: those that are slow too
PYTHON ?= python3
VENV ?= .venv
JOBS ?= 2
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check

.PHONY: demo test test-all lint types bench clean

demo: $(VENV)/.demo
	$(BIN)/lagbench demo --root demo

test: $(VENV)/.dev
	OMP_NUM_THREADS=1 $(BIN)/pytest -n $(JOBS) --dist worksteal -m "not slow"

test-all: $(VENV)/.dev
	OMP_NUM_THREADS=1 $(BIN)/pytest -n $(JOBS) --dist worksteal

lint: $(VENV)/.dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(VENV)/.dev
	$(BIN)/mypy lagbench studies validation benchmarks

bench: $(VENV)/.dev
	OMP_NUM_THREADS=1 $(BIN)/pytest benchmarks -s

$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo "lagbench needs Python 3.11 or newer: make PYTHON=python3.11 ..." >&2; exit 1; }
	$(PYTHON) -m venv $(VENV)

$(VENV)/.demo: $(BIN)/python pyproject.toml constraints.txt
	@echo 'installing into $(VENV): about 1 GB, some minutes'
	$(PIP) install --quiet --no-compile -c constraints.txt -e '.[generate,plots,baselines]'
	touch $@

$(VENV)/.dev: $(BIN)/python pyproject.toml constraints.txt
	@echo 'installing into $(VENV): more than 1 GB, some minutes'
	$(PIP) install --quiet --no-compile -c constraints.txt -e '.[dev]'
	touch $@ $(VENV)/.demo

clean:
	rm -rf build dist *.egg-info .mypy_cache .ruff_cache .pytest_cache .hypothesis .benchmarks
