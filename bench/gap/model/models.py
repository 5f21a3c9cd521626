"""The models of a recording: each a set of effects with its fit, its likelihood and its merit.

Of a model with log likelihood L that has k numbers fixed by n samples, the merit is

    M = 2 log L - k log n - Σ_e max(c_e - k_e log n, 0)                                          (1)

Without the last term this is the criterion of G. Schwarz (Ann. Stat. 6(2), 461, 1978,
doi:10.1214/aos/1176344136), turned over so that more is better. The last one is for effects e whose
shapes are tried by the dozen: c_e is what the best of them gains by chance, and k_e log n what its
coefficients have paid of that already.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from bench.gap.model.base_fit import HORIZONS
from bench.gap.model.fit import Fitter, prior_of
from bench.gap.model.noise import Likelihood, Mask, Noise, likelihood
from bench.gap.model.problem import Fit, Start
from bench.gap.model.world import World
from bench.problem.seeds import rng_for
from sims.base import Array

Names = tuple[str, ...]

SIFTED = (12, 8)
"""Of models that are fitted with patience so many go on from each horizon to the next."""
STEPS = 24
"""Steps of each fit, at most."""
LEAST = 1e-3
"""Share of a channel's noise that it is taken to have at least."""
ROUNDS = 4
"""Fits of the model that is told, at most, each weighed by what the one before has left."""
AGAIN = 3.0
"""Merit gained by one of them with which another is worth its while."""
MIMICRY = 1.2
"""A fit that is weighed by what the one before has left may leave so many times the squares, as
noise that remembers has it; one that leaves more was pulled away by what is no noise.
"""
LARGEST_DRAWN = 2**62
"""Whole numbers below it tell streams of random numbers apart."""
_SIZES = {
    0: ("the base model", "the base model"),
    1: ("one effect", "single effects"),
    2: ("one pair of effects", "pairs of effects"),
    3: ("one set of three effects", "sets of three effects"),
}
"""One and several models with this number of effects, as the display of progress names them."""
FEWEST = 2
"""Samples that there are taken to be at least: the logarithm of one prices nothing."""


