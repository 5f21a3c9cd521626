"""Headline and decision guide of a suite, built from its tables.

No method has a sentence of its own: every name comes from a rank, so that the guide changes with
the results.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from itertools import groupby

import pandas as pd

from bench.studies.suite.suite_tables import FREE, SuiteTables

GUIDE_COLUMNS = ["property", "value", "cells", "simulations", "best", "best_untrained"]
LOSS_CHECKPOINTS = (10, 100)
"""Numbers of simulations at which losses of the reference methods are listed."""
LOSS_FACTOR = 3.0
"""Ratio to the smallest error above which a method counts as losing."""
REFERENCE_TUNERS = ("hybrid", "tunenet")
"""Methods of this project, whose losses the page lists."""
_SIGNIFICANCE = 0.05
"""Significance level of the tests against the best method."""


def build_headline(tables: SuiteTables) -> str:
    """Build one sentence that a practitioner can act on.

    Args:
        tables: tables of the suite.
    """
    trained = join_segments(tables.checkpoints, lambda k: tables.find_best(k))
    untrained = join_segments(tables.checkpoints, lambda k: tables.find_best(k, trained=False))
    if trained == untrained:
        return f"Use {trained}."
    return (
        f"If you can train on your simulator beforehand, use {trained}. "
        f"Without training, use {untrained}."
    )


def join_segments(checkpoints: Sequence[int], choose: Callable[[int], str]) -> str:
    """Describe which method is best up to which number of simulations.

    Args:
        checkpoints: numbers of simulations.
        choose: best method after a number of simulations.

    Returns:
        For example ``hybrid up to 30 simulations, then least_squares``.
    """
    segments = [(name, list(ks)) for name, ks in groupby(checkpoints, key=choose)]
    if len(segments) == 1:
        return segments[0][0]
    words = []
    for number, (name, ks) in enumerate(segments):
        if number == len(segments) - 1:
            words.append(f"then {name}")
        else:
            words.append(f"{name} up to {ks[-1]} simulation{'' if ks[-1] == 1 else 's'}")
    return ", ".join(words)


def build_guide(tables: SuiteTables) -> pd.DataFrame:
    """Build the decision guide: the best method for each kind of problem and budget.

    Args:
        tables: tables of the suite.

    Returns:
        Columns `GUIDE_COLUMNS`: best of all methods, and best of those that need no training.
    """
    trained = tables.get_trained_tuners()
    lines = []
    rows = tables.profile
    overall = tables.ranks[tables.ranks["training"] == FREE]
    overall = overall.assign(property="all problems", value="")
    frame = pd.concat([overall[rows.columns], rows], ignore_index=True)
    for (name, value, k), group in frame.groupby(["property", "value", "simulations"], sort=False):
        group = group.sort_values("mean_rank", kind="stable")
        untrained = group[~group["tuner"].isin(trained)]
        # An equal rank goes to the method that is named first in the ranking.
        lines.append(
            (
                name,
                value,
                int(group["cells"].iloc[0]),
                k,
                group["tuner"].iloc[0],
                untrained["tuner"].iloc[0] if len(untrained) else "",
            )
        )
    return pd.DataFrame(lines, columns=GUIDE_COLUMNS)


def describe_tests(tables: SuiteTables) -> Iterator[str]:
    """Describe at each checkpoint from which methods the best one differs significantly."""
    for k in tables.checkpoints:
        rows = tables.pairs
        rows = rows[(rows["training"] == FREE) & (rows["simulations"] == k)]
        if rows.empty:
            continue
        best = str(rows["best"].iloc[0])
        better = rows[(rows["p_holm"] < _SIGNIFICANCE) & (rows["best_better"] > 0.5)]
        undecided = [str(name) for name in rows["tuner"] if name not in set(better["tuner"])]
        text = f"After {k}: {best} is significantly better than {len(better)} of {len(rows)} others"
        yield text + (f"; not decided: {', '.join(undecided)}." if undecided else ".")


def describe_losses(tables: SuiteTables) -> Iterator[str]:
    """Describe where the methods of this project lose, and to which method."""
    for tuner in REFERENCE_TUNERS:
        if tuner not in tables.suite.tuners:
            continue
        for k in (k for k in LOSS_CHECKPOINTS if k <= tables.suite.budget):
            losses = tables.find_losses(tuner, k, LOSS_FACTOR)
            count = len(tables.curves)
            if losses.empty:
                yield f"{tuner} loses in none of {count} cells after {k} simulations."
                continue
            named = ", ".join(
                f"{row.cell} ({row.winner}, {_format_ratio(float(row.ratio))})"  # type: ignore[arg-type]
                for row in losses.itertuples()
            )
            yield f"{tuner} loses in {len(losses)} of {count} cells after {k} simulations: {named}."


def _format_ratio(ratio: float) -> str:
    return f"{ratio:.2g}×" if ratio < 1e4 else "more than 10000×"
