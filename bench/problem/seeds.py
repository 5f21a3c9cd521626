"""Random streams derived from names, so that the same command gives the same numbers anywhere."""

from __future__ import annotations

import hashlib

import numpy as np
from numpy.typing import NDArray


def rng_for(*names: str | int) -> np.random.Generator:
    """The generator that belongs to `names`, the same in every process and on every machine.

    A caller names what its stream depends on and nothing else: a target's stream has no tuner in
    it, so all tuners meet the same target.
    """
    return np.random.default_rng(stream_of(*names))


def stream_of(*names: str | int) -> NDArray[np.uint32]:
    """The seed (8,) of the generator that belongs to `names`; see `rng_for`."""
    # A separator that no name has: ("a", "bc") and ("ab", "c") are different streams.
    text = "\x1f".join(str(name) for name in names)
    # Python's own hash differs from process to process.
    digest = hashlib.sha256(text.encode()).digest()
    return np.frombuffer(digest, dtype=np.uint32)