@dataclass(frozen=True)
class Model:
    """A fitted model and its merit.

    Attributes:
        fit: the fit.
        likelihood: of its residual.
        merit: (1); the numbers that it counts are parameters, coefficients, and the initial states
            that the data fix.
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
        rng: what all that is drawn follows from.
        stated: (C,) whether the recording states the noise of each channel.
        models: what was fitted.
        chances: what each effect gains by chance about the base model.
        derived: fits whose derivatives were taken again from both sides, each with what it was.
    """

    world: World
    noise: Noise
    frozen: frozenset[int]
    rng: np.random.Generator
    stated: Mask
    models: dict[frozenset[str], Model] = field(default_factory=dict)
    chances: dict[str, float] = field(default_factory=dict)
    derived: dict[int, tuple[Fit, Fit]] = field(default_factory=dict)
    _drawn: int = field(init=False, repr=False)

    def __post_init__(self) -> None:
        self._drawn = int(self.rng.integers(LARGEST_DRAWN))

    def drawing(self, question: str, names: Iterable[str] = ()) -> np.random.Generator:
        """The random numbers of a question about a model with these effects: the same whenever it
        is asked, so that an answer does not hang on what was asked before.
        """
        return rng_for(self._drawn, question, *sorted(names))

    @property
    def seen(self) -> Mask:
        """(R, T, C) samples that there are."""
        return np.isfinite(self.world.observed)

    def residual(self, fit: Fit) -> Array:
        """(R, T, C) observed less simulated, zero where nothing was seen."""
        left = self.world.observed - fit.simulated
        residual: Array = np.where(self.seen, left, 0.0)
        return residual

    def enter(self, fit: Fit) -> Model:
        """Take a fit into account; the better of two fits of the same effects is kept."""
        return self._entered(self._of(fit))

    def _entered(self, model: Model) -> Model:
        """The better of a model and the one of the same effects that there is."""
        # the order in which effects were added makes no difference
        key = frozenset(model.names)
        if key not in self.models or model.merit > self.models[key].merit:
            self.models[key] = model
            self.replaced(key)
        return self.models[key]

    def _of(self, fit: Fit) -> Model:
        """A fit with its likelihood and its merit."""
        free = fit.free.size + freedom(self.world, fit, self.noise)
        # one that could not be simulated is entered, too: it need not be tried again
        found = _LOST
        if np.isfinite(fit.cost):
            found = likelihood(self.residual(fit), self.seen, free)
        chance = sum(self.chance_of(name) for name in fit.effects)
        merit = found.value - free * self.price - chance  # (1)
        return Model(fit, found, merit)

    def with_sensitivities(self, start: Start) -> Start:
        """Return a start with the derivatives that are known near it."""
        return start

    def force_of_any_shape(self, model: Model) -> tuple[float, str] | None:  # noqa: ARG002
        """Return the p-value of the best force of any shape, and what it follows; None where that
        is asked by simulation.
        """
        return None

    def replaced(self, key: frozenset[str]) -> None:
        """Called when a model has taken the place of another."""

    @property
    def price(self) -> float:
        """What each number that the data fix costs a model, the log n of (1)."""
        count = int(self.seen.sum())
        return float(np.log(max(count, FEWEST)))

    def chance_of(self, name: str) -> float:
        """What an effect costs beside that, its part of the last term of (1)."""
        slot = self.world.slots[name]
        # few shapes gain less by chance than their coefficients pay
        paid = (slot.stop - slot.start) * self.price
        return float(max(self.chances.get(name, 0.0) - paid, 0.0))

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
        watch = self.world.watch
        watch.look(f"refit of {_listed(starts)}")
        noise = noise or self.noise
        starts = [self.with_sensitivities(start) for start in starts]
        if patient:
            starts = self._sifted(starts, noise)
        # sums of squares by other weights are not to be compared
        racing = race and noise is self.noise
        reached = self._reached(starts) if racing else np.inf
        fitter = Fitter(self.world, noise, self.frozen)
        watch.stage(_fitting(starts), len(starts))
        for fit in fitter.fit(starts, STEPS, race=race, reached=reached, finished=watch.advance):
            self.enter(fit)
        # One that was left off is kept, and not judged.
        watch.check()
        self._report_best()

    def fit_all(self, starts: Sequence[Start]) -> list[Model]:
        """Fit models from their starts side by side, and return the best fits of their effects."""
        self.refit(starts, race=False)
        return [self.models[frozenset(start.effects)] for start in starts]

    def fit_one(self, start: Start) -> Model:
        """Fit a model from a start, and return the best fit of its effects."""
        return self.fit_all([start])[0]

    def _report_best(self) -> None:
        """Report the model with the highest merit, and the share of the gap that it closes."""
        base = self.models.get(frozenset())
        best = max(self.models.values(), key=lambda model: model.merit, default=base)
        if base is None or best is None or not best.names:
            return
        gap = self.excess(base)
        if gap > 0 and np.isfinite(gap):
            share = 1.0 - max(self.excess(best), 0.0) / gap
            self.world.watch.found(best.names, max(share, 0.0))

    def exact(self, model: Model) -> Model:
        """The model with derivatives of its own, where its fit has ended with those of a point
        nearby; they are found once.
        """
        if model.fit.own or not np.isfinite(model.fit.cost):
            return model
        known = self.models.get(frozenset(model.names))
        if known is not None and known.fit.own and known.fit.theta is model.fit.theta:
            return known
        fitter = Fitter(self.world, self.noise, self.frozen)
        (fit,) = fitter.fit([model.fit.start()], iterations=0)
        result = replace(model, fit=replace(model.fit, jacobian=fit.jacobian, own=True))
        if known is model:
            self.models[frozenset(model.names)] = result
        return result

    def to_the_end(self, model: Model) -> Model:
        """The model fitted until nothing is left to gain, with what it leaves for its noise.

        Where that remembers, generalised least squares is what intervals are for; and far from the
        data its other weights lead on where the fit was caught, so that it is done again until they
        change nothing. What it may not is leave clearly more: where structure is left it would
        rather have that smooth than small.
        """
        self.world.watch.stage("refining the model")
        squares = Fitter(self.world, self.noise).cost
        for _ in range(ROUNDS):
            left = model.likelihood
            if not np.isfinite(model.fit.cost):
                break
            # A channel without samples has no noise, and the weight of one without noise no end.
            sigma = np.where(np.isfinite(left.sigma), left.sigma, self.noise.sigma)
            noise = Noise(np.maximum(sigma, LEAST * self.noise.sigma), left.phi)
            fitter = Fitter(self.world, noise, self.frozen, exact=True)
            (fit,) = fitter.fit([model.fit.start()], STEPS)
            if self.world.watch.left():
                break
            other = self._of(replace(fit, cost=squares(fit)))
            if other.fit.cost > MIMICRY * squares(model.fit):
                break
            gain = other.merit - model.merit
            if gain < AGAIN:
                if gain > 0:
                    # So near, what was scored about it holds as ever.
                    model = self.models[frozenset(other.names)] = other
                break
            model = self._entered(other)
        return model

    def _sifted(self, starts: Sequence[Start], noise: Noise) -> list[Start]:
        """Where the best stand after all horizons but the last, which is the whole of the runs."""
        begun = list(starts)
        # patience takes every candidate along: only so many may cost a fit of the whole
        for horizon, count in zip(HORIZONS[:-1], SIFTED, strict=True):
            fitter = Fitter(self.world, noise, self.frozen, horizon.share)
            fits = fitter.fit(begun, horizon.iterations)
            fits.sort(key=lambda fit: fit.cost)
            begun = [fit.start() for fit in fits[:count]]
        return begun

    def _reached(self, starts: Sequence[Start]) -> float:
        """The least sum of squares of the models known that have no more effects than the largest
        of these.
        """
        most = max(len(start.effects) for start in starts)
        known = self.models.values()
        costs = [m.fit.cost for m in known if 0 < len(m.names) <= most]
        return min(costs, default=np.inf)

    def best(self, size: int) -> Model | None:
        """The best model with so many effects."""
        known = self.models.values()
        models = [m for m in known if len(m.names) == size]
        return max(models, key=lambda m: m.merit) if models else None

    def excess(self, model: Model) -> float:
        """RMS of what a model leaves in units of the noise floor, less the one that noise itself
        leaves.
        """
        scaled = self.residual(model.fit) / self.noise.sigma
        squares = np.square(scaled[self.seen])
        return float(np.sqrt(squares.mean())) - 1.0

    def weights(self, model: Model) -> Noise:
        """Channels weigh by what the model leaves of them where that is more than their noise."""
        sigma = model.likelihood.sigma
        # a channel without samples has no sigma, and its weight does not matter
        left = np.where(np.isfinite(sigma), sigma, 0.0)
        return Noise(np.maximum(self.noise.sigma, left), self.noise.phi)


