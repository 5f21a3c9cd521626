"""Forward selection: add one effect at a time, refitted with parameters and initial states.

A criterion decides when to stop. BIC (G. Schwarz, Ann. Stat. 6(2), 461, 1978,
doi:10.1214/aos/1176344136), with n samples and k numbers,

    BIC = n log(S / n) + k log n,    S the sum of squares in units of the noise               (1)

does not need the noise level; effects within 2 of the best are indistinguishable (R. E. Kass, A. E.
Raftery, JASA 90, 773, 1995). Chi squared uses the stated or estimated noise: a model is sufficient
if noise alone makes S as large in more than one of a hundred recordings (P. R. Bevington, D. K.
Robinson, Data Reduction and Error Analysis, chapter 11). Both assume white noise.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from bench.diagnoser import Answer, Case, Diagnoser, Named
from bench.diagnosers.evidence import Column, Evidence, columns_of, strongest
from bench.gap.causes.candidates import directions
from bench.gap.model.bounds import coefficient_bounds
from bench.gap.model.fit import Fitter
from bench.gap.model.problem import Fit, Start
from sims.base import Array

MOST = 3
"""Maximum number of effects."""
REFITTED = 8
"""Number of effects refitted per round: those with the best first-order prediction."""
STEPS = 15
"""Maximum number of iterations of a fit."""
CLOSED = 0.7
"""Minimum fraction of the gap that must be closed before its causes are named."""
LEVEL = 0.01
"""False-alarm probability."""
WITHIN = 6.63
"""Chi-squared difference up to which two models are indistinguishable: 1 %, one free parameter."""
BARELY = 2.0
"""BIC difference up to which two models are indistinguishable."""
SIGMAS = 1.96
"""Half width of a 95 % interval in standard errors."""


class Refit(NamedTuple):
    """Fitted model.

    Attributes:
        fit: the fit.
        squares: sum of squares of the residual, in units of the noise.
        numbers: number of fitted parameters, including initial states.
    """

    fit: Fit
    squares: float
    numbers: int


class _Forward(Diagnoser):
    """Base class of the forward selections."""

    def diagnose(self, case: Case) -> Answer:
        """Name the selected effects, with alternatives of equal quality."""
        evidence = Evidence(case)
        try:
            return self._selected(evidence)
        finally:
            evidence.close()

    def _selected(self, evidence: Evidence) -> Answer:
        samples = int(evidence.seen.sum())
        best = _entered(evidence, evidence.base.fit)
        first, rivals = best, list[Refit]()
        causes: list[tuple[str, tuple[str, ...]]] = []
        while len(causes) < MOST and not self.enough(best, samples):
            rivals = [_entered(evidence, fit) for fit in _extended(evidence, best.fit)]
            rivals = [one for one in rivals if np.isfinite(one.squares)]
            if not rivals:
                break
            rivals.sort(key=lambda one: self.value(one, samples))
            if self.value(rivals[0], samples) >= self.value(best, samples):
                break
            near = self.value(rivals[0], samples) + self.near
            alike = [one.fit.effects[-1] for one in rivals[1:] if self.value(one, samples) <= near]
            best = rivals[0]
            causes.append((best.fit.effects[-1], tuple(alike)))
        return self._answer(evidence, first, best, causes, samples)

    def _answer(
        self,
        evidence: Evidence,
        first: Refit,
        best: Refit,
        causes: Sequence[tuple[str, tuple[str, ...]]],
        samples: int,
    ) -> Answer:
        ends = _intervals(evidence, best)
        parameters = {n: e for n, e in ends.items() if "." not in n}
        chance = self.chance(first, samples)
        if not causes:
            verdict = "adequate" if self.enough(best, samples) else "unknown"
            return Answer(verdict, (), parameters, chance)
        floor = float(samples - best.numbers)
        gap = max(first.squares - floor, 1e-9)
        named = tuple(Named(name, others, _of(ends, name), chance) for name, others in causes)
        if not self.enough(best, samples) and (first.squares - best.squares) / gap < CLOSED:
            return Answer("unknown", (), parameters, chance)
        if not self.enough(best, samples):
            return Answer("partial", named, parameters, chance)
        open_sets = any(others for _, others in causes)
        return Answer("ambiguous" if open_sets else "named", named, parameters, chance)

    near: float

    @abstractmethod
    def value(self, one: Refit, samples: int) -> float:
        """Compute the criterion, which is minimised.

        Args:
            one: a fitted model.
            samples: number of samples.
        """

    @abstractmethod
    def enough(self, one: Refit, samples: int) -> bool:
        """Return whether a model is sufficient, so that the search can stop.

        Args:
            one: a fitted model.
            samples: number of samples.
        """

    @abstractmethod
    def chance(self, first: Refit, samples: int) -> float | None:
        """Compute the p-value of the base model under the hypothesis that nothing is missing.

        Args:
            first: the fitted base model.
            samples: number of samples.

        Returns:
            The p-value, or None if the criterion gives none.
        """


class ForwardBIC(_Forward):
    """Forward selection of refitted effects by BIC."""

    name = "forward-bic"
    near = BARELY

    def value(self, one: Refit, samples: int) -> float:
        """Compute BIC, equation (1).

        Args:
            one: a fitted model.
            samples: number of samples.
        """
        return float(samples * np.log(one.squares / samples) + one.numbers * np.log(samples))

    def enough(self, one: Refit, samples: int) -> bool:
        """Return False: BIC only compares models; the search continues while a model is better."""
        return False

    def chance(self, first: Refit, samples: int) -> float | None:
        """Return None: BIC gives no p-value."""
        return None

    def _answer(
        self,
        evidence: Evidence,
        first: Refit,
        best: Refit,
        causes: Sequence[tuple[str, tuple[str, ...]]],
        samples: int,
    ) -> Answer:
        ends = _intervals(evidence, best)
        parameters = {n: e for n, e in ends.items() if "." not in n}
        named = tuple(Named(name, others, _of(ends, name)) for name, others in causes)
        sets = any(others for _, others in causes)
        verdict = "ambiguous" if sets else "named" if named else "adequate"
        return Answer(verdict, named, parameters)


class ForwardChi2(_Forward):
    """Forward selection of refitted effects by chi squared, with stated or estimated noise."""

    name = "forward-chi2"
    near = WITHIN

    def value(self, one: Refit, samples: int) -> float:
        """Return the sum of squares."""
        return one.squares

    def enough(self, one: Refit, samples: int) -> bool:
        """Return whether the chi-squared p-value of the model is above `LEVEL`."""
        return self._chance(one, samples) > LEVEL

    def chance(self, first: Refit, samples: int) -> float | None:
        """Compute the chi-squared p-value of the base model."""
        return self._chance(first, samples)

    @staticmethod
    def _chance(one: Refit, samples: int) -> float:
        from scipy.special import chdtrc

        return float(chdtrc(max(samples - one.numbers, 1), one.squares))


def _entered(evidence: Evidence, fit: Fit) -> Refit:
    left = (evidence.world.observed - fit.simulated) / evidence.noise.sigma
    squares = float(np.square(left[evidence.seen]).sum())
    numbers = fit.free.size + int((~evidence.world.known).sum())
    return Refit(fit, squares if np.isfinite(squares) else np.inf, numbers)


def _extended(evidence: Evidence, at: Fit) -> list[Fit]:
    """Add each of the most promising effects to a model, and refit.

    Returns:
        The best fit for each effect.
    """
    world = evidence.world
    names = [name for name in world.library if name not in at.effects]
    evidence = _about(evidence, at)
    found = directions(world, at, names)
    evidence.__dict__["directions"] = found
    left, effects = evidence.trajectories().projected()
    best = strongest(left, effects, evidence.columns)
    order = sorted(best, key=lambda name: -best[name][0])[:REFITTED]
    starts = [
        start
        for name in order
        for start in _starts(evidence, at, name, best[name][1], left, effects)
    ]
    if not starts:
        return []
    fits = Fitter(world, evidence.noise, evidence.base.frozen).fit(starts, STEPS, race=True)
    by_name: dict[str, Fit] = {}
    for fit in fits:
        name = fit.effects[-1]
        if name not in by_name or fit.cost < by_name[name].cost:
            by_name[name] = fit
    return list(by_name.values())


def _about(evidence: Evidence, at: Fit) -> Evidence:
    """Copy the evidence, with another fitted model as the base model."""
    other = object.__new__(Evidence)
    kept = ("world", "noise", "stated", "base", "fitted", "held_out")
    other.__dict__.update({name: evidence.__dict__[name] for name in kept})
    other.base = type(evidence.base)(at, evidence.base.untouched, evidence.base.vague)
    return other


def _starts(
    evidence: Evidence, at: Fit, name: str, column: Column, left: Array, effects: Array
) -> list[Start]:
    """Choose starting values for a fit with one more effect.

    They are the size predicted by the linear model, and 0.3 of it because the linear model holds
    for small sizes only.
    """
    world = evidence.world
    probes = [evidence.directions.probes[place] for place in column.places]
    bounds = coefficient_bounds(world, name)
    sizes = np.linalg.lstsq(effects[:, list(column.places)], left, rcond=1e-9)[0]
    starts = []
    for share in (1.0,) if probes[0].fixed else (1.0, 0.3):
        c = probes[0].c.copy()
        for probe, size in zip(probes, sizes.tolist(), strict=True):
            if not probe.fixed:
                c[probe.place] = np.clip(share * size, *bounds[probe.place])
        theta = at.theta.copy()
        theta[world.slots[name]] = c
        starts.append(Start((*at.effects, name), theta, at.states))
    return starts


def _intervals(evidence: Evidence, one: Refit) -> dict[str, tuple[float | None, float | None]]:
    """Compute 95 % intervals of the fitted parameters, by name, from the curvature at the fit."""
    world, fit = evidence.world, one.fit
    columns = columns_of(world, fit) / evidence.noise.sigma[:, None]
    rows = columns[evidence.seen]
    rows = rows[np.isfinite(rows).all(axis=1)]
    scale = np.sqrt(np.square(rows).sum(axis=0))
    scale[scale == 0] = 1.0
    inverse = np.linalg.pinv((rows / scale).T @ (rows / scale), rcond=1e-12)
    spread = np.sqrt(np.abs(np.diag(inverse))) / scale
    left = one.squares / max(len(rows) - one.numbers, 1)
    spread = spread * np.sqrt(max(left, 1e-12))
    ends: dict[str, tuple[float | None, float | None]] = {}
    for i, place in enumerate(fit.free.tolist()):
        value, half = float(fit.theta[place]), SIGMAS * float(spread[i])
        ends[world.parameters[place].name] = value - half, value + half
    return ends


def _of(
    ends: dict[str, tuple[float | None, float | None]], effect: str
) -> dict[str, tuple[float | None, float | None]]:
    """Select the intervals of one effect's coefficients, by the name of the coefficient."""
    begin = f"{effect}."
    return {name.removeprefix(begin): e for name, e in ends.items() if name.startswith(begin)}
