"""What targets are drawn from: a salt that no tuner knows, committed by its hash before the first
run and revealed after the last.

A public salt (or none) gives the streams of the published experiments, which everybody can draw.
"""

from __future__ import annotations

import hashlib
import re
import secrets

import numpy as np

from bench.problem.seeds import rng_for
from sims.base import InputError

PUBLIC = "public"
"""The salt of targets that everybody can draw."""
_HASH = re.compile(r"[0-9a-f]{64}$")
LONGEST = 1000
"""Characters of a salt."""


def fresh() -> str:
    """A salt that nobody can guess: 128 random bits."""
    return secrets.token_hex(16)


def commitment(salt: str) -> str:
    """The SHA-256 of a salt, which says nothing of it and fits no other."""
    return hashlib.sha256(salt.encode()).hexdigest()


def check_commitment(who: str, salt: str, committed: str) -> None:
    """Refuse a salt that is not the one that was committed.

    Raises:
        InputError: it is not, or the commitment is none.
    """
    if len(salt) > LONGEST:
        raise InputError(f"{who}: expected a salt of up to {LONGEST} characters, found {len(salt)}")
    if committed and not _HASH.match(committed):
        raise InputError(
            f"{who}: salt_sha256: expected 64 hexadecimal digits, found {committed!r:.80}"
        )
    if committed and salt and commitment(salt) != committed:
        raise InputError(
            f"{who}: its salt has SHA-256 {commitment(salt)}, committed was {committed}; "
            "one of the two was changed"
        )


class Streams:
    """The random streams of one target.

    With a secret salt each thing is drawn from a stream of its own: what a tuner sees of one, such
    as its start, tells it nothing of another. The public streams are one, as they were published.

    Args:
        salt: of the comparison.
        names: of the target: experiment, range and number.
    """

    def __init__(self, salt: str, *names: str | int) -> None:
        self._salt, self._names = salt, names
        self._public = salt in ("", PUBLIC)
        experiment, *which = names
        self._one = rng_for(experiment, "target", *which)

    def of(self, what: str) -> np.random.Generator:
        """The stream from which one thing is drawn; public ones go on where the last stopped."""
        return self._one if self._public else self._secret(what)

    def held_out(self, scenario: int) -> np.random.Generator:
        """The stream of an unseen scenario."""
        if self._public:
            return rng_for(*self._names, "held-out", scenario)
        return self._secret("held-out", scenario)

    def _secret(self, *what: str | int) -> np.random.Generator:
        return rng_for("salt", self._salt, *self._names, *what)
