"""Tests that the mutants fit the code, and that killed and surviving mutants are distinguished."""

import ast
import subprocess
from collections import Counter
from dataclasses import replace

import pytest

from tests.mutation_testing.__main__ import BROKEN, KILLED, STALE, SURVIVED, copied, tried
from tests.mutation_testing.mutant_catalogue import (
    CONTRACTS,
    ROOT,
    Mutant,
    StaleError,
    catalogue,
    chosen,
)

MUTANTS = catalogue()
ADD = Mutant("sums", "it subtracts", "sums.py", "a + b", "a - b", ("test_sums.py",))
"""A mutant of the sample tree."""


@pytest.mark.parametrize("mutant", MUTANTS, ids=str)
def test_a_mutant_stands_once_in_the_code_and_its_tests_are_there(mutant):
    assert mutant.applied() != (ROOT / mutant.file).read_text()


def test_every_contract_has_mutants_of_its_own():
    counts = Counter(mutant.contract for mutant in MUTANTS)
    assert set(CONTRACTS) <= set(counts)
    assert min(counts.values()) >= 5
    assert len(MUTANTS) >= 50
    assert len({str(mutant) for mutant in MUTANTS}) == len(MUTANTS), "no two of one name"
    assert len({(m.file, m.text, m.becomes) for m in MUTANTS}) == len(MUTANTS)
    assert chosen(MUTANTS, ["budget"]) == [m for m in MUTANTS if m.contract == "budget"]


@pytest.fixture
def tree(tmp_path):
    (tmp_path / "sums.py").write_text("def added(a, b):\n    return a + b\n")
    (tmp_path / "test_sums.py").write_text(
        "from sums import added\n\n"
        "def test_nothing():\n    assert added(2, 0) == 2\n\n"
        "def test_sums():\n    assert added(2, 3) == 5\n"
    )
    (tmp_path / "pytest.ini").write_text("[pytest]\n")
    return tmp_path


@pytest.mark.slow
def test_killed_survived_and_broken_are_distinguished_and_the_file_is_put_back(tree):
    ends = [
        tried(ADD, tree),
        tried(replace(ADD, tests=("test_sums.py::test_nothing",)), tree),
        tried(replace(ADD, text="def added", becomes="def subtracted"), tree),
        tried(replace(ADD, text="return a", becomes="while True: a"), tree, limit=1.0),
    ]
    assert [end.what for end in ends] == [KILLED, SURVIVED, BROKEN, KILLED]
    assert ends[0].why == "test_sums.py::test_sums"
    assert ends[3].why == "more than 1 s"
    assert (tree / "sums.py").read_text().endswith("return a + b\n")


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"text": "a * b"}, "expected once, found 0 times"),
        ({"text": "a"}, "expected once, found 3 times"),
        ({"becomes": "(a + b)"}, "the change changes nothing"),
        ({"becomes": "a +"}, "is no Python any more"),
        ({"file": "gone.py"}, "gone.py: no such file"),
        ({"tests": ("gone.py",)}, "gone.py: no such test"),
        ({"tests": ("test_sums.py::test_gone",)}, "test_sums.py: no test test_gone"),
    ],
)
def test_a_mutant_that_does_not_fit_any_more_is_stale_and_runs_nothing(tree, change, why):
    stale = replace(ADD, **change)
    with pytest.raises(StaleError, match=why):
        stale.applied(tree)
    end = tried(stale, tree)
    assert (end.what, end.seconds) == (STALE, 0.0)
    assert why in end.why


def test_the_tree_is_copied_as_git_has_it(tmp_path):
    there, here = tmp_path / "there", tmp_path / "here"
    (there / "results").mkdir(parents=True)
    for name in ("a.py", "b.py", "ignored.py", "results/large.csv"):
        (there / name).write_text(name)
    (there / ".gitignore").write_text("ignored.py\n")
    for command in (["init", "-q"], ["add", "a.py", "results"]):
        subprocess.run(["git", *command], cwd=there, check=True)
    (there / "a.py").write_text("a = 1")
    names = {p.relative_to(here).as_posix() for p in copied(there, here).rglob("*") if p.is_file()}
    assert names == {"a.py", "b.py", ".gitignore"}
    assert (here / "a.py").read_text() == "a = 1", "what is not committed yet is tried too"
    assert ast.parse((here / "a.py").read_text())
