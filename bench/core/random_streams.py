"""Random generators derived from names, and from the secret salt from which targets are drawn.

No tuner knows the salt. Its hash is published before the first run (commitment), and the salt is
revealed after the last. A public or empty salt gives the random streams of the published
experiments, which everybody can reproduce.
"""

from __future__ import annotations

import hashlib
import re
import secrets

import numpy as np
from numpy.typing import NDArray

from sims.core.simulator import InputError


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


PUBLIC_SALT = "public"
"""Salt of targets that everybody can reproduce."""
_HASH_PATTERN = re.compile(r"[0-9a-f]{64}$")
MAX_SALT_LENGTH = 1000
"""Maximum length of a salt in characters."""


def generate_salt() -> str:
    """Return a new random salt of 128 bits."""
    return secrets.token_hex(16)


def compute_commitment(salt: str) -> str:
    """Return the SHA-256 of a salt, which commits to the salt without revealing it."""
    return hashlib.sha256(salt.encode()).hexdigest()


def check_commitment(subject: str, salt: str, committed: str) -> None:
    """Raise an error if a salt does not match its commitment.

    Args:
        subject: name of the experiment, for messages.
        salt: the salt; may be empty.
        committed: SHA-256 of the salt; empty if there is no commitment.

    Raises:
        InputError: the salt is too long, the commitment is not a hash, or both do not match.
    """
    if len(salt) > MAX_SALT_LENGTH:
        raise InputError(
            f"{subject}: expected a salt of up to {MAX_SALT_LENGTH} characters, found {len(salt)}"
        )
    if committed and not _HASH_PATTERN.match(committed):
        raise InputError(
            f"{subject}: salt_sha256: expected 64 hexadecimal digits, found {committed!r:.80}"
        )
    if committed and salt and compute_commitment(salt) != committed:
        raise InputError(
            f"{subject}: its salt has SHA-256 {compute_commitment(salt)}, expected the "
            f"committed "
            f"{committed}; one of the two was changed"
        )


class TargetStreams:
    """Random streams of one target.

    With a secret salt each quantity is drawn from its own stream. A quantity that a tuner knows,
    such as its start, therefore gives no information about another one. With a public salt there is
    one stream for all quantities, as in the published experiments.
    """

    def __init__(self, salt: str, *names: str | int) -> None:
        """Prepare the streams; `names` are the experiment, then the range and number of the target.

        `_one` is the stream that all quantities share when the salt is public.

        Args:
            salt: salt of the comparison.
            names: names of the target: experiment, range and number.
        """
        self._salt, self._names = salt, names
        self._public = salt in ("", PUBLIC_SALT)
        experiment, *target_names = names
        self._one = make_rng(experiment, "target", *target_names)

    def get_stream(self, quantity: str) -> np.random.Generator:
        """Return the random generator of one quantity; public salts share one generator for all."""
        return self._one if self._public else self._make_salted_rng(quantity)

    def get_held_out_stream(self, scenario: int) -> np.random.Generator:
        """Return the random generator of a held-out scenario."""
        if self._public:
            return make_rng(*self._names, "held-out", scenario)
        return self._make_salted_rng("held-out", scenario)

    def _make_salted_rng(self, *what: str | int) -> np.random.Generator:
        return make_rng("salt", self._salt, *self._names, *what)
