"""Keep numeric warnings of simulators and tuners off the terminal."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np


@contextmanager
def numeric_warnings_silenced() -> Iterator[None]:
    """Silence NumPy's floating-point warnings and other RuntimeWarnings; also a decorator.

    A simulation that overflows is a valid result: its loss is infinite, and status and report say
    so. A warning for each of its time steps gives no further information.
    """
    with np.errstate(all="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        yield
