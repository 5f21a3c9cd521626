"""Hand-made wrong changes to the code; each breaks a contract and must make a test fail.

A contract is a file ``NAME.toml`` in this folder, and a mutant is a table in it::

    [[mutant]]
    says = "the budget is overshot by one simulation"
    file = "bench/benchmark/runner/tuner_loop.py"
    text = "if left <= 0:"       # occurs once in the file
    becomes = "if left < 0:"
    tests = ["tests/bench/runner/test_tuner_loop.py"]

`tests` are fast tests of the same package: files, folders, or ``FILE::TEST``.
"""

from __future__ import annotations

import ast
import re
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from sims.core.toml_validation import tomllib

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
CONTRACTS = (
    "budget", "files", "held_out", "intervals", "noise", "p_values", "pairing", "recommendation",
    "resume", "sealing", "seeds", "statuses", "units", "verdict",
)  # fmt: skip
"""Contracts that must have mutants."""


class StaleError(ValueError):
    """A mutant that no longer fits the code."""


@dataclass(frozen=True)
class Mutant:
    """A wrong change to the code.

    Attributes:
        contract: name of the contract that it breaks.
        says: short description.
        file: path below the root.
        text: original code, which occurs once in the file.
        becomes: replacement.
        tests: tests, at least one of which must fail.
    """

    contract: str
    says: str
    file: str
    text: str
    becomes: str
    tests: tuple[str, ...]

    def __str__(self) -> str:
        return f"{self.contract}: {self.says}"

    def applied(self, root: Path = ROOT) -> str:
        """Return the text of the file with the change applied.

        Raises:
            StaleError: file, text or tests do not exist, or the code keeps its meaning.
        """
        path = root / self.file
        if not path.is_file():
            raise StaleError(f"{self.file}: no such file")
        whole = path.read_text(encoding="utf-8")
        if (found := whole.count(self.text)) != 1:
            raise StaleError(f"{self.file}: expected once, found {found} times: {self.text!r}")
        for test in self.tests:
            _find(root, test)
        changed = whole.replace(self.text, self.becomes)
        try:
            same = ast.dump(ast.parse(changed)) == _meaning(whole)
        except SyntaxError as error:
            raise StaleError(f"{self.file}: is no Python any more: {error}") from None
        if same:
            raise StaleError(f"{self.file}: the change changes nothing")
        return changed


@lru_cache(maxsize=64)
def _meaning(text: str) -> str:
    """Return the syntax tree of Python code, without layout and comments."""
    return ast.dump(ast.parse(text))


def _find(root: Path, test: str) -> None:
    """Check that a test exists.

    Raises:
        StaleError: it does not exist.
    """
    place, *names = test.split("::")
    if not (root / place).exists():
        raise StaleError(f"{place}: no such test")
    for name in names:
        function = name.partition("[")[0]
        if not re.search(rf"^\s*(def|class) {function}\b", (root / place).read_text(), re.M):
            raise StaleError(f"{place}: no test {function}")


def catalogue(folder: Path = HERE) -> list[Mutant]:
    """Return the mutants of all contracts in a folder."""
    mutants = []
    for path in sorted(folder.glob("*.toml")):
        for table in tomllib.loads(path.read_text(encoding="utf-8"))["mutant"]:
            mutants.append(Mutant(path.stem, **{**table, "tests": tuple(table["tests"])}))
    return mutants


def chosen(mutants: list[Mutant], words: list[str]) -> list[Mutant]:
    """Select mutants by contract or by a word of their description; no words select all."""
    contracts = {mutant.contract for mutant in mutants}

    def wanted(mutant: Mutant, word: str) -> bool:
        return word == mutant.contract if word in contracts else word in mutant.says

    return [m for m in mutants if not words or any(wanted(m, word) for word in words)]
