"""Damage the raw folder of each log format: ``python -m tests.bench.logs.damaged_logs [--count N]
[FORMAT ...]``.

`simgap import` must read a damaged folder or refuse it with one line, write nothing then, and not
hang. Prints a line for each format; exits with 1 if there is another answer.
"""

from __future__ import annotations

import argparse
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import numpy as np

import simgap
from sims.core.simulator import InputError
from tests.bench.logs.log_writers import OPTIONS, WRITERS, write_folder

COUNT = 2000  # Damaged folders of each format.
LIMIT_SECONDS = 60  # Longest time of an import.
SAMPLES = 40
INSERTED = (
    b"\x00",
    b"\xff",
    b"nan",
    b",",
    b"\n",
    b'"',
    b"[",
    b"1e999",
    b"-",
    b"\xc3(",
    b";;",
    b"{",
)


def damage(data, rng):
    """Return bytes that are cut, overwritten, doubled, or have other bytes in between."""
    data = bytearray(data)
    for _ in range(rng.integers(1, 4)):
        first = int(rng.integers(0, max(len(data), 1)))
        length = int(rng.integers(1, max(len(data) // 4, 2)))
        act = rng.integers(0, 7)
        if act == 0:
            del data[first:]
        elif act == 1:
            del data[first : first + length]
        elif act == 2:
            data[first:first] = data[first : first + length]
        elif act == 3:
            data[first:first] = INSERTED[rng.integers(0, len(INSERTED))]
        elif act == 4:
            data[first : first + 8] = rng.integers(0, 256, 8, dtype=np.uint8).tobytes()
        elif act == 5:
            data[first : first + length] = bytes(min(length, len(data) - first))
        else:
            for place in rng.integers(0, max(len(data), 1), 6):
                if data:
                    data[place] = rng.integers(0, 256)
    return bytes(data)


def answer_to_damage(kind, seed, folder, source=None):
    """Import a damaged folder; return the error message, or None if it was read.

    Args:
        kind: Format of the logs.
        seed: Seed of the damage.
        folder: Folder to write, which does not exist yet.
        source: Folder with undamaged logs; written first if None.
    """
    rng = np.random.default_rng([seed, 5])
    if source is None:
        write_folder(folder, kind, runs=2, count=SAMPLES)
    else:
        shutil.copytree(source, folder)
    files = sorted(path for path in (folder / "logs").rglob("*") if path.is_file())
    path = files[rng.integers(0, len(files))]
    path.write_bytes(damage(path.read_bytes(), rng))
    options = {"rate": 100.0} if kind == "robomimic" else {}
    if "--position-unit" in OPTIONS.get(kind, ()):
        options["position_unit"] = "deg"
    # A file that is named must be readable; of a folder, it may be left out.
    named = path if path.parent.name == "logs" else folder / "logs"
    before = sorted(folder.rglob("*"))
    try:
        simgap.import_logs(named, folder / "arm.xml", folder / "log.toml", **options)
    except InputError as error:
        message = str(error)
        assert "\n" not in message, message
        assert sorted(folder.rglob("*")) == before, "something was written"
        return message
    return None


def main(arguments):
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("formats", nargs="*", metavar="FORMAT", help=f"of {', '.join(WRITERS)}")
    parser.add_argument("--count", type=int, default=COUNT)
    options = parser.parse_args(arguments)
    faults = 0
    signal.signal(signal.SIGALRM, _stop)
    for kind in options.formats or WRITERS:
        answers, begun = Counter(), time.process_time()
        with tempfile.TemporaryDirectory() as place:
            source = Path(place) / "sound"
            write_folder(source, kind, runs=2, count=SAMPLES)
            for seed in range(options.count):
                folder = Path(place) / "damaged"
                signal.alarm(LIMIT_SECONDS)
                try:
                    message = answer_to_damage(kind, seed, folder, source)
                    answers["read" if message is None else "refused"] += 1
                except Exception as error:
                    answers["fault"] += 1
                    print(f"{kind}, seed {seed}: {type(error).__name__}: {error}", flush=True)
                finally:
                    signal.alarm(0)
                    shutil.rmtree(folder, ignore_errors=True)
        faults += answers["fault"]
        seconds = time.process_time() - begun
        print(f"{kind}: {options.count} folders {dict(answers)}, {seconds:.0f} s", flush=True)
    return int(faults > 0)


def _stop(*_):
    raise TimeoutError(f"no answer in {LIMIT_SECONDS} s")


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
