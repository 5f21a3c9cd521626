"""How large a hidden cause has to be: the gap that it leaves once initial states are refitted.

All of it by the world that also makes the data, in coarser steps.
"""

from __future__ import annotations

import numpy as np

from tests.robot_exam import causes_outside_library
from tests.robot_exam.exam_settings import FITTED
from tests.robot_exam.reference_world import COARSE, World
from tests.robot_exam.sensor_models import observed

ACCURATE = 0.03  # of the wanted size
LARGEST, LEAP = 1.0, 8.0
NARROW = 0.98  # of two strengths, between which nothing more is looked for
NUDGE = 1e-3  # of an initial state, rad or rad/s: the motion is smooth in it
SETTLED = 1.2  # seconds after which a servo has forgotten where it began


class Gauge:
    """Measures gaps of a setting's runs for fitting, or of those held out, in noises."""

    def __init__(self, setting, held_out=False):
        self.setting = setting
        first, last = (FITTED, len(setting.runs)) if held_out else (0, FITTED)
        self.runs = list(enumerate(setting.runs))[first:last]
        self.step = min(COARSE, 2 * setting.machine.step)
        self.base = self.seen({})
        self.free = [
            self._states(run, base) for (_, run), base in zip(self.runs, self.base, strict=True)
        ]

    def seen(self, effects):
        """Noiseless observations in noises, one (T, C) a run."""
        world = World(
            self.setting.machine, effects, causes_outside_library.plant_of(effects), self.step
        )
        channels, sigma = self.setting.channels, self.setting.sigma
        return [
            observed(world, run, channels, causes_outside_library.slips_of(effects, number)) / sigma
            for number, run in self.runs
        ]

    def change(self, effects):
        """What effects change, with what initial states can take up taken out, one (N,) a run."""
        return self.beyond_states(self.seen(effects))

    def beyond_states(self, seen):
        """How observations, one (T, C) a run, differ from the base beyond initial states."""
        differences = [
            (after - before).ravel() for after, before in zip(seen, self.base, strict=True)
        ]
        return [d - basis @ (basis.T @ d) for d, basis in zip(differences, self.free, strict=True)]

    def gap(self, effects, beyond=()):
        """The gap: root mean square over runs, samples and channels; with `beyond`, what another
        change makes, one (N,) a run, that to this one.
        """
        try:
            changes = self.change(effects)
            others = beyond or [np.zeros_like(change) for change in changes]
            return rms(np.concatenate([c - b for c, b in zip(changes, others, strict=True)]))
        except (RuntimeError, ValueError, np.linalg.LinAlgError):
            return np.inf  # it diverged

    def _states(self, run, base):
        """An orthonormal basis (N, S) of what the initial state changes."""
        machine = self.setting.machine
        servo = bool(machine.drives[0].kp)
        count = run.times.searchsorted(SETTLED) if servo else run.times.size
        short = type(run)(
            run.times[:count], {k: u[:count] for k, u in run.commands.items()}, run.q, run.v
        )
        world, columns = World(machine, step=self.step), []
        for state in range(2 * run.q.size):
            moved = np.concatenate([run.q, run.v])
            moved[state] += NUDGE
            q, v = np.split(moved, 2)
            tried = type(run)(short.times, short.commands, q, v)
            column = np.zeros_like(base)
            seen = observed(world, tried, self.setting.channels) / self.setting.sigma
            column[:count] = (seen - base[:count]) / NUDGE
            columns.append(column.ravel())
        basis, sizes, _ = np.linalg.svd(np.column_stack(columns), full_matrices=False)
        return basis[:, sizes > 1e-9 * sizes[0]]


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


def left(change, others):
    """What the best sum of other changes leaves of one, root mean square; each (N,). What is not
    finite leaves all.
    """
    others = [other for other in others if np.isfinite(other).all()]
    if not others:
        return rms(change)
    solution = np.linalg.lstsq(np.column_stack(others), change, rcond=None)[0]
    return rms(change - np.column_stack(others) @ solution)


def sized(gap, wanted, first=0.03):
    """(strength, gap) at which `gap(strength)`, which grows from zero, is `wanted`; None if it is
    not below `LARGEST`.

    Secants on logarithmic scales, within a bracket once there is one.
    """
    low, high, strength = (0.0, 0.0), (np.inf, np.inf), first
    for _ in range(12):
        now = gap(strength)
        if abs(now / wanted - 1) < ACCURATE:
            return strength, now
        if now < wanted:
            if strength >= LARGEST:
                return None
            low = strength, now
        else:
            high = strength, now
        if low[0] > NARROW * high[0]:
            return None  # it jumps: a servo that begins to swing
        strength = float(min(_between(low, high, wanted), LARGEST))
    return None


def _between(low, high, wanted):
    """The next strength to try, given (strength, gap) on either side of what is wanted."""
    if not low[0]:
        known = np.isfinite(high[1])
        return high[0] * min(max(wanted / high[1], 1e-2), 0.9) if known else high[0] / 5
    if not np.isfinite(high[0]):
        return low[0] * min(max(1.02 * wanted / max(low[1], 1e-9), 1.05), LEAP)
    if not np.isfinite(high[1]) or high[0] / low[0] > LEAP**2:
        return np.sqrt(low[0] * high[0])
    share = np.log(wanted / low[1]) / np.log(high[1] / low[1])
    return low[0] * (high[0] / low[0]) ** min(max(share, 0.05), 0.95)
