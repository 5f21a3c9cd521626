"""The models of a recording: each a set of effects with its fit, its likelihood and its merit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from bench.gap.model.base_fit import HORIZONS
from bench.gap.model.fit import Fit, Fitter, Start, prior_of
from bench.gap.model.noise import Likelihood, Noise, likelihood
from bench.gap.model.world import Mask, World
from sims.base import Array

Names = tuple[str, ...]

SIFTED = (12, 8)
"""Of models that are fitted with patience so many go on from each horizon to the next."""


@dataclass(frozen=True)
class Model:
    """A fitted model and its merit.

    Attributes:
        fit: the fit.
        likelihood: of its residual.
        merit: twice the log likelihood less the log of the number of samples for each parameter and
            initial state that the data fix (G. Schwarz, Ann. Stat. 6(2), 461, 1978,
            doi:10.1214/aos/1176344136); for an effect with many shapes, less what the best of them
            gains by chance.
    """

    fit: Fit
    likelihood: Likelihood
    merit: float

    @property
    def names(self) -> Names:
        """Its effects."""
        return self.fit.effects


@dataclass
class Models:
    """The models of one recording that have been fitted, by their effects.

    Attributes:
        world: the runs for fitting.
        noise: of the sensors.
        frozen: parameters that the data do not touch.
        rng: draws surrogates.
        stated: (C,) whether the recording states the noise of each channel.
        models: what was fitted.
        chances: what each effect gains by chance about the base model.
    """

    world: World
    noise: Noise
    frozen: frozenset[int]
    rng: np.random.Generator
    stated: Mask
    models: dict[frozenset[str], Model] = field(default_factory=dict)
    chances: dict[str, float] = field(default_factory=dict)

    @property
    def seen(self) -> Mask:
        """(R, T, C) samples that there are."""
        return np.isfinite(self.world.observed)

    def residual(self, fit: Fit) -> Array:
        """(R, T, C) observed less simulated, zero where nothing was seen."""
        residual: Array = np.where(self.seen, self.world.observed - fit.simulated, 0.0)
        return residual

    def enter(self, fit: Fit) -> Model:
        """Take a fit into account; the better of two fits of the same effects is kept."""
        free = fit.free.size + freedom(self.world, fit, self.noise)
        found = likelihood(self.residual(fit), self.seen, free) if np.isfinite(fit.cost) else _LOST
        merit = found.value - free * self._price - sum(self._chance(name) for name in fit.effects)
        model, key = Model(fit, found, merit), frozenset(fit.effects)
        if key not in self.models or merit > self.models[key].merit:
            self.models[key] = model
            self.replaced(key)
        return self.models[key]

    def replaced(self, key: frozenset[str]) -> None:
        """Called when a model has taken the place of another."""

    @property
    def _price(self) -> float:
        """What each number that the data fix costs a model: the log of the number of samples."""
        return float(np.log(max(int(self.seen.sum()), 2)))

    def _chance(self, name: str) -> float:
        """What an effect costs beside that: its shapes are tried by the dozen, and the best of them
        gains by chance.
        """
        slot = self.world.slots[name]
        return float(max(self.chances.get(name, 0.0) - (slot.stop - slot.start) * self._price, 0.0))

    def refit(
        self,
        starts: Sequence[Start],
        noise: Noise | None = None,
        patient: bool = False,
        race: bool = True,
    ) -> None:
        """Fit models from their starts and enter them.

        Args:
            starts: where to begin.
            noise: weighs the samples; the search's own if None.
            patient: fit the beginnings of the runs first, as the base model's fit does, and go on
                with the best.
            race: give up what falls far behind.
        """
        noise = noise or self.noise
        for (share, iterations), kept in zip(HORIZONS[:-1], SIFTED, strict=True) if patient else ():
            fits = Fitter(self.world, noise, self.frozen, share).fit(starts, iterations)
            starts = [fit.start() for fit in sorted(fits, key=lambda fit: fit.cost)[:kept]]
        best = self._reached(starts) if race and noise is self.noise else np.inf
        for fit in Fitter(self.world, noise, self.frozen).fit(starts, 24, race=race, reached=best):
            self.enter(fit)

    def _reached(self, starts: Sequence[Start]) -> float:
        """The least sum of squares of the models known that have no more effects than the largest
        of these.
        """
        most = max(len(start.effects) for start in starts)
        return min(
            (m.fit.cost for m in self.models.values() if 0 < len(m.names) <= most), default=np.inf
        )

    def best(self, size: int) -> Model | None:
        """The best model with so many effects."""
        there = [m for m in self.models.values() if len(m.names) == size]
        return max(there, key=lambda m: m.merit) if there else None

    def excess(self, model: Model) -> float:
        """RMS of what a model leaves in units of the noise floor, less the one that noise itself
        leaves.
        """
        left = self.residual(model.fit) / self.noise.sigma
        return float(np.sqrt(np.square(left[self.seen]).mean())) - 1.0

    def weights(self, model: Model) -> Noise:
        """Channels weigh by what the model leaves of them where that is more than their noise."""
        left = np.where(np.isfinite(model.likelihood.sigma), model.likelihood.sigma, 0.0)
        return Noise(np.maximum(self.noise.sigma, left), self.noise.phi)


def freedom(world: World, fit: Fit, noise: Noise) -> float:
    """How many initial states the data fix, all runs together: one that a model does not use gives
    it no freedom.
    """
    seen = np.isfinite(world.observed)
    states = (
        np.where(seen[..., None], fit.jacobian[..., fit.free.size :], 0.0) / noise.sigma[:, None]
    )
    columns = states.reshape(
        len(states), seen.shape[1] * seen.shape[2], states.shape[3]
    ) * prior_of(world)
    columns = np.where(world.known[:, None, :], 0.0, columns)
    powers = np.linalg.eigvalsh(np.matmul(columns.transpose(0, 2, 1), columns))
    return float((powers / (1.0 + np.maximum(powers, 0.0))).clip(0.0, 1.0).sum())


_LOST = Likelihood(-np.inf, np.zeros(0), np.zeros(0))
