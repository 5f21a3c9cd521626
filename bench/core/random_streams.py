"""Random generators derived from names, so that results are reproducible on every machine."""

from __future__ import annotations

import hashlib

import numpy as np
from numpy.typing import NDArray


def make_rng(*names: str | int) -> np.random.Generator:
    """Return the random generator of some names, equal in every process and on every machine.

    The names are everything that the stream depends on. The stream of a target does not depend on
    the tuner, for example, so all tuners get the same target.
    """
    return np.random.default_rng(make_seed_words(*names))


def make_seed_words(*names: str | int) -> NDArray[np.uint32]:
    """Return the seed (8,) of the generator of some names; see `make_rng`."""
    # The separator is in no name, so that ("a", "bc") and ("ab", "c") give different streams.
    text = "\x1f".join(str(name) for name in names)
    # Python's own hash differs between processes.
    digest = hashlib.sha256(text.encode()).digest()
    return np.frombuffer(digest, dtype=np.uint32)
