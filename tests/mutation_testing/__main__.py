"""Apply the mutants of `mutant_catalogue` to a copy of the tree and run the tests that must notice.

Mutants are applied one at a time. `make mutants` runs all. Run `python -m tests.mutation_testing
[CONTRACT ...] [--jobs N] [--limit S]` for some of them. Exit code 1 where one survives, does not
fit the code any more, or breaks so much that no test is reached.
"""

from __future__ import annotations

import argparse
import importlib.util
import os
import queue
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from tests.mutation_testing.mutant_catalogue import ROOT, Mutant, StaleError, catalogue, chosen

LIMIT = 180.0
"""Time limit in seconds for the tests of one mutant; a mutant that exceeds it counts as killed."""
LEFT_OUT = ("results",)
"""Large folders that no test of a mutant reads."""
KILLED, SURVIVED, STALE, BROKEN = "killed", "SURVIVED", "STALE", "BROKEN"
_PASSED, _FAILED, _SLOW = 0, 1, -1
"""Exit codes of pytest, and a code for an exceeded time limit."""


class End(NamedTuple):
    """Result of a mutant, its reason and its duration in seconds."""

    mutant: Mutant
    what: str
    why: str
    seconds: float


def copied(root: Path, folder: Path) -> Path:
    """Copy the files below `root` that git tracks or would track."""
    command = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    listed = subprocess.run(command, cwd=root, capture_output=True, text=True, check=True)
    for name in filter(None, listed.stdout.split("\0")):
        # Git still lists files that are deleted without a commit.
        if name.startswith(tuple(f"{left}/" for left in LEFT_OUT)) or not (root / name).is_file():
            continue
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(root / name, folder / name)
    return folder


def verdict_on(root: Path, tests: Sequence[str], limit: float = LIMIT) -> tuple[int, str]:
    """Run tests of the tree at `root`; return the exit code of pytest and the first failure."""
    options = ["-x", "-q", "-p", "no:cacheprovider", "--rootdir", str(root)]
    threads = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
    # Import the packages of the copy, not the installed ones. Byte code is not stored: it counts as
    # that of the source if both have the same second and size, which two mutants may share.
    environment = {
        **os.environ, **threads, "PYTHONPATH": str(root), "PYTHONDONTWRITEBYTECODE": "1"
    }  # fmt: skip
    with tempfile.TemporaryFile("w+") as said:
        process = subprocess.Popen(
            [sys.executable, "-m", "pytest", *options, *tests],
            cwd=root, env=environment, start_new_session=True,
            stdout=said, stderr=subprocess.STDOUT,
        )  # fmt: skip
        try:
            code = process.wait(limit)
        except subprocess.TimeoutExpired:
            return _SLOW, f"more than {limit:g} s"
        finally:
            # The process has its own session, so this ends all its children too.
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()
        said.seek(0)
        text = said.read()
    first = re.search(r"^(?:FAILED|ERROR) (?:\S*/)?(.+?)(?: - |$)", text, re.M)
    return code, first[1] if first else text.strip()[-300:]


def tried(mutant: Mutant, root: Path, limit: float = LIMIT) -> End:
    """Apply a mutant to the tree at `root`, run its tests, and restore the file."""
    started, path = time.monotonic(), root / mutant.file
    try:
        changed = mutant.applied(root)
    except StaleError as error:
        return End(mutant, STALE, str(error), 0.0)
    before = path.read_bytes()
    try:
        _write(path, changed.encode())
        code, why = verdict_on(root, mutant.tests, limit)
    finally:
        _write(path, before)
    what = {_PASSED: SURVIVED, _FAILED: KILLED, _SLOW: KILLED}.get(code, BROKEN)
    return End(mutant, what, "" if what == SURVIVED else why, time.monotonic() - started)


def _fits(mutant: Mutant) -> bool:
    try:
        return bool(mutant.applied())
    except StaleError:
        return False


def _write(path: Path, data: bytes) -> None:
    path.write_bytes(data)
    # Python checks a compiled file by modification time (in seconds) and size, which may both be
    # equal.
    Path(importlib.util.cache_from_source(str(path))).unlink(missing_ok=True)


def survey(mutants: Sequence[Mutant], jobs: int = 1, limit: float = LIMIT) -> list[End]:
    """Run the tests of all mutants and print each result; each job has its own copy of the tree.

    Raises:
        SystemExit: a test fails without any mutant.
    """
    with tempfile.TemporaryDirectory(prefix="simgap-mutants-") as folder:
        copies: queue.SimpleQueue[Path] = queue.SimpleQueue()
        for i in range(jobs):
            copies.put(copied(ROOT, Path(folder, str(i))))
        fitting = [mutant for mutant in mutants if _fits(mutant)]
        tests = sorted({test for mutant in fitting for test in mutant.tests})
        # A test file in the list already includes its single tests.
        tests = [t for t in tests if "::" not in t or t.partition("::")[0] not in tests]
        code, why = verdict_on(Path(folder, "0"), tests, limit * len(tests))
        if code != _PASSED:
            raise SystemExit(f"unchanged code fails its tests: {why}")
        width = max(len(str(mutant)) for mutant in mutants)

        def work(mutant: Mutant) -> End:
            root = copies.get()
            try:
                end = tried(mutant, root, limit)
            finally:
                copies.put(root)
            print(f"{end.what:9}{end.seconds:6.1f} s  {mutant!s:{width}}  {end.why}", flush=True)
            return end

        pool = ThreadPoolExecutor(jobs)
        try:
            return list(pool.map(work, mutants))
        finally:
            # After an interrupt, only the running mutants are finished.
            pool.shutdown(cancel_futures=True)


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.mutation_testing", description=__doc__)
    parser.add_argument("words", nargs="*", metavar="CONTRACT", help="contracts, or words")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--limit", type=float, default=LIMIT, help="seconds for one mutant")
    options = parser.parse_args()
    mutants = chosen(catalogue(), options.words)
    if not mutants:
        parser.error(f"no mutant of {', '.join(options.words)}")
    ends = survey(mutants, options.jobs, options.limit)
    counts = Counter(end.what for end in ends)
    for end in ends:
        if end.what != KILLED:
            print(f"{end.what}: {end.mutant}: {end.mutant.file} {end.why}")
    print(", ".join(f"{count} {what.lower()}" for what, count in counts.items()))
    return int(set(counts) != {KILLED})


if __name__ == "__main__":
    sys.exit(main())
