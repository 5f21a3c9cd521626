"""What else would explain an observation: effects of the library refitted to it, the most promising ones."""

from __future__ import annotations

import numpy as np

from sims import effects as library
from tests.exam.sizing import Fitter
from tests.exam.worlds import SIMULATORS

PROMISING = 4  # effects that are refitted, of those that close most of the gap to first order
SHAPES = {  # of effects whose shape is not in proportion: first guesses, in the library's units
    "force.periodic": [(f,) for f in (0.2, 0.4, 0.7, 1.2, 2.0, 3.5)],
    "force.ripple": [(p,) for p in (0.1, 0.2, 0.4, 0.8, 1.6, 3.0, 6.0)],
    "friction.stribeck": [(s,) for s in (0.05, 0.2, 1.0)],
    "wind": [(u, v) for u in (-4.0, 0.0, 4.0) for v in (-4.0, 0.0, 4.0)],
}


def left_with(setting, observed, name, coefficients=None, starts=None):
    """What base parameters, initial states and the effect of this name leave of observations (R, T, C), refitted."""
    fit = Fitter(setting, [name])
    if coefficients is not None:
        return fit(observed, _theta(fit, setting, coefficients), starts).left
    guesses = [guess for _, guess in _guesses(setting, observed, name, Fitter(setting)(observed))]
    return min(fit(observed, guess, starts).left for guess in guesses[:3])


def best(setting, observed, without=()):
    """The effect of the library that leaves least of observations (R, T, C), and how much."""
    bare = Fitter(setting)(observed)
    names = [n for n in library.library(SIMULATORS[setting.system].system) if n not in without]
    names = [n for n in names if setting.driven or not (n.startswith("input.") or n == "backlash")]
    first = {n: _guesses(setting, observed, n, bare)[0] for n in names}
    promising = sorted(first, key=lambda n: first[n][0])[:PROMISING]
    left = {n: Fitter(setting, [n])(observed, first[n][1], bare.starts).left for n in promising}
    name = min(left, key=left.get)
    return name, min(left[name], bare.left)


def _theta(fit, setting, coefficients):
    base = [setting.parameters[p.name] for p in SIMULATORS[setting.system].system.parameters]
    theta = fit.theta.copy()
    theta[:] = [*base, *coefficients][: theta.size]
    return theta


def _guesses(setting, observed, name, bare):
    """(what would be left to first order, theta) by shape, the best first."""
    fit, result = Fitter(setting, [name]), []
    base = bare.theta.size
    limits = [1.0]
    if name == "input.saturation":  # nothing at first order: its limit is tried a little below the peak
        peak = max(np.abs(s.inputs["u"]).max() for s in setting.scenarios)
        limits = [0.9 * peak, 0.6 * peak]
        thetas = [np.array([*bare.theta, limit]) for limit in limits]
        return sorted((_left_at(fit, observed, theta, bare), theta) for theta in thetas)
    for given in SHAPES.get(name, [()]):
        theta = np.zeros(fit.theta.size)
        theta[:base] = bare.theta
        behind = given[: theta.size - base - 1]
        if behind:
            theta[-len(behind) :] = behind
        rest, slope = fit._look(observed, theta, bare.starts)
        free = np.ones(slope.shape[1], dtype=bool)
        free[theta.size - len(behind) : theta.size] = False
        step = fit._step(rest, slope[:, free], 1e-9)
        left = float(np.sqrt(np.mean((rest - slope[:, free] @ step) ** 2)))
        guess = theta.copy()
        moved = step[: free[: theta.size].sum()] * fit.scales[: theta.size][free[: theta.size]]
        guess[free[: theta.size]] += moved
        result.append((left, np.clip(guess, fit.low, fit.high)))
    return sorted(result, key=lambda pair: pair[0])


def _left_at(fit, observed, theta, bare):
    rest, _ = fit._look(observed, theta, bare.starts)
    return float(np.sqrt(np.mean(rest**2)))
