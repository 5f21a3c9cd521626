"""Tests of the packages, their layers, and imports without cycles."""

import re
import shutil
import subprocess
import sys
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import grimp
import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("bench", "methods", "sims")
BENCH_PACKAGES = {
    "api", "benchmark", "bounce_shot", "cli", "conformance", "core", "datasets", "diagnosis",
    "diagnosis_benchmark", "experiments", "figures", "logs", "misspecification", "pages", "schemas",
    "studies", "suite",
}  # fmt: skip


def linted(root):
    """Check the import contracts of pyproject.toml for the code below `root`."""
    return subprocess.run(
        [
            sys.executable,
            "-c",
            "from importlinter.cli import lint_imports_command as c; c(['--no-cache'])",
        ],
        cwd=root,
        env={"PATH": "/usr/bin:/bin", "PYTHONPATH": str(root)},
        capture_output=True,
        text=True,
        check=False,
    )


def circle(imports):
    """Return the modules of an import cycle, with the first one repeated at the end.

    The list is empty if there is no cycle.
    """
    try:
        tuple(TopologicalSorter(imports).static_order())
    except CycleError as error:
        return error.args[1]
    return []


@pytest.fixture(scope="module")
def imports():
    """Map each module to the modules it imports, including imports in functions and for type
    checkers.
    """
    graph = grimp.build_graph(*PACKAGES, cache_dir=None)
    return {module: graph.find_modules_directly_imported_by(module) for module in graph.modules}


def test_the_packages_of_the_harness_are_listed():
    there = {p.stem for p in (ROOT / "bench").iterdir() if p.suffix == ".py" or p.is_dir()}
    assert there - {"__init__", "__pycache__"} == BENCH_PACKAGES


def test_imports_run_downwards_and_never_in_a_circle(imports):
    said = linted(ROOT)
    assert said.returncode == 0, said.stdout
    assert "0 broken" in said.stdout
    assert circle(imports) == []
    assert circle({**imports, "bench.core.plugin_registries": {"bench.api.compare"}})[:1] != []


REFERENCE_SIMULATORS = (
    "case_generation.ball_reference", "case_generation.joint_reference",
    "case_generation.strength_search", "machine_cases.machine_dynamics",
    "machine_cases.machine_simulation",
)  # fmt: skip
"""Modules that simulate and size hidden causes, also those of the robots in `tests/exams`."""


@pytest.mark.parametrize("module", REFERENCE_SIMULATORS)
def test_reference_simulators_share_no_code_with_what_their_cases_test(imports, module):
    seen, left = set(), [f"bench.diagnosis_benchmark.{module}"]
    while left:
        name = left.pop()
        seen.add(name)
        if name != "sims.core.simulator":  # Types of arrays and scenarios.
            left += [other for other in imports[name] if other not in seen]
    others = {n for n in seen if not n.startswith("bench.diagnosis_benchmark.")}
    assert others == {"sims.core.simulator"}


@pytest.mark.parametrize(
    ("module", "line", "contract"),
    [
        ("bench/benchmark/storage/run_journal.py", "import bench.benchmark.runner.tuner_loop",
        "the packages of bench form layers"),
        ("bench/diagnosis/fitting/trajectory_fit.py", "import methods.tuner",
        "diagnosis runs tuners through the runner alone"),
        ("bench/diagnosis/fitting/trajectory_fit.py", "import bench.diagnosis.search.effect_search",
        "the packages of diagnosis form layers"),
        ("methods/tuners/cma_es.py", "import sims.core.simulator",
        "tuners import neither the benchmark nor the simulators"),
        ("sims/core/simulator.py", "import bench.core.plugin_registries",
        "simulators import neither the benchmark nor the tuners"),
    ],
)  # fmt: skip
def test_an_import_that_climbs_is_found(module, line, contract, tmp_path):
    for package in PACKAGES:
        shutil.copytree(
            ROOT / package, tmp_path / package, ignore=shutil.ignore_patterns("__pycache__")
        )
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    path = tmp_path / module
    path.write_text(path.read_text() + f"\n{line}\n")
    said = linted(tmp_path)
    assert said.returncode == 1
    broken = [title for title in said.stdout.splitlines() if title.endswith("BROKEN")]
    assert any(contract in title for title in broken), said.stdout


GENERIC = re.compile(r"^class \w+\([^)]*\bNamedTuple\b[^)]*\bGeneric\b", re.M)
"""Pattern of classes that Python 3.10 refuses at import and later type checkers accept."""


def test_no_named_tuple_is_generic_which_python_3_10_refuses():
    rooms = [ROOT / name for name in ("bench", "methods", "sims")]
    files = [path for room in rooms for path in room.rglob("*.py")]
    assert len(files) > 300
    assert [path for path in files if GENERIC.search(path.read_text(encoding="utf-8"))] == []
    assert GENERIC.search("class Added(NamedTuple, Generic[T]):")
