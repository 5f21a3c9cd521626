"""Tests that `explain` works without PyTorch and PyBullet, and that lists give the reason."""

import json
import re
import shutil
import site
import subprocess
import sys
import zipfile
from functools import partial
from importlib.metadata import PackageNotFoundError, requires, version
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from tests.packaging.explain_requirements import FILE, LOCK, ROOT, WITHOUT, direct, pins
from tests.packaging.wheel_in_environment import build, environment, run_simgap

ABSENT = re.compile(r"(torch|functorch|torchgen|pybullet)", re.I)
"""Pattern of the names that the two packages install."""


def on(python):
    """Return a function that reads the pins (name, version) for a version of Python on Linux."""
    there = {
        "python_full_version": f"{python}.1",
        "python_version": python,
        "sys_platform": "linux",
        "platform_python_implementation": "CPython",
        "implementation_name": "cpython",
    }

    def held(path):
        return {name: v for name, v, marker in pins(path) if not marker or marker.evaluate(there)}

    return held


@pytest.mark.parametrize("python", ["3.10", "3.11", "3.12", "3.13"])
def test_pins_agree_with_each_other_and_with_the_project(python):
    explain, lock = (
        {canonicalize_name(name): v for name, v in on(python)(path).items()}
        for path in (FILE, LOCK)
    )
    assert not set(WITHOUT) & set(explain)
    assert {name: lock.get(name) for name in explain} == explain
    for line in direct():
        wanted = Requirement(line)
        if wanted.marker is None or wanted.marker.evaluate({"python_version": python}):
            name = canonicalize_name(wanted.name)
            assert wanted.specifier.contains(lock[name]), line
            assert name in explain, line


def test_the_pins_without_the_large_packages_are_complete():
    """Indirect requirements are pinned too, so installing with --no-deps omits none."""
    pinned = {canonicalize_name(name) for name, *_ in pins(FILE)}
    todo = [Requirement(line) for line in direct()]
    seen = set()
    while todo:
        wanted = todo.pop()
        name = canonicalize_name(wanted.name)
        if name in seen or (wanted.marker and not wanted.marker.evaluate({"extra": ""})):
            continue
        seen.add(name)
        try:
            version(wanted.name)
        except PackageNotFoundError:
            continue
        assert name in pinned, name
        todo += [Requirement(line) for line in requires(wanted.name) or ()]
    assert len(seen) > 40


def test_python_3_10_has_upper_bounds_where_pip_cannot_backtrack():
    """If an index does not state Requires-Python, pip 23 tries releases for Python 3.11."""
    there = {"python_version": "3.10"}
    bounded = {
        wanted.name: wanted.specifier
        for wanted in map(Requirement, direct())
        if wanted.marker is not None and wanted.marker.evaluate(there)
    }
    assert not bounded["pint"].contains("0.25")
    assert not bounded["etils"].contains("1.14.0")


