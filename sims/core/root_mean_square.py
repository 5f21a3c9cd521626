"""Root mean square of numbers."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sims.core.simulator import Array


def compute_rms(values: Array | Sequence[float]) -> float:
    """Compute the root mean square of all values; NaN if any is NaN."""
    return float(np.sqrt(np.mean(np.square(values))))
