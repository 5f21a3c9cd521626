"""Which number to trust: what each run, log or load says of a number by itself.

About the joint fit, with the whitened derivatives J_r = [A_r B_r] of run r, by parameters and by
its initial states, its residual e_r, and what was known of these states beforehand, sigma_0,

    H_r = A_r' A_r - A_r' B_r S_r^-1 B_r' A_r,    S_r = B_r' B_r + diag sigma_0^-2
    g_r = A_r' e_r - A_r' B_r S_r^-1 (B_r' e_r + prior)                                          (1)

a group G of runs alone would move the parameters by (one step of Gauss and Newton)

    d_G = H_G^-1 g_G,    cov_G = H_G^-1,    H_G = sum_r H_r,  g_G = sum_r g_r                    (2)

and the groups agree on a number x if (W. Cochran, Biometrics 10, 101, 1954), over those that fix
it,

    Q = sum_G w_G (x_G - mean)^2,    w_G = 1 / var_G,    Q ~ chi^2 of one less                   (3)

What they scatter beyond that is (R. DerSimonian, N. Laird, Control. Clin. Trials 7, 177, 1986)

    tau^2 = (Q - (n - 1)) / (sum w - sum w^2 / sum w)                                            (4)

so that a number is known, for a run not yet recorded, to

    var = var_joint + tau^2                                                                      (5)

Against a number z of the groups, a load or the order of logs, it moves by the slope of weighted
least squares, whose error grows with the scatter about it (R. Birge, Phys. Rev. 40, 207, 1932).
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
"""Chance of (3) below which groups do not agree, shared by all numbers that are asked about."""
SLIGHT = 1e-3
"""Share of a number below which nobody minds what groups scatter, however sure it is."""
FEWEST = 4
"""Groups from which it is asked what a number moves with."""
ALIKE = 2.0
"""Times the least mean square about its line, what else may be what a number moves with."""
WIDE = 4.0
"""A group whose interval is wider than so many times the bounds says nothing of a number."""


@dataclass(frozen=True)
class Part:
    """What one group says of a number: its value, and 1 sigma."""

    group: str
    value: float
    error: float


@dataclass(frozen=True)
class Trend:
    """How a number moves with one of the groups: its slope, 1 sigma of it, and its chance."""

    slope: float
    error: float
    chance: float


@dataclass(frozen=True)
class Mover:
    """What a number moves with: its kind and name (`along`), how, and what else would do."""

    kind: Kind
    name: str
    trend: Trend
    also: tuple[str, ...] = ()


@dataclass(frozen=True)
class Spread:
    """What groups of runs say of one number.

    Attributes:
        number: its name; of a cause's coefficient with the effect.
        unit: of it.
        by: what the groups are: ``run``, ``log`` or a constant that differs between runs.
        value: of the joint fit.
        error: 1 sigma of it, by curvature.
        parts: the groups that fix it.
        scatter: tau of (4), what they differ by beyond their errors.
        chance: of (3).
        agree: whether they do.
        trend: with a constant, or with the order of logs; None where there are too few.
        mover: what it moves with, if it is sure; None where the groups agree.
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
        """1 sigma for a run not yet recorded, (5)."""
        return float(np.hypot(self.error, self.scatter))


@dataclass(frozen=True)
class Apart:
    """What groups of runs say of the numbers of the base model, of those of what was found, and of
    the coefficients of the best effect that was not needed.
    """

    before: tuple[Spread, ...] = ()
    after: tuple[Spread, ...] = ()
    rival: tuple[Spread, ...] = ()


@dataclass(frozen=True)
class _Grouping:
    """Runs in groups, by what, and the number of each group where it has one."""

    by: str
    names: tuple[str, ...]
    runs: tuple[tuple[int, ...], ...]
    numbers: tuple[float, ...] | None = None


def spreads(models: Models, model: Model) -> tuple[Spread, ...]:
    """What runs, logs and loads say of each number of a fitted model by themselves.

    Args:
        models: of the runs.
        model: fitted to all of them.
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
    """What the groups' values of a number move with."""
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
    # What goes along with it as well cannot be told from it.
    also = [about.name for rest, about, _ in sure if about is not best and rest < ALIKE * least]
    return Mover(best.kind, best.name, trend, tuple(also))


def _rest(parts: Sequence[Part], numbers: Array) -> float:
    """Weighted mean square about the line of `_trend`, at least what errors make of it."""
    values = np.array([part.value for part in parts])
    weights = np.array([part.error for part in parts]) ** -2.0
    rest = values - np.polyval(np.polyfit(numbers, values, 1, w=np.sqrt(weights)), numbers)
    return max(float(weights @ rest**2) / (len(parts) - 2), 1.0)


def _judged(one: Spread, level: float) -> Spread:
    slight = one.scatter < SLIGHT * abs(one.value)
    return replace(one, agree=slight or one.chance >= level)


def _groupings(runs: Sequence[Run]) -> Iterator[_Grouping]:
    """By logs where there are several, by each constant that differs, else by run."""
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
    """(R, q, q) and (R, q) of (1)."""
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
    """Its inverse; directions that these runs do not fix have a huge one."""
    scale = np.sqrt(np.maximum(np.diagonal(curvature), 1e-200))
    values, vectors = np.linalg.eigh(curvature / np.outer(scale, scale))
    result: Array = (vectors / np.maximum(values, 1e-12)) @ vectors.T / np.outer(scale, scale)
    return result


def _heterogeneity(parts: Sequence[Part]) -> tuple[float, float]:
    """Tau of (4) and the chance of (3)."""
    values = np.array([part.value for part in parts])
    weights = np.array([part.error for part in parts]) ** -2.0
    mean = float(weights @ values / weights.sum())
    q = float(weights @ (values - mean) ** 2)  # (3)
    freedom = len(parts) - 1
    left = float(weights.sum() - (weights @ weights) / weights.sum())
    tau = np.sqrt(max(q - freedom, 0.0) / left) if left > 0 else 0.0  # (4)
    return float(tau), chi_squared_tail(freedom, q)


def _trend(parts: Sequence[Part], numbers: Array) -> Trend | None:
    """Weighted least squares against the groups' number; None for fewer than three."""
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
    # Errors that the scatter bears out are known; those that it enlarges are estimated.
    size = abs(slope) / error
    return Trend(slope, error, erfc(size / sqrt(2.0)) if ratio <= 1.0 else _student(size, freedom))


def _student(size: float, freedom: int) -> float:
    """Return the two-sided p-value of Student's t."""
    # Importing scipy.special takes 0.1 s, and this is the only place of most diagnoses to need it.
    from scipy.special import stdtr

    return float(2.0 * stdtr(freedom, -size))
