"""What pages give to be copied works as it stands."""

import re
import shlex
import subprocess
import sys

import pytest

from bench.problem.experiment import load
from tests.docs.pages import blocks, tables, text_of

SIMGAP = [sys.executable, "-m", "simgap"]


def block(page, name):
    """The named block of a page."""
    return dict(blocks(text_of(page)))[name]


@pytest.mark.slow
def test_the_tuner_of_the_page_keeps_the_contract(tmp_path):
    (tmp_path / "my_tuner.py").write_text(block("add-a-tuner.md", "my_tuner.py"), encoding="utf-8")
    check = [*SIMGAP, "check", "narrowing", "--plugin", "my_tuner.py"]
    done = subprocess.run(check, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "all 14 checks passed" in done.stdout


def test_the_experiment_of_the_page_reads_as_it_says(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text(block("compare.md", "mine.toml"), encoding="utf-8")
    experiment = load(str(path))
    assert experiment.targets == 3
    assert str(experiment.recording.path).endswith("swing.csv")
    assert [entry.tuner for entry in experiment.tuners] == ["least_squares", "cma_es", "random"]


@pytest.mark.slow
def test_the_simulator_of_the_page_does_what_the_page_says(tmp_path):
    page = "own-simulator.md"
    (tmp_path / "cart.py").write_text(block(page, "cart.py"), encoding="utf-8")
    assert len(block(page, "cart.py").splitlines()) <= 40
    said = []
    for command in block(page, "cart.sh").splitlines():
        words = [*SIMGAP, *shlex.split(command)[1:]]
        done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout + done.stderr
        said.append(done.stdout)
    shown = block(page, "cart.out").splitlines()
    assert len(shown) == len(said)
    for line, output in zip(shown, said, strict=True):
        assert line in output.splitlines()
    # The model that was found is a simulator again, and without the plugin the option is named.
    extended = ["--plugin", "cart.py", "--plugin", "explained/extended.toml"]
    words = [*SIMGAP, "simulate", "cart_extended", *extended, "--out", "more.csv"]
    done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    words = [*SIMGAP, "score", "explained/extended.toml", "log.csv"]
    done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert done.stderr.endswith("add the file that defines it: --plugin cart.py\n")


def test_every_attribute_and_method_of_an_own_simulator_is_on_its_page():
    from sims.own import OwnSimulator

    page = text_of("own-simulator.md")
    rows = [row[0] for table in tables(page) for row in table]
    named = {name for row in rows for name in re.findall(r"`(\w+)", row)}
    own = {name for name in vars(OwnSimulator) if not name.startswith("_")}
    own |= {"name", "says", "parameters", "channels", "constants", "inputs", "states", "requires"}
    assert own - {"system", "own_engine"} <= named
