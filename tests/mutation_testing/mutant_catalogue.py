"""Wrong changes to the code, made by hand, each of which breaks a contract and must make a test
fail.

A contract is a file ``NAME.toml`` beside this one, and a mutant a table in it::

    [[mutant]]
    says = "the budget is overshot by one simulation"
    file = "bench/benchmark/runner/tuner_loop.py"
    text = "if left <= 0:"       # stands once in the file
    becomes = "if left < 0:"
    tests = ["tests/bench/runner/test_tuner_loop.py"]

`tests` are those of the room that must notice: files, folders, or ``FILE::TEST``, quick ones.
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
"""What must have mutants, whatever else has."""


class StaleError(ValueError):
    """A mutant that does not fit the code any more."""


@dataclass(frozen=True)
class Mutant:
    """A wrong change.

    Attributes:
        contract: what it breaks.
        says: how, in a few words.
        file: place below the root.
        text: what stands there once.
        becomes: what stands there instead.
        tests: that must fail.
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
        """The text of its file with the change in it.

        Raises:
            StaleError: the file, its text or its tests are not there, or it changes nothing.
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
    """Python code without its layout and comments."""
    return ast.dump(ast.parse(text))


def _find(root: Path, test: str) -> None:
    """See that a test is there.

    Raises:
        StaleError: it is not.
    """
    place, *names = test.split("::")
    if not (root / place).exists():
        raise StaleError(f"{place}: no such test")
    for name in names:
        function = name.partition("[")[0]
        if not re.search(rf"^\s*(def|class) {function}\b", (root / place).read_text(), re.M):
            raise StaleError(f"{place}: no test {function}")


def catalogue(folder: Path = HERE) -> list[Mutant]:
    """Every mutant of a folder, contract by contract."""
    mutants = []
    for path in sorted(folder.glob("*.toml")):
        for table in tomllib.loads(path.read_text(encoding="utf-8"))["mutant"]:
            mutants.append(Mutant(path.stem, **{**table, "tests": tuple(table["tests"])}))
    return mutants


def chosen(mutants: list[Mutant], words: list[str]) -> list[Mutant]:
    """Those of the contracts among the words, and those that say one of the other words; all
    without words.
    """
    contracts = {mutant.contract for mutant in mutants}

    def wanted(mutant: Mutant, word: str) -> bool:
        return word == mutant.contract if word in contracts else word in mutant.says

    return [m for m in mutants if not words or any(wanted(m, word) for word in words)]
