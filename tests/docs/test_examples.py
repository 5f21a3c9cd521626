"""What pages give to be copied works as it stands."""

import subprocess
import sys

import pytest

from bench.problem.experiment import load
from tests.docs.pages import blocks, text_of

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
