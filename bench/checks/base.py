"""What all conformance checks share."""

from __future__ import annotations

import random
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np

from sims.base import Array


class CheckError(AssertionError):
    """A subject does not conform; the message says what was expected, what was found, and where to
    look.
    """


class NotApplicable(NamedTuple):
    """What a check returns that found nothing to check; it has neither passed nor failed.

    Attributes:
        reason: why it does not apply to the subject.
    """

    reason: str


Check = Callable[[Any], NotApplicable | None]
"""Raises `CheckError` where its subject does not conform."""


def require(condition: bool, expected: str, found: object, look: str) -> None:
    """Raise `CheckError` unless `condition` holds."""
    if not condition:
        raise CheckError(f"expected {expected}; found {found}; see {look}")


def same_bits(a: Array, b: Array) -> bool:
    """Whether two arrays agree in shape and in every bit, NaN included."""
    return a.shape == b.shape and a.tobytes() == b.tobytes()


@contextmanager
def global_random_state_untouched(look: str) -> Iterator[None]:
    """Raise `CheckError` if the block draws from, or seeds, the generators of `random`, numpy or
    (if loaded) torch.

    They are put into a state of their own first, so that seeding with a usual number shows, and
    back afterwards.
    """
    python = random.getstate()
    legacy = np.random.get_state()  # noqa: NPY002 - it is what must not change
    # A method that seeds with 0 or 42 would leave these unchanged only by coming upon two primes.
    random.seed(82_589_933)
    np.random.seed(30_402_457)  # noqa: NPY002
    before = _random_states()
    try:
        yield
        after = _random_states()
    finally:
        random.setstate(python)
        np.random.set_state(legacy)  # noqa: NPY002
    touched = [name for name in before if before[name] != after[name]]
    require(not touched, "global random state left alone", f"changed: {', '.join(touched)}", look)


def _random_states() -> dict[str, object]:
    legacy: Any = np.random.get_state(legacy=True)  # noqa: NPY002
    states: dict[str, object] = {
        "random": random.getstate(),
        "numpy": (legacy[1].tobytes(), *legacy[2:]),
    }
    if "torch" in sys.modules:
        states["torch"] = sys.modules["torch"].random.get_rng_state().numpy().tobytes()
    return states
