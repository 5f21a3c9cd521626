# make compare   a small comparison, from a bare machine to the figure (TARGETS=5 SEEDS=1 is shorter)
# make explain   a small diagnosis: makes a recording with a hidden cause, finds it, writes the report
# make robot     the same for a robot: an arm's model file and a log, with friction in the elbow
# make test      the tests that take a few seconds each (about 6 minutes on two cores)
# make test-rest the slow ones and those that depend on recordings beside the clone (PART=1/12: a twelfth)
# make test-all  all of them, those of minutes too: whole examples, exams and clusters (30 minutes)
# make check     lint, types, import rules and language
# make docs      the site, to be read without a network: site/html/index.html (Python 3.11 or newer)
# make exam      hides causes in hundreds of recordings and has explain find them (10 minutes; QUICK=--quick, EXAM=robots)
# make benchmark measurements printed as ratios
# make chaos     100 kills at random moments; what is resumed must equal what was never disturbed (about 10 minutes)
# make malformed twelve thousand malformed files, folders and arguments to every command (about 5 minutes; KINDS="films weights")
# make mutants   two hundred wrong changes, each of which a test must notice (about 10 minutes; ONLY="budget noise", JOBS=4)
# make wheel     the wheel, in an empty environment of PYTHON (WITHOUT=torch,pybullet where pip would compile or fetch gigabytes)
# make reference the comparison of results/reference/comparison again, below results/ (about 10 minutes)
# make multi     the comparison of results/reference/multi again, below results/ (about 15 minutes; TUNERS=a,b,... for others)
# make install  .venv alone; WITHOUT=torch,pybullet: a minute, for explain and what belongs to it
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
# Byte code is stored whatever the environment says: without it each process compiles 300 modules.
unexport PYTHONDONTWRITEBYTECODE

EMPTY :=
SPACE := $(EMPTY) $(EMPTY)

.PHONY: compare explain robot test test-all test-rest check exam benchmark chaos malformed mutants reference multi wheel docs install
# Another WITHOUT than that of the last install changes the environment; other targets take it as it is.
install:
	@if [ -f $(STAMP) ] && [ "$$(cat $(STAMP))" != "$(strip $(LEFT_OUT))" ]; then rm $(STAMP); fi
	@$(MAKE) --no-print-directory $(STAMP)

COMMA := ,
LARGE := torch pybullet
LEFT_OUT := $(subst $(COMMA), ,$(WITHOUT))
RARELY_IMPORTED := /(tests|testing|pip|mypyc?|debugpy|OpenGL|jedi|IPython|playwright|pybullet_envs|_inductor|_vendor)/
PIP := $(BIN)/python -m pip --quiet --disable-pip-version-check

$(STAMP): requirements.lock requirements-explain.txt pyproject.toml
	@$(PYTHON) -c 'import sys; v = sys.version_info; sys.exit(None if v >= (3, 10) else f"simgap needs Python 3.10 or newer, found {v.major}.{v.minor}; set PYTHON=")'
	@test -z "$(filter-out $(LARGE),$(LEFT_OUT))" || { echo "WITHOUT=$(WITHOUT): expected torch, pybullet or torch,pybullet" >&2; exit 2; }
	$(PYTHON) -m venv $(VENV)
ifeq ($(strip $(LEFT_OUT)),)
	$(PIP) install --no-compile -r requirements.lock
	$(PIP) install --no-deps --no-build-isolation --editable .
else
	$(PIP) uninstall --yes $(LEFT_OUT) 2>/dev/null
	$(PIP) install --no-compile --constraint requirements.lock -r requirements-explain.txt hatchling editables $(filter-out $(LEFT_OUT),$(LARGE))
	$(PIP) install --no-deps --no-build-isolation --editable .
