"""Tests that the examples on pages work unchanged."""

import os
import re
import shlex
import shutil
import subprocess
import sys

import pytest

from bench.benchmark.problem.experiment_config import load_experiment
from tests.docs.documentation_pages import FENCE, ROOT, blocks, quoted, section, tables, text_of

SIMGAP = [sys.executable, "-m", "simgap"]


def block(page, name):
    """Return the named block of a page."""
    return dict(blocks(text_of(page)))[name]


def test_the_experiment_of_the_page_loads_as_described(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text(block("compare.md", "mine.toml"), encoding="utf-8")
    experiment = load_experiment(str(path))
    assert experiment.targets == 3
    assert str(experiment.recording.path).endswith("swing.csv")
    assert [entry.tuner for entry in experiment.tuners] == ["least_squares", "cma_es", "random"]


@pytest.mark.long
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
    # The extended model is a simulator again; without the plugin, the error names the missing
    # option.
    extended = ["--plugin", "cart.py", "--plugin", "explained/extended.toml"]
    words = [*SIMGAP, "simulate", "cart_extended", *extended, "--out", "more.csv"]
    done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    words = [*SIMGAP, "score", "explained/extended.toml", "log.csv"]
    done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert done.stderr.endswith("add the file that defines it: --plugin cart.py\n")


def test_every_attribute_and_method_of_an_own_simulator_is_on_its_page():
    from sims.own_simulator import OwnSimulator

    page = text_of("own-simulator.md")
    rows = [row[0] for table in tables(page) for row in table]
    named = {name for row in rows for name in re.findall(r"`(\w+)", row)}
    own = {name for name in vars(OwnSimulator) if not name.startswith("_")}
    own |= {"name", "says", "parameters", "channels", "constants", "inputs", "states", "requires"}
    assert own - {"system", "own_engine"} <= named


README = (ROOT / "README.md").read_text(encoding="utf-8")
SKIPPED = (
    *(f"compare {first}" for first in ("ball", "pend", "bounce", "diag", "suite", "--recording")),
    "check cma_es",  # tests/conformance makes these checks
    "explain examples/robot/log.csv --ranges",  # as test_randomization
)
"""Commands of the table that take minutes or that other tests run; test_commands checks syntax."""


def table_commands():
    """Return the commands in the README's table as lists of words, in order."""
    cells = [row[2] for table in tables(section(README, "## What you can do")) for row in table]
    lines = [text for cell in cells for text in quoted(cell)]
    return [shlex.split(line)[1:] for line in lines if line.startswith("simgap ")]


@pytest.mark.long
def test_the_commands_of_the_readme_work_as_written_in_a_clone_that_stands_alone(tmp_path):
    shutil.copytree(ROOT / "examples", tmp_path / "examples")
    env = {k: v for k, v in os.environ.items() if k not in ("SIMGAP_DATA", "SIMGAP_ROBOTS")}

    def run(words):
        done = subprocess.run(
            [*SIMGAP, *words], cwd=tmp_path, env=env, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, f"{shlex.join(words)}\n{done.stdout}{done.stderr}"
        return done.stdout.splitlines()

    four = section(README, "## Four commands")
    parts = [(m["language"], m["text"]) for m in FENCE.finditer(four)]
    assert [language for language, _ in parts] == ["sh", "text"] * 3
    commands = 0
    for (_, lines), (_, shown) in zip(parts[::2], parts[1::2], strict=True):
        printed = []
        for line in lines.splitlines():
            printed += run(shlex.split(line)[1:])
            commands += 1
        for line in shown.splitlines():
            assert line in [*printed, "..."]
    assert commands == 4
    short = [words for words in table_commands() if not " ".join(words).startswith(SKIPPED)]
    mine = [words for words in short if words[0] != "import"]  # `import` needs a log of the user
    assert len(mine) >= 11
    for words in mine:
        run(words)


def test_the_readme_is_short_and_has_two_pictures():
    assert len(README.splitlines()) <= 120
    assert README.count("![") == 2
