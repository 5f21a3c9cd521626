"""One learner for targets as clean as the simulations, and one for targets from a sensor."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

import numpy as np

from methods.base import Array, Task
from methods.learning.pair_inputs import roughness
from methods.learning.reader import Reading
from methods.learning.rehearsal import Rehearsal

_CALM = 2.0
"""A target is as clean as simulations up to this many times their own roughness."""
_HEARD = 50.0
"""A target counts as noisy from so small a part (one in 50) of the noise prepared for."""


class Stored(Protocol):
    """What was learned, and can be kept."""

    def state(self) -> dict[str, Array]:
        """Everything as plain arrays."""
        ...


Learner = TypeVar("Learner", bound=Stored)
Learn = Callable[[str, Rehearsal, "Array | None"], Learner]
"""Learns from the simulations of a stage, to which noise of standard deviations (C,) was added."""


@dataclass(frozen=True)
class Prepared(Generic[Learner]):
    """A network for targets as clean as the simulations, and one for targets from a sensor.

    The two read different things of an observation: without noise, single samples that follow the
    parameters exactly even far outside the training range; with noise, what many samples say
    together.

    Attributes:
        clean: trained on the simulations as they are; the noisy one again where no target is as
            clean.
        noisy: trained on the same simulations with noise added; the clean one again where there is
            none.
        limit: (C,) roughness above which a target counts as noisy, SI units.
    """

    clean: Learner
    noisy: Learner
    limit: Array

    @classmethod
    def train(
        cls, data: Rehearsal, rng: np.random.Generator, reading: Reading, learn: Learn[Learner]
    ) -> Prepared[Learner]:
        """Train both networks on the same simulations; only one where `reading` prepares for one
        kind of target.
        """
        spread = data.flat.std(axis=(0, 1))
        own = roughness(data.flat, data.lengths).max(axis=0)
        limit = _CALM * own + reading.noise / _HEARD * spread

        def noisy() -> Learner:
            noise = reading.noise * spread
            return learn("noisy", data.spoilt(noise, rng), noise)

        # a sensor whose errors last looks as smooth as a clean target: then there is one network
        if reading.noise and not reading.clean:
            network = noisy()
            return cls(network, network, limit)
        clean = learn("clean", data, None)
        return cls(clean, noisy() if reading.noise else clean, limit)

    def suited(self, task: Task) -> Learner:
        """The network for a target, chosen by the target's roughness."""
        rough = roughness(task.observed[None], task.lengths)[0]
        return self.noisy if (rough > self.limit).any() else self.clean

    def state(self) -> dict[str, Array]:
        """Everything as plain arrays."""
        arrays = {f"clean.{name}": array for name, array in self.clean.state().items()}
        if self.noisy is not self.clean:
            arrays |= {f"noisy.{name}": array for name, array in self.noisy.state().items()}
        return arrays | {"limit": self.limit}

    @classmethod
    def restored(
        cls,
        state: dict[str, Array],
        reading: Reading,
        restore: Callable[[dict[str, Array]], Learner],
    ) -> Prepared[Learner]:
        """The inverse of `state`.

        Raises:
            ValueError: arrays of other names or shapes, or numbers that are not finite.
        """
        parts: dict[str, dict[str, Array]] = {"clean": {}, "noisy": {}, "limit": {}}
        for name, array in state.items():
            part, _, rest = name.partition(".")
            if part not in parts:
                raise ValueError(f"expected arrays of {sorted(parts)}, found {name}")
            parts[part][rest] = array
        limit = np.array(parts["limit"].get("", np.nan), dtype=np.float64)
        if limit.ndim != 1 or not np.isfinite(limit).all():
            raise ValueError(
                "array limit: expected finite numbers of shape (channels,), "
                f"found shape {limit.shape}"
            )
        two = bool(reading.noise) and reading.clean
        if two != bool(parts["noisy"]):
            raise ValueError(
                f"expected {'two networks' if two else 'one network'}, found another number of them"
            )
        clean = restore(parts["clean"])
        noisy = restore(parts["noisy"]) if two else clean
        return cls(clean, noisy, limit)


def heard(apart: Rehearsal, noise: Array | None) -> Rehearsal:
    """Held-out simulations as a network of this noise (C,) would meet them."""
    # noise of its own stream: what is learned is the same whether anybody looks
    return apart if noise is None else apart.spoilt(noise, np.random.default_rng(0))


def checked(arrays: dict[str, Array], expected: dict[str, tuple[int, ...]]) -> dict[str, Array]:
    """The arrays in the order of `expected`, which says their shapes by name.

    Raises:
        ValueError: arrays of other names or shapes, or numbers that are not finite.
    """
    if arrays.keys() != expected.keys():
        raise ValueError(f"expected arrays {sorted(expected)}, found {sorted(arrays)}")
    for name, shape in expected.items():
        if arrays[name].shape != shape or not np.isfinite(arrays[name]).all():
            raise ValueError(
                f"array {name}: expected finite numbers of shape {shape}, "
                f"found {arrays[name].shape}"
            )
    return {name: arrays[name] for name in expected}