def _listed(starts: Sequence[Start]) -> str:
    """The models that begin there, in a few words."""
    names = list(dict.fromkeys(" + ".join(start.effects) or "the base model" for start in starts))
    more = f" and {len(names) - 1} more" if len(names) > 1 else ""
    return f"{names[0]}{more}" if names else "nothing"


def _fitting(starts: Sequence[Start]) -> str:
    """Name the stage that fits these models, by their number of effects."""
    size = max((len(start.effects) for start in starts), default=0)
    one, several = _SIZES.get(size, (f"set of {size} effects", f"sets of {size} effects"))
    return f"fitting {one if len(starts) == 1 else several}"


def freedom(world: World, fit: Fit, noise: Noise) -> float:
    """How many initial states the data fix, all runs together: one that a model does not use gives
    it no freedom.

    The effective degrees of freedom of ridge regression (T. Hastie, R. Tibshirani, J. Friedman, The
    Elements of Statistical Learning, 2nd ed., section 3.4.1). With B_i the derivatives of run i by
    its initial state in units of the noise, π its prior, and λ_ij the eigenvalues of π B_iᵀ B_i π,

        f = Σ_ij λ_ij / (1 + λ_ij)                                                               (2)
    """
    seen = np.isfinite(world.observed)
    states = fit.jacobian[..., fit.free.size :]
    counted = np.where(seen[..., None], states, 0.0)
    scaled = counted / noise.sigma[:, None]
    # written out, as -1 is ambiguous where there are no states
    runs, length, channels, size = scaled.shape
    columns = scaled.reshape(runs, length * channels, size) * prior_of(world)
    # a state that is known has no freedom
    columns = np.where(world.known[:, None, :], 0.0, columns)
    normal = np.matmul(columns.transpose(0, 2, 1), columns)
    eigenvalues = np.linalg.eigvalsh(normal)
    # rounding may put one a little below zero
    fixed = eigenvalues / (1.0 + np.maximum(eigenvalues, 0.0))  # (2)
    return float(fixed.clip(0.0, 1.0).sum())


_LOST = Likelihood(-np.inf, np.zeros(0), np.zeros(0))
"""Of a model that could not be simulated."""
