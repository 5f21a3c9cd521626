# make compare   a small comparison, from a bare machine to the figure
# make test      the tests
# make check     lint, types and import rules
# make benchmark measurements printed as ratios
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed

.PHONY: compare test check benchmark install
install: $(STAMP)

$(STAMP): requirements.lock pyproject.toml
	@$(PYTHON) -c 'import sys; v = sys.version_info; sys.exit(None if v >= (3, 10) else f"simgap needs Python 3.10 or newer, found {v.major}.{v.minor}; set PYTHON=")'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -r requirements.lock
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation --editable .
	@touch $@

compare: $(STAMP)
	$(BIN)/simgap compare ball-drop --targets 10 --seeds 2 --budget 50

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

# the exam of `explain`, on recordings of independent simulators: long, goes on where it was; `make exam QUICK=--quick`
.PHONY: exam
exam: $(STAMP)
	$(BIN)/python -m tests.exam $(QUICK)
