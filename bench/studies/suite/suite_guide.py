"""Headline and decision guide of a suite, built from its tables.

No method has a sentence of its own: every name comes from a rank, so that the guide changes with
the results.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import pandas as pd

from bench.studies.suite.suite_tables import FREE, SuiteTables

GUIDE_COLUMNS = ["property", "value", "cells", "simulations", "best", "best_untrained"]
LOSS_CHECKPOINTS = (10, 100)
"""Numbers of simulations at which losses of the reference methods are listed."""
LOSS_FACTOR = 3.0
"""Ratio to the smallest error above which a method counts as losing."""
REFERENCE_TUNERS = ("hybrid", "tunenet")
"""Methods of this project, whose losses the page lists."""
RANK_TOLERANCE = 0.5
"""Difference from the lowest mean rank up to which the headline keeps a method."""
_SIGNIFICANCE = 0.05
"""Significance level of the tests against the best method."""


def build_headline(tables: SuiteTables) -> str:
    """Build one sentence that a practitioner can act on.

    Args:
        tables: tables of the suite.
    """
    ranks = tables.ranks[tables.ranks["training"] == FREE]
    mean_ranks = ranks.pivot(index="tuner", columns="simulations", values="mean_rank")
    untrained = mean_ranks[~mean_ranks.index.isin(tables.get_trained_tuners())]
    best = join_segments(choose_segments(mean_ranks))
    best_untrained = join_segments(choose_segments(untrained))
    if best == best_untrained or untrained.empty:
        return f"Use {best}."
    return (
        f"If you can train on your simulator beforehand, use {best}. "
        f"Without training, use {best_untrained}."
    )


def choose_segments(means: pd.DataFrame) -> list[tuple[str, int]]:
    """Choose as few methods as possible, each near the lowest mean rank at its checkpoints.

    Args:
        means: mean ranks, a row per tuner, a column per number of simulations.

    Returns:
        Methods, each with the last number of simulations for which it is chosen.
    """
    is_near_best = means <= means.min() + RANK_TOLERANCE
    checkpoints = [int(str(k)) for k in means]
    segments, start = [], 0
    while start < len(checkpoints):
        segment_lengths = is_near_best.iloc[:, start:].cumprod(axis=1).sum(axis=1)
        longest = segment_lengths.index[segment_lengths == segment_lengths.max()]
        stop = start + int(segment_lengths.max())
        tuner = str(means.loc[longest, checkpoints[start:stop]].mean(axis=1).idxmin())
        segments.append((tuner, checkpoints[stop - 1]))
        start = stop
    return segments


def join_segments(segments: Sequence[tuple[str, int]]) -> str:
    """Describe which method is best up to which number of simulations.

    Args:
        segments: methods, each with its last number of simulations.

    Returns:
        For example ``hybrid up to 30 simulations, then least_squares``.
    """
    *first, (last, _) = segments
    words = [f"{name} up to {k} simulation{'' if k == 1 else 's'}" for name, k in first]
    return ", ".join([*words, f"then {last}" if words else last])


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
        significant = rows[(rows["p_holm"] < _SIGNIFICANCE) & (rows["best_better"] > 0.5)]
        undecided_tuners = [
            str(name) for name in rows["tuner"] if name not in set(significant["tuner"])
        ]
        if significant.empty:
            yield f"After {k}: none of the {len(rows)} differences from {best} is significant."
            continue
        count = f"{len(significant)} of {len(rows)}"
        text = f"After {k}: {best} is significantly better than {count} others"
        yield text + (f"; not decided: {', '.join(undecided_tuners)}." if undecided_tuners else ".")


def describe_losses(tables: SuiteTables) -> Iterator[str]:
    """Describe where the methods of this project lose, and to which method."""
    for tuner in REFERENCE_TUNERS:
        if tuner not in tables.suite.tuners:
            continue
        for k in (k for k in LOSS_CHECKPOINTS if k <= tables.suite.budget):
            losses = tables.find_losses(tuner, k, LOSS_FACTOR)
            count = len(tables.curves)
            if losses.empty:
                yield (
                    f"{tuner} is worse by a factor of {LOSS_FACTOR:g} in none of {count} cells "
                    f"after {k} simulations."
                )
                continue
            examples = ", ".join(
                f"{row.cell} ({row.winner}, {_format_ratio(float(row.ratio))})"  # type: ignore[arg-type]
                for row in losses.itertuples()
            )
            yield (
                f"{tuner} is worse by a factor of {LOSS_FACTOR:g} in {len(losses)} of {count} "
                f"cells after {k} simulations: {examples}."
            )


def _format_ratio(ratio: float) -> str:
    return f"{ratio:.2g}×" if ratio < 1e4 else "more than 10000×"
