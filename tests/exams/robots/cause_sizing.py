"""Sizes of hidden causes, and competing causes refitted in the reference world.

Initial states are refitted. The simulations use the reference world that also makes the data, with
longer steps.

Each cause is refitted in the reference world that made the data.
"""

from __future__ import annotations

import numpy as np

from bench.diagnosis_benchmark.case_generation.strength_search import (
    compute_orthonormal_basis,
    find_strength_for_size,
)
from sims.core.root_mean_square import compute_rms
from tests.exams.coefficient_fit import fit_coefficients
from tests.exams.robots import planted_effects
from tests.exams.robots.reference_world import COARSE, World
from tests.exams.robots.robot_signals import observed

NUDGE = 1e-3  # Finite-difference step of an initial state, rad or rad/s.
SETTLED = 1.2  # Seconds after which a servo no longer depends on its initial state.


class Gauge:
    """Measure model discrepancies of the fitted or held-out runs of a setting.

    Discrepancies are in units of the noise standard deviation.
    """

    def __init__(self, setting, held_out=False):
        self.setting = setting
        fitted = len(setting.fitted)
        runs = list(enumerate(setting.runs))
        self.runs = runs[fitted:] if held_out else runs[:fitted]
        self.step = min(COARSE, 2 * setting.machine.step)
        self.base = self.seen({})
        self.free = [
            self._states(run, base) for (_, run), base in zip(self.runs, self.base, strict=True)
        ]

    def seen(self, effects):
        """Return noise-free observations in units of the noise, one (T, C) per run."""
        world = World(self.setting.machine, effects, self.step)
        channels, sigma = self.setting.channels, self.setting.sigma
        return [
            observed(world, run, channels, planted_effects.slips_of(effects, number)) / sigma
            for number, run in self.runs
        ]

    def change(self, effects):
        """Return the change (N,) that effects cause in all runs.

        The part that initial states can explain is projected out.
        """
        return self.beyond_states(self.seen(effects))

    def beyond_states(self, seen):
        """Return the difference (N,) of observations from the base in all runs.

        The part that initial states can explain is projected out.

        Args:
            seen: observations in units of the noise, one (T, C) per run.
        """
        differences = [
            (after - before).ravel() for after, before in zip(seen, self.base, strict=True)
        ]
        pairs = zip(differences, self.free, strict=True)
        return np.concatenate([d - basis @ (basis.T @ d) for d, basis in pairs])

    def gap(self, effects, beyond=0.0):
        """Return the RMS discrepancy over runs, samples and channels.

        Args:
            effects: coefficients by effect@place.
            beyond: change (N,) that is subtracted first.
        """
        try:
            return compute_rms(self.change(effects) - beyond)
        except (RuntimeError, ValueError, np.linalg.LinAlgError):
            return np.inf  # The simulation diverged.

    def _states(self, run, base):
        """Return an orthonormal basis (N, S) of the changes that initial states cause.

        The state of a floating base is stated, so it is not fitted.
        """
        machine = self.setting.machine
        settles = bool(machine.drives[0].kp) and not machine.floats
        count = run.times.searchsorted(SETTLED) if settles else run.times.size
        commands = {name: u[:count] for name, u in run.commands.items()}
        world, columns = World(machine, step=self.step), []
        for vector in ("q", "v"):
            for joint in range(len(machine.hinges)):
                start = {"q": run.q.copy(), "v": run.v.copy()}
                start[vector][joint] += NUDGE
                moved = type(run)(run.times[:count], commands, **start)
                column = np.zeros_like(base)
                seen = observed(world, moved, self.setting.channels) / self.setting.sigma
                column[:count] = (seen - base[:count]) / NUDGE
                columns.append(column.ravel())
        return compute_orthonormal_basis(np.column_stack(columns))