endif
	@# pip would compile on one core. A package may have files for another version of Python. Files
	@# that few commands import are compiled when they are imported: two fifths of all.
	$(BIN)/python -W ignore -m compileall -qq -j 0 -x '$(RARELY_IMPORTED)' $(VENV)/lib bench methods sims simgap.py || true
	$(BIN)/python -m bench.diagnosis.kalman.precompile
	$(BIN)/python -m bench.pages.precompile
	@echo "$(strip $(LEFT_OUT))" > $@

TARGETS ?= 10
SEEDS ?= 2

compare: $(STAMP)
	$(BIN)/simgap compare ball-drop --targets $(TARGETS) --seeds $(SEEDS) --budget 50

explain: $(STAMP)
	rm -rf results/example
	mkdir -p results/example
	$(BIN)/simgap simulate pendulum --engine mujoco --effect drag.linear=2e-4 --noise q=0.01 qd=0.05 --out results/example/swing.csv
	$(BIN)/simgap explain results/example/swing.csv --out results/example/explained
	$(BIN)/simgap score results/example/explained/extended.toml results/example/swing.csv

robot: $(STAMP)
	rm -rf results/robot-example
	$(BIN)/simgap explain examples/robot/log.csv --out results/robot-example
	$(BIN)/simgap score results/robot-example/extended.toml examples/robot/log.csv --held-out

PYTEST := $(BIN)/python -m pytest -n 3 --dist loadfile --no-loadscope-reorder

test: $(STAMP)
	$(PYTEST) -m "not slow and not long"

test-all: $(STAMP)
	$(PYTEST)

test-rest: $(STAMP)
	$(PYTEST) -m "(slow or data) and not long" $(if $(PART),--part $(PART))

check: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/python -m tests.language

benchmark: $(STAMP)
	$(BIN)/python -m tests.benchmarks.harness_overhead
	$(BIN)/python -m tests.benchmarks.stepping_speed
	$(BIN)/python -m tests.benchmarks.comparison_scaling
	$(BIN)/python -m tests.benchmarks.isolation_overhead

chaos: $(STAMP)
	$(BIN)/python -m tests.kill_and_resume --kills 100

malformed: $(STAMP)
	MALFORMED=12000 $(BIN)/python -m pytest -q -m slow tests/malformed_input \
		-k "malformed and ($(or $(subst $(SPACE), or ,$(strip $(KINDS))),malformed))"

JOBS ?= 2

mutants: $(STAMP)
	$(BIN)/python -m tests.mutation_testing $(ONLY) --jobs $(JOBS)

PROBLEMS := ball-drop slider-push pendulum-swing servo-step ball-wind ball-crossengine
REFERENCE := results/comparison

reference: $(STAMP)
	for e in $(PROBLEMS); do $(BIN)/simgap compare $$e --targets 5 --seeds 1 --budget 30 --salt public --out $(REFERENCE)/$$e || exit 1; done
	$(BIN)/simgap plot $(PROBLEMS:%=$(REFERENCE)/%) --out $(REFERENCE)/all

SEVERAL := ball-tilt pendulum-driven servo-friction arm-swing
MULTI := results/multi

multi: $(STAMP)
	for e in $(SEVERAL); do $(BIN)/simgap compare $$e --targets 3 --seeds 2 --budget 50 --salt public $(if $(TUNERS),--tuners $(TUNERS)) --out $(MULTI)/$$e --allow-failures || exit 1; done
	$(BIN)/simgap plot $(SEVERAL:%=$(MULTI)/%) --out $(MULTI)/all
	$(BIN)/python -m tests.benchmarks.multi_problem_tables $(MULTI) > $(MULTI)/tables.md

docs: $(STAMP)
	$(BIN)/python -m tests.docs.generate_pages
	$(BIN)/python -m tests.docs.documentation_site --notebooks

EXAM ?= systems

exam: $(STAMP)
	$(BIN)/python -m tests.exams $(EXAM) $(QUICK)

wheel: $(STAMP)
	$(BIN)/python -m tests.packaging $(if $(WITHOUT),--without $(WITHOUT)) $(PYTHON)
