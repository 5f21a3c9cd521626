"""Tests of simgap in user files.

The cases are scripts without ``if __name__ == "__main__"``, classes defined in scripts, and files
that have the names of simgap's packages.
"""

import subprocess
import sys
from pathlib import Path

import pytest

import simgap

ROOT = Path(simgap.__file__).parent
TUNER = """
from simgap import Tuner

class Mine(Tuner):
    def tune(self, task, rng):
        while True:
            yield rng.uniform(size=(1, task.dim))
"""
COMPARE = """
import simgap

print("the script runs")
run = simgap.compare(
    "ball-drop", tuners=[{tuner}], targets=1, seeds=1, budget=3, out="out", salt="public"{more}
)
print(sorted(run.statuses["tuner"].unique()), sorted(run.statuses["status"].unique()))
"""


def ran(folder, words):
    """Run Python in a folder and return the printed lines; show the errors if it fails."""
    done = subprocess.run(
        [sys.executable, *words],
        cwd=folder,
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
        env={"PATH": "/usr/bin:/bin", "PYTHONPATH": str(ROOT)},
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "Traceback" not in done.stderr, done.stderr
    return done.stdout.splitlines()


@pytest.mark.slow
@pytest.mark.parametrize("words", [["first.py"], ["-m", "first"]], ids=["script", "module"])
def test_a_script_without_a_guard_compares_in_worker_processes(words, tmp_path):
    folder = tmp_path / "my scripts"
    folder.mkdir()
    text = COMPARE.format(tuner='"cma_es", "least_squares"', more="")
    (folder / "first.py").write_text(text)
    lines = ran(folder, words)
    # The line appears once: a worker that imported the script would print it again.
    assert lines == ["the script runs", "['cma_es', 'least_squares'] ['done']"]
    assert (folder / "out" / "table.csv").is_file()


@pytest.mark.slow
def test_a_plugin_may_be_called_as_one_of_the_packages(tmp_path):
    (tmp_path / "bench.py").write_text(TUNER)
    (tmp_path / "scripts").mkdir()
    text = COMPARE.format(tuner='"mine"', more=', plugins=["bench.py"]')
    (tmp_path / "scripts" / "first.py").write_text(text)
    assert ran(tmp_path, ["scripts/first.py"])[-1] == "['mine'] ['done']"


@pytest.mark.parametrize("place", ["script", "module"])
def test_a_class_that_workers_cannot_have_is_refused_at_once(place, tmp_path):
    """The error is one line with a remedy, and no worker process is started."""
    script = tmp_path / "first.py"
    text = """
try:
    simgap.compare("ball-drop", tuners=[Mine], targets=1, budget=3, out="out")
except simgap.InputError as error:
    print(error)
"""
    if place == "script":
        script.write_text(TUNER + "import simgap\n" + text)
        where = f"is defined in the script {script.resolve()}"
        remedy = "put it into a file of its own, say mine.py"
        rest = "pass tuners=['mine'], plugins=['mine.py']"
    else:
        (tmp_path / "other.py").write_text(TUNER)
        script.write_text("from other import Mine\nimport simgap\n" + text)
        where = f"is defined in {tmp_path.resolve() / 'other.py'}"
        remedy = ""
        rest = f"pass tuners=['mine'], plugins=['{tmp_path.resolve() / 'other.py'}']"
    (line,) = ran(tmp_path, ["first.py"])
    assert line.startswith(f"tuner mine: class Mine {where}"), line
    assert remedy in line
    assert rest in line
    assert line.endswith("or pass jobs=0, which runs everything in this process")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("trust", [False, True])
def test_a_diagnoser_of_a_script_is_refused_at_once(trust, tmp_path):
    """Diagnosers run in worker processes, with and without isolation."""
    (tmp_path / "first.py").write_text(
        f"""
import simgap

@simgap.diagnosers.register
class Guess(simgap.Diagnoser):
    name = "guess"

    def diagnose(self, case):
        return simgap.Answer("adequate")

try:
    simgap.compare("diagnosis-small", tuners="guess", targets=1, trust={trust}, out="out")
except simgap.InputError as error:
    print(error)
"""
    )
    (line,) = ran(tmp_path, ["first.py"])
    assert line.startswith("diagnoser guess: class Guess is defined in the script ")
    assert "pass tuners=['guess'], plugins=['guess.py'], or pass jobs=0" in line
    assert not (tmp_path / "out").exists()
