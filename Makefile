# make compare   a small comparison, from a bare machine to the figure
# make explain   a small diagnosis: makes a recording with a hidden cause, finds it, writes the report
# make test      the tests
# make check     lint, types and import rules
# make exam      hides causes in hundreds of recordings and has explain find them (about an hour; QUICK=--quick)
# make benchmark measurements printed as ratios
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed

.PHONY: compare explain test check exam benchmark install
install: $(STAMP)

$(STAMP): requirements.lock pyproject.toml
	@$(PYTHON) -c 'import sys; v = sys.version_info; sys.exit(None if v >= (3, 10) else f"simgap needs Python 3.10 or newer, found {v.major}.{v.minor}; set PYTHON=")'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -r requirements.lock
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation --editable .
	@touch $@

compare: $(STAMP)
	$(BIN)/simgap compare ball-drop --targets 10 --seeds 2 --budget 50

explain: $(STAMP)
	rm -rf results/example
	mkdir -p results/example
	$(BIN)/simgap simulate pendulum --engine mujoco --effect drag.linear=2e-4 --noise q=0.01 qd=0.05 --out results/example/swing.csv
	$(BIN)/simgap explain results/example/swing.csv --out results/example/explained
	$(BIN)/simgap score results/example/explained/extended.toml results/example/swing.csv

test: $(STAMP)
	$(BIN)/python -m pytest

check: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

benchmark: $(STAMP)
	$(BIN)/python -m tests.benchmarks.harness
	$(BIN)/python -m tests.benchmarks.engines

exam: $(STAMP)
	$(BIN)/python -m tests.exam $(QUICK)
