"""Long recordings, searched with all samples and with fewer: ``OMP_NUM_THREADS=1 python -m
tests.benchmarks.long_recordings [RECORDING.csv ...]``.

Processor time of explain on one core, both variants in turn, with the verdicts; for four simulated
recordings (3 runs of 8 s at 1 kHz) and for those given as arguments. Prints a table.
"""

import argparse
import tempfile
import time
from pathlib import Path

import numpy as np

from bench.diagnosis.explain import explain
from bench.diagnosis.search import subsampled_search
from tests.simulation_arguments import simulation_spec, write

SLIDER = {"system": "slider", "observe": ["x"], "inputs": ["u=steps:2:0.5"]}
LONG = {"runs": 3, "seconds": 8.0, "rate": 1000.0}
RECORDING_OPTIONS = {
    "clean": SLIDER | {"noise": ["x=0.002"], "seed": 1},
    "weak friction": SLIDER
    | {"noise": ["x=0.002"], "effects": ["friction.coulomb=0.004"], "seed": 2},
    "drag of a pendulum": {
        "system": "pendulum",
        "observe": ["q"],
        "noise": ["q=0.004"],
        "effects": ["drag.quadratic=0.0004"],
        "seed": 3,
    },
    "friction and delay": SLIDER
    | {
        "noise": ["x=0.005"],
        "effects": ["friction.coulomb=0.3", "input.delay=0.03"],
        "seed": 4,
    },
}


def explain_thinned(path, long):
    """Return processor seconds and the answer, if recordings are thinned from `long` samples."""
    usual = subsampled_search.MIN_SAMPLES_TO_THIN
    subsampled_search.MIN_SAMPLES_TO_THIN = long
    begin = time.process_time()
    try:
        verdict = explain(path).answer
    finally:
        subsampled_search.MIN_SAMPLES_TO_THIN = usual
    names = ", ".join(
        " or ".join([f"`{cause.effect}`", *map("`{}`".format, cause.alternatives)])
        for cause in verdict.causes
    )
    return time.process_time() - begin, f"{verdict.verdict} {names}".strip()


def row(name, path):
    """Return a row of the table."""
    whole, said = explain_thinned(path, np.inf)
    few, also = explain_thinned(path, subsampled_search.MIN_SAMPLES_TO_THIN)
    same = "the same" if also == said else also
    return f"| {name} | {whole:.1f} | {few:.1f} | {whole / few:.1f} | {said} | {same} |"


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("recordings", nargs="*", type=Path)
    recordings = parser.parse_args().recordings
    print("| recording | all samples, s | fewer, s | ratio | verdict | with fewer |")
    print("|---|---|---|---|---|---|", flush=True)
    with tempfile.TemporaryDirectory() as folder:
        for number, (name, wish) in enumerate(RECORDING_OPTIONS.items()):
            path = Path(folder) / f"{number}.csv"
            write(simulation_spec(**wish, **LONG), path)
            # Run once before measuring, so that imports and tracing are not counted.
            if not number:
                explain(path)
            print(row(name, path), flush=True)
    for path in recordings:
        print(row(f"{path.parent.name}/{path.stem}", path), flush=True)


if __name__ == "__main__":
    main()
