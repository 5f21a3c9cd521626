"""Write a batch of recordings.

``python -m tests.simple_exam.make_recordings --kind single --system ball --count 20 --out DIR``.

With ``--each`` that many of every effect, else of whatever is drawn. Existing recordings are left
as they are.
"""

import argparse
import sys
from pathlib import Path

from bench.diagnosis_benchmark.case_generation.case_sampling import (
    CASE_KINDS,
    SYSTEMS,
    draw_case,
    write_case,
)
from bench.diagnosis_benchmark.case_generation.reference_simulation import (
    SIMULATORS,
    UNMODELLED_CAUSES,
)
from sims import effects as library


def candidates(kind, system):
    """Return the names of causes of this kind in this system; [None] for clean recordings."""
    if kind == "clean":
        return [None]
    return (
        list(UNMODELLED_CAUSES[system])
        if kind == "foreign"
        else sorted(library.list_effects_for(SIMULATORS[system].system))
    )


def main(arguments):
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kind", choices=CASE_KINDS, required=True)
    parser.add_argument("--system", choices=SYSTEMS, required=True)
    parser.add_argument("--effect", help="only this one")
    parser.add_argument("--count", type=int, default=10)
    parser.add_argument("--each", action="store_true", help="so many of every effect")
    parser.add_argument("--size", type=float)
    parser.add_argument("--seed", type=int, default=0, help="of the first")
    parser.add_argument("--out", type=Path, required=True)
    given = parser.parse_args(arguments)
    given.out.mkdir(parents=True, exist_ok=True)
    names = (
        [given.effect]
        if given.effect
        else candidates(given.kind, given.system)
        if given.each
        else [None]
    )
    for name in names:
        made = 0
        for seed in range(
            given.seed, given.seed + 3 * given.count
        ):  # Cases that the sensors cannot show are drawn again.
            item = (
                draw_case(given.kind, given.system, seed, name, given.size)
                if made < given.count
                else None
            )
            if item is None:
                continue
            made += 1
            if not (given.out / f"{item.name}.csv").exists():
                write_case(item, given.out)
            print(
                f"{item.name}: size {item.size:.2f}, {item.noise} noise, {item.source}, "
                f"{item.effects}",
                flush=True,
            )
        if made < given.count:
            print(
                f"{given.system} {name or given.kind}: {made} of {given.count}, the others cannot "
                "show",
                flush=True,
            )


if __name__ == "__main__":
    main(sys.argv[1:])
