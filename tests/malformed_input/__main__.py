"""All twelve thousand malformed inputs: ``python -m tests.malformed_input [--cases N] [KIND ...]``.

Each fault is said once, by where it was raised, with a case that shows it; exits with 1 if there
are any.
"""

from __future__ import annotations

import argparse
import shutil
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

from tests.malformed_input.input_strategies import SHARES, made, share, strategies
from tests.malformed_input.malformed_case import FaultError, tried
from tests.malformed_input.shortened_work import environment, shortened
from tests.malformed_input.valid_input import bases


class Round:
    """Run the cases of one kind and collect their faults, one for each place in the code."""

    def __init__(self, kind, folder, ready):
        self._kind, self._place, self._ready = kind, folder / "place", ready
        self.codes, self.faults = Counter(), {}
        self.slowest = (0.0, ())

    def act(self, case):
        begun = time.monotonic()
        try:
            with shortened():
                self.codes[tried(case, self._place, self._ready).code] += 1
        except FaultError as fault:
            self.codes["fault"] += 1
            lines = str(fault).strip().splitlines()
            where = [line.strip() for line in lines if line.startswith("  File")][-1:]
            self.faults.setdefault((self._kind, *where, lines[-1][:60]), (case, str(fault)))
        finally:
            shutil.rmtree(self._place, ignore_errors=True)
        self.slowest = max(self.slowest, (time.monotonic() - begun, case.arguments))


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("kinds", nargs="*", metavar="KIND", help=f"of {', '.join(SHARES)}")
    parser.add_argument("--cases", type=int, default=sum(SHARES.values()))
    options = parser.parse_args()
    faults = {}
    with tempfile.TemporaryDirectory() as place, environment(Path(place) / "place"):
        folder = Path(place)
        ready = bases(folder)
        for kind, strategy in strategies(ready).items():
            if options.kinds and kind not in options.kinds:
                continue
            one, started = Round(kind, folder, ready), time.monotonic()
            made(strategy, share(kind, options.cases), one.act)
            seconds, arguments = one.slowest
            print(
                f"{kind}: {sum(one.codes.values())} cases {dict(one.codes)}, "
                f"{time.monotonic() - started:.0f} s; slowest {seconds:.1f} s {arguments}"[:300],
                flush=True,
            )
            faults |= one.faults
    for name, (case, fault) in faults.items():
        print(f"\n{name}\n{case.arguments}")
        for file, data in case.files.items():
            print(f"{file}: {data!r:.600}")
        print(fault[-1500:])
    print(f"{len(faults)} faults")
    return bool(faults)


if __name__ == "__main__":
    sys.exit(main())
