"""Suites with given error curves."""

import numpy as np
import pandas as pd

from bench.suite.suite_runs import (
    CELL_COLUMNS,
    RUN_COLUMNS,
    SKIPPED_COLUMNS,
    TRAINING_COLUMNS,
    SuiteRuns,
)

BUDGET = 100


def power_law(first, exponent):
    """Return the error curve first / k ** exponent, and 1 before the first simulation."""
    k = np.arange(BUDGET + 1)
    return np.where(k == 0, 1.0, first / np.maximum(k, 1) ** exponent)


def make_suite(curves, *, cells=None, targets=4, training=None, version="suite 1"):
    """Return a suite whose runs have these curves.

    Args:
        curves: by cell, by tuner, the errors after 0, 1, ... simulations. Targets differ by one per
            cent.
        cells: by cell, changed properties.
        targets: number of targets.
        training: training simulations by tuner.
        version: name and version.
    """
    rows, errors, described, costs = [], [], [], []
    for cell, by_tuner in curves.items():
        properties = {"parameters": 2, "tags": "low-noise", "range": "in"}
        properties |= (cells or {}).get(cell, {})
        described.append(
            {
                "cell": cell,
                "problem": cell.split()[0],
                "negligible_error": 1e-6,
                "metric": "param_error",
                "title": cell,
                "tests": "a test",
                "identifiable": "all",
                "suite": version,
                **properties,
            }
        )
        for tuner, curve in by_tuner.items():
            costs.append((cell, tuner, (training or {}).get(tuner, 0), 1.0))
            for target in range(targets):
                failed = bool(np.isinf(curve).all())
                rows.append((cell, tuner, f"in-{target:03d}", 0, BUDGET, 0.1, failed))
                errors.append(np.asarray(curve, dtype=float) * (1.0 + 0.01 * target))
    return SuiteRuns(
        pd.DataFrame(rows, columns=RUN_COLUMNS),
        np.array(errors),
        pd.DataFrame(described)[CELL_COLUMNS],
        pd.DataFrame(costs, columns=TRAINING_COLUMNS),
        pd.DataFrame(columns=SKIPPED_COLUMNS),
    )
