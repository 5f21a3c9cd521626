"""Scale a hidden cause until its model discrepancy has the wanted size.

Initial states are refitted. The simulations use the reference world that also makes the data, with
longer steps.
"""

from __future__ import annotations

import numpy as np

from bench.diagnosis_benchmark.case_generation.cause_sizes import (
    compute_orthonormal_basis,
    compute_rms,
    find_strength_for_size,
)
from tests.exams.robots import unmodelled_causes
from tests.exams.robots.reference_world import COARSE, World
from tests.exams.robots.sensor_models import observed

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
            observed(world, run, channels, unmodelled_causes.slips_of(effects, number)) / sigma
            for number, run in self.runs
        ]

    def change(self, effects):
        """Return the change that effects cause, one (N,) per run.

        The part that initial states can explain is projected out.
        """
        return self.beyond_states(self.seen(effects))

    def beyond_states(self, seen):
        """Return the difference of observations from the base, one (N,) per run.

        The part that initial states can explain is projected out.

        Args:
            seen: observations in units of the noise, one (T, C) per run.
        """
        differences = [
            (after - before).ravel() for after, before in zip(seen, self.base, strict=True)
        ]
        return [d - basis @ (basis.T @ d) for d, basis in zip(differences, self.free, strict=True)]

    def gap(self, effects, beyond=()):
        """Return the RMS discrepancy over runs, samples and channels.

        Args:
            effects: coefficients by effect@place.
            beyond: changes that are subtracted first, one (N,) per run.
        """
        try:
            changes = self.change(effects)
            others = beyond or [np.zeros_like(change) for change in changes]
            return compute_rms(
                np.concatenate([c - b for c, b in zip(changes, others, strict=True)])
            )
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