def test_no_page_or_message_advises_to_install_simgap_from_an_index():
    """simgap is on no index: `pip install simgap[npe]` would fail or install a foreign package."""
    files = [*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md"), *(ROOT / "docs").rglob("*.ipynb")]
    files += [p for name in ("bench", "methods", "sims") for p in (ROOT / name).rglob("*.py")]
    advised = re.compile(r"pip install [\"']?simgap\b")
    wrong = [str(path) for path in files if advised.search(path.read_text(encoding="utf-8"))]
    assert wrong == []


needs_make = pytest.mark.skipif(not shutil.which("make"), reason="no make")


def run_make(*words, code=0, **kept):
    """Run make and return its output; it needs no environment to print or refuse a target."""
    done = subprocess.run(
        ["make", "--no-print-directory", *words],
        cwd=ROOT, capture_output=True, text=True, check=False, **kept,
    )  # fmt: skip
    assert done.returncode == code, done.stderr
    return done.stdout + done.stderr


@needs_make
@pytest.mark.parametrize(
    ("without", "installed", "absent"),
    [
        ("torch,pybullet", "requirements-explain.txt hatchling editables", "requirements.lock"),
        ("torch", "requirements-explain.txt hatchling editables pybullet", "requirements.lock"),
        ("", "install --no-compile -r requirements.lock", "requirements-explain"),
    ],
)
def test_make_installs_all_packages_except_without(tmp_path, without, installed, absent):
    stamp = tmp_path / "env" / ".installed"
    shown = run_make("--dry-run", str(stamp), f"VENV={tmp_path / 'env'}", f"WITHOUT={without}")
    assert installed in shown
    assert f"-r {absent}" not in shown


@needs_make
def test_make_refuses_to_omit_packages_that_explain_needs(tmp_path):
    folder = tmp_path / "env"
    said = run_make(
        "install", f"VENV={folder}", "WITHOUT=numpy", f"PYTHON={sys.executable}", code=2
    )
    assert "WITHOUT=numpy: expected torch, pybullet or torch,pybullet" in said
    assert not folder.exists()


@needs_make
@pytest.mark.parametrize(
    ("last", "now", "again"),
    [
        ("torch pybullet", "", True),
        ("torch pybullet", "torch,pybullet", False),
        ("", "", False),
        ("", "torch", True),
    ],
)
def test_a_changed_without_installs_again(tmp_path, last, now, again):
    stamp = tmp_path / "env" / ".installed"
    stamp.parent.mkdir()
    stamp.write_text(f"{last}\n")
    # The Python `false` ends the installation at its start.
    words = ["install", f"VENV={stamp.parent}", f"WITHOUT={now}", "PYTHON=false"]
    run_make(*words, code=2 if again else 0)
    assert stamp.exists() != again


@pytest.fixture(scope="module")
def python(tmp_path_factory):
    """Return an interpreter with simgap's wheel and all installed packages except the large two."""
    folder = tmp_path_factory.mktemp("without")
    found = environment(folder / "env")
    (packages,) = (folder / "env" / "lib").glob("python3*/site-packages")
    for place in map(Path, site.getsitepackages()):
        for each in place.iterdir():
            ours = each.name.lower().startswith(("simgap", "_simgap", "__editable__"))
            ours = ours or each.suffix == ".pth"  # path files would add this checkout
            if not ABSENT.match(each.name) and not ours and each.name != "__pycache__":
                (packages / each.name).symlink_to(each)
    with zipfile.ZipFile(build(folder)) as wheel:
        wheel.extractall(packages)
    return found


@pytest.mark.slow
def test_explain_works_and_lists_report_absent_packages(python, tmp_path):
    simgap = partial(run_simgap, python, tmp_path)
    listed = json.loads(simgap("list", "--json").stdout)
    tuners = {each["name"]: each["skipped"] for each in listed["tuners"]}
    assert tuners["tunenet"] == "needs torch, not installed (pip install torch)"
    assert tuners["least_squares"] is None
    experiments = {each["name"]: each for each in listed["experiments"]}
    assert "needs pybullet" in experiments["ball-drop"]["skipped"]
    assert experiments["robot-arm2"]["skipped"] is None
    assert "tunenet" in experiments["robot-arm2"]["tuners_skipped"]
    info = json.loads(simgap("info", "--json").stdout)
    missing = {each["name"]: each["missing"] for each in info["packages"] if not each["of"]}
    assert missing["torch"] == 'not installed (pip install "torch>=2.2")'
    assert "pybullet" in missing["pybullet"]
    said = simgap("compare", "ball-drop", "--targets", "1", code=2).stderr
    assert said == "simgap: engine pybullet needs pybullet, not installed (pip install pybullet)\n"
    hidden = ["--effect", "drag.linear=2e-4", "--noise", "q=0.01", "qd=0.05"]
    simgap("simulate", "--engine", "mujoco", *hidden, "pendulum", "--out", "swing.csv")
    simgap("explain", "swing.csv", "--jobs", "1", "--out", "told")
    verdict = json.loads((tmp_path / "told" / "verdict.json").read_text())
    assert verdict["verdict"] == "named"
    assert [cause["effect"] for cause in verdict["causes"]] == ["drag.linear"]
