"""Run consistency: test whether runs, logs or loads agree on each parameter.

The test works at the joint fit. J_r = [A_r B_r] are the whitened derivatives of run r with respect
to the parameters and to the initial states of the run, e_r is the residual, and sigma_0 is the
prior standard deviation of the initial states:

    H_r = A_r' A_r - A_r' B_r S_r^-1 B_r' A_r,    S_r = B_r' B_r + diag sigma_0^-2
    g_r = A_r' e_r - A_r' B_r S_r^-1 (B_r' e_r + prior)                                          (1)

A group G of runs alone would change the parameters by one Gauss-Newton step,

    d_G = H_G^-1 g_G,    cov_G = H_G^-1,    H_G = sum_r H_r,  g_G = sum_r g_r                    (2)

The groups that identify a parameter x agree on it according to Cochran's Q (W. Cochran, Biometrics
10, 101, 1954), which follows a chi-squared distribution with one degree of freedom less than the
number n of groups:

    Q = sum_G w_G (x_G - mean)^2,    w_G = 1 / var_G,    Q ~ chi^2 with n - 1                    (3)

The variance between groups beyond their errors is (R. DerSimonian, N. Laird, Control. Clin. Trials
7, 177, 1986)

    tau^2 = (Q - (n - 1)) / (sum w - sum w^2 / sum w)                                            (4)

The variance of a parameter for a run that is not yet recorded is therefore

    var = var_joint + tau^2                                                                      (5)

The trend with a covariate z of the groups, such as a load or the order of logs, is the slope of
weighted least squares. Its error is enlarged by the scatter about the line (R. Birge, Phys. Rev.
40, 207, 1932).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from math import erfc, sqrt

import numpy as np

from bench.analysis.chi_squared import chi_squared_tail
from bench.gap.along import Kind, along, constant
from bench.gap.measure import Z95, curved
from bench.gap.model.fit import prior_of
from bench.gap.model.models import Model, Models
from bench.gap.model.noise import whitened
from bench.gap.model.world import World
from sims.base import Array
from sims.recording.recording import Run

LEVEL = 0.01
"""Significance level of test (3), divided by the number of tests for all parameters together."""
SLIGHT = 1e-3
"""Scatter below which groups count as consistent at any p-value, as a fraction of the value."""
FEWEST = 4
"""Minimum number of groups for which a trend covariate is searched."""
ALIKE = 2.0
"""Maximum ratio of the mean square about the line to the smallest one, for a covariate that counts
as indistinguishable from the best.
"""
WIDE = 4.0
"""Maximum width of a group's 95 % interval, as a multiple of the parameter's range or value, for
the group to be used.
"""


@dataclass(frozen=True)
class Part:
    """Estimate of one parameter from one group of runs: its value and its standard error."""

    group: str
    value: float
    error: float


@dataclass(frozen=True)
class Trend:
    """Linear trend of a parameter over the groups: slope, its standard error and its p-value."""

    slope: float
    error: float
    chance: float


@dataclass(frozen=True)
class Mover:
    """Covariate with which a parameter moves between groups.

    Attributes:
        kind: Category of the covariate (`bench.gap.along`).
        name: Name of the covariate.
        trend: Trend of the parameter with the covariate.
        also: Names of other covariates that explain the trend about as well.
    """

    kind: Kind
    name: str
    trend: Trend
    also: tuple[str, ...] = ()


@dataclass(frozen=True)
class Spread:
    """Consistency of one parameter between groups of runs.

    Attributes:
        number: Name of the parameter; for a coefficient of a cause, it includes the effect.
        unit: Unit of the parameter.
        by: Criterion of the groups: ``run``, ``log`` or a constant that differs between runs.
        value: Estimate of the joint fit.
        error: Standard error of the joint estimate, from the curvature.
        parts: Estimates of the groups that identify the parameter.
        scatter: Tau of (4), the standard deviation between groups beyond their errors.
        chance: P-value of test (3).
        agree: Whether the groups are consistent.
        trend: Trend with a constant or with the order of logs; None by run or with fewer than three
            groups.
        mover: Significant trend covariate; None if there is none or the groups agree.
    """

    number: str
    unit: str
    by: str
    value: float
    error: float
    parts: tuple[Part, ...]
    scatter: float
    chance: float
    agree: bool
    trend: Trend | None = None
    mover: Mover | None = None

    @property
    def total(self) -> float:
        """Standard error for a run that is not yet recorded, (5)."""
        return float(np.hypot(self.error, self.scatter))


@dataclass(frozen=True)
class Apart:
    """Consistency of parameters between groups of runs.

    Attributes:
        before: Parameters of the base model.
        after: Parameters of the extended model.
        rival: Coefficients of the best single effect that is not part of the diagnosis.
    """

    before: tuple[Spread, ...] = ()
    after: tuple[Spread, ...] = ()
    rival: tuple[Spread, ...] = ()


@dataclass(frozen=True)
class _Grouping:
    """Runs in groups: the criterion, names and run indices, and the value of each group if any."""

    by: str
    names: tuple[str, ...]
    runs: tuple[tuple[int, ...], ...]
    numbers: tuple[float, ...] | None = None


def spreads(models: Models, model: Model) -> tuple[Spread, ...]:
    """Assess the consistency of each parameter of a fitted model between runs, logs and loads.

    Args:
        models: Models of the runs.
        model: Model that is fitted to all runs.

    Returns:
        One entry for each parameter and grouping; empty without groups or free parameters.
    """
    world = models.world
    groupings = list(_groupings(world.runs))
    if not groupings or not model.fit.free.size:
        return ()
    curvatures, gradients = _by_run(models, model)
    found = [
        (by, one) for by in groupings for one in _spreads(world, model, by, curvatures, gradients)
    ]
    level = LEVEL / max(len(found), 1)
    judged = [(by, _judged(one, level)) for by, one in found]
    return tuple(
        one if one.agree else replace(one, mover=_mover(world, model, by, one))
        for by, one in judged
    )


def _mover(world: World, model: Model, by: _Grouping, one: Spread) -> Mover | None:
    """Find the covariate with which the group estimates of a parameter move."""
    if by.by not in ("run", "log"):
        if one.trend is None or one.trend.chance >= LEVEL:
            return None
        return Mover(constant(world, by.by), by.by, one.trend)
    places = {name: list(runs) for name, runs in zip(by.names, by.runs, strict=True)}
    tried = []
    for about in along(world, model, one.number):
        values = np.array([about.values[places[part.group]].mean() for part in one.parts])
        trend = _trend(one.parts, values) if len(one.parts) >= FEWEST else None
        if trend is not None:
            tried.append((_rest(one.parts, values), about, trend))
    sure = [entry for entry in tried if entry[2].chance < LEVEL / len(tried)]
    if not sure:
        return None
    least, best, trend = min(sure, key=lambda entry: entry[0])
    # A covariate that fits about as well cannot be distinguished from the best one.
    also = [about.name for rest, about, _ in sure if about is not best and rest < ALIKE * least]
    return Mover(best.kind, best.name, trend, tuple(also))


def _rest(parts: Sequence[Part], numbers: Array) -> float:
    """Compute the weighted mean square about the line of `_trend`; at least 1, its expectation."""
    values = np.array([part.value for part in parts])
    weights = np.array([part.error for part in parts]) ** -2.0
    rest = values - np.polyval(np.polyfit(numbers, values, 1, w=np.sqrt(weights)), numbers)
    return max(float(weights @ rest**2) / (len(parts) - 2), 1.0)


def _judged(one: Spread, level: float) -> Spread:
    slight = one.scatter < SLIGHT * abs(one.value)
    return replace(one, agree=slight or one.chance >= level)


def _groupings(runs: Sequence[Run]) -> Iterator[_Grouping]:
    """Yield the groupings by log, by each constant that differs between runs, and by run."""
    logs = tuple(dict.fromkeys(run.log for run in runs))
    if len(logs) > 1:
        places = tuple(tuple(i for i, run in enumerate(runs) if run.log == log) for log in logs)
        yield _Grouping("log", logs, places, tuple(map(float, range(len(logs)))))
    for name in dict.fromkeys(name for run in runs for name in run.constants):
        values = [run.constants.get(name, np.nan) for run in runs]
        each = sorted(set(values))
        if len(each) > 1 and np.isfinite(each).all():
            places = tuple(tuple(i for i, v in enumerate(values) if v == one) for one in each)
            yield _Grouping(name, tuple(f"{one:g}" for one in each), places, tuple(each))
    if len(runs) > 1:
        yield _Grouping(
            "run", tuple(run.name for run in runs), tuple((i,) for i in range(len(runs)))
        )


def _by_run(models: Models, model: Model) -> tuple[Array, Array]:
    """Compute the normal equations of each run: H (R, q, q) and g (R, q) of (1)."""
    world, fit = models.world, model.fit
    q = fit.free.size
    found = curved(models, model)
    residual = whitened(models.residual(fit), models.seen, found.noise)
    pull = np.einsum("rnk,rn->rk", found.jacobian, residual.reshape(len(residual), -1))
    pull[:, q:] += prior_of(world) ** -2.0 * (world.guess - fit.states)
    pull[:, q:] *= ~world.known
    right = np.concatenate([found.cross.transpose(0, 2, 1), pull[:, q:, None]], 2)
    solved = np.linalg.solve(found.inner, right)
    curvatures = found.own - np.matmul(found.cross, solved[..., :-1])
    gradients = pull[:, :q] - np.matmul(found.cross, solved[..., -1:])[..., 0]  # (1)
    return curvatures, gradients


def _spreads(
    world: World, model: Model, by: _Grouping, curvatures: Array, gradients: Array
) -> Iterator[Spread]:
    joint = _inverse(curvatures.sum(axis=0))
    steps, errors = [], []
    for runs in by.runs:
        own = _inverse(curvatures[list(runs)].sum(axis=0))
        steps.append(own @ gradients[list(runs)].sum(axis=0))  # (2)
        errors.append(np.sqrt(np.maximum(np.diagonal(own), 0.0)))
    for column, place in enumerate(model.fit.free.tolist()):
        parameter, value = world.parameters[place], float(model.fit.theta[place])
        low, high = parameter.bounds
        size = max(high - low, abs(value))
        parts, numbers = [], []
        for group, name in enumerate(by.names):
            error = float(errors[group][column])
            if error > 0 and 2.0 * Z95 * error < WIDE * size:
                parts.append(Part(name, value + float(steps[group][column]), error))
                numbers.append(by.numbers[group] if by.numbers else 0.0)
        if len(parts) < 2:
            continue
        error = float(np.sqrt(max(joint[column, column], 0.0)))
        scatter, chance = _heterogeneity(parts)
        trend = _trend(parts, np.array(numbers)) if by.numbers else None
        yield Spread(
            parameter.name,
            parameter.unit,
            by.by,
            value,
            error,
            tuple(parts),
            scatter,
            chance,
            True,
            trend,
        )


def _inverse(curvature: Array) -> Array:
    """Invert a curvature matrix; directions that the runs do not identify get a huge variance."""
    scale = np.sqrt(np.maximum(np.diagonal(curvature), 1e-200))
    values, vectors = np.linalg.eigh(curvature / np.outer(scale, scale))
    result: Array = (vectors / np.maximum(values, 1e-12)) @ vectors.T / np.outer(scale, scale)
    return result


def _heterogeneity(parts: Sequence[Part]) -> tuple[float, float]:
    """Compute tau of (4) and the p-value of (3)."""
    values = np.array([part.value for part in parts])
    weights = np.array([part.error for part in parts]) ** -2.0
    mean = float(weights @ values / weights.sum())
    q = float(weights @ (values - mean) ** 2)  # (3)
    freedom = len(parts) - 1
    left = float(weights.sum() - (weights @ weights) / weights.sum())
    tau = np.sqrt(max(q - freedom, 0.0) / left) if left > 0 else 0.0  # (4)
    return float(tau), chi_squared_tail(freedom, q)


def _trend(parts: Sequence[Part], numbers: Array) -> Trend | None:
    """Fit a weighted least-squares line to the groups; None for fewer than three groups."""
    if len(parts) < 3 or not np.ptp(numbers) > 0:
        return None
    values = np.array([part.value for part in parts])
    weights = np.array([part.error for part in parts]) ** -2.0
    apart = numbers - weights @ numbers / weights.sum()
    power = float(weights @ apart**2)
    slope = float(weights @ (apart * values)) / power
    rest = values - weights @ values / weights.sum() - slope * apart
    freedom = len(parts) - 2
    ratio = float(weights @ rest**2) / freedom
    error = float(np.sqrt(max(ratio, 1.0) / power))
    # If the scatter agrees with the errors, these are known; otherwise they are estimated.
    size = abs(slope) / error
    return Trend(slope, error, erfc(size / sqrt(2.0)) if ratio <= 1.0 else _student(size, freedom))


def _student(size: float, freedom: int) -> float:
    """Return the two-sided p-value of Student's t."""
    # Importing scipy.special takes 0.1 s, and this is the only place of most diagnoses to need it.
    from scipy.special import stdtr

    return float(2.0 * stdtr(freedom, -size))