def left(change, others):
    """Return the RMS of a change (N,) after a least-squares fit of other changes, each (N,).

    Other changes that are not finite are left out.
    """
    others = [other for other in others if np.isfinite(other).all()]
    if not others:
        return compute_rms(change)
    solution = np.linalg.lstsq(np.column_stack(others), change, rcond=None)[0]
    return compute_rms(change - np.column_stack(others) @ solution)


def sized(gap, wanted):
    """Return (strength, gap) at which `gap(strength)` is `wanted`; None if it is not below 1."""
    return find_strength_for_size(gap, wanted, 1.0, first=0.03, max_exponent=np.inf)


ROUNDS = 5
SHAPES = 4  # Shapes that are drawn for an effect with shape parameters; the best one counts.
FIRST = 0.05  # Start of the fit, as a fraction of the largest plausible value.


class CompetingCauses:
    """Compute held-out errors of causes that are fitted to one recording.

    Errors are in units of the noise standard deviation.

    Args:
        setting: setting of the recording.
        effects: hidden effects, coefficients by effect@place.
        recorded: recorded channels of every run, (T, C).
    """

    def __init__(self, setting, effects, recorded):
        self.setting, self.effects = setting, effects
        values = [v / self.setting.sigma for v in recorded]
        self.fitted, self.held = Gauge(self.setting), Gauge(self.setting, held_out=True)
        count = len(setting.fitted)
        self.wanted = self.fitted.beyond_states(values[:count])
        self.unseen = self.held.beyond_states(values[count:])

    def true_cause_error(self):
        """Return the held-out error of the hidden effects with their true coefficients."""
        return self._error(self.effects)

    def ratio(self, name, further_effects=()):
        """Return the held-out error of a fitted cause, divided by that of the true cause.

        The result is None if the reference world does not contain the cause.

        Args:
            name: effect@place, or effect@* for every place.
            further_effects: names of hidden effects that keep their true coefficients.
        """
        others = {key: self.effects[key] for key in further_effects}
        errors = [self._fitted(of, count, others) for of, count in self._forms(name)]
        return min(errors) / self.true_cause_error() if errors else None

    def _forms(self, name):
        """Yield (function from scaled numbers to effects, count of numbers) for each shape."""
        effect, _, place = name.partition("@")
        machine = self.setting.machine
        known = planted_effects.effects(machine.name)
        places = planted_effects.places(machine, effect) if effect in known else []
        chosen = [p for p in places if (p if place == "*" else p == place)]
        shaped = {**planted_effects.SHAPES, **planted_effects.SHARED_SHAPES}
        draws = SHAPES if effect in shaped else 1
        for draw in range(draws if chosen else 0):
            rng = np.random.default_rng(list(" ".join(("rival", name, str(draw))).encode()))
            shapes = {p: planted_effects.shape(effect, p, self.setting, rng)(1.0) for p in chosen}
            if effect == "input.saturation":
                continue
            yield self._form(effect, shapes)

    def _form(self, effect, shapes):
        free = FREE.get(effect, 1)

        def effects(numbers):
            rows = np.reshape(numbers, (len(shapes), free))
            return {
                planted_effects.named(effect, place): (*(row * scale[:free]), *c[free:])
                for row, (place, c) in zip(rows, shapes.items(), strict=True)
                for scale in [np.abs(c)]
            }

        return effects, free * len(shapes)

    def _fitted(self, of, count, others):
        def residual(numbers):
            return self.fitted.change(of(numbers) | others) - self.wanted

        bounds = np.full(count, -1.0), np.full(count, 2.0)
        return self._error(
            of(fit_coefficients(residual, np.full(count, FIRST), *bounds, ROUNDS)) | others
        )

    def _error(self, effects):
        return compute_rms(self.unseen - self.held.change(effects))


FREE = {
    "force.ripple": 2, "gravity.tilt": 2, "mass.offset": 3, "friction.stribeck": 2,
    "input.power": 2,
    "friction.load_direction": 2, "friction.load_quadratic": 2,
    "friction.position": 3, "friction.warming": 2,
}  # fmt: skip
"""Count of the leading coefficients that are fitted; the others are shape parameters."""
