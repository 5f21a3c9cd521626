"""Compare other causes with the true one on the held-out runs.

Each cause is refitted in the reference world that made the data.
"""

from __future__ import annotations

import numpy as np

from bench.diagnosis_benchmark.case_generation.cause_sizes import compute_rms, fit_coefficients
from tests.exams.robots import planted_effects
from tests.exams.robots.cause_sizing import Gauge

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
        self.wanted = np.concatenate(self.fitted.beyond_states(values[:count]))
        self.unseen = np.concatenate(self.held.beyond_states(values[count:]))

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
            return self._change(of(numbers) | others) - self.wanted

        bounds = np.full(count, -1.0), np.full(count, 2.0)
        return self._error(
            of(fit_coefficients(residual, np.full(count, FIRST), *bounds, ROUNDS)) | others
        )

    def _change(self, effects):
        return np.concatenate(self.fitted.change(effects))

    def _error(self, effects):
        return compute_rms(self.unseen - np.concatenate(self.held.change(effects)))


FREE = {
    "force.ripple": 2, "gravity.tilt": 2, "mass.offset": 3, "friction.stribeck": 2,
    "input.power": 2,
    "friction.load_direction": 2, "friction.load_quadratic": 2,
    "friction.position": 3, "friction.warming": 2,
}  # fmt: skip
"""Count of the leading coefficients that are fitted; the others are shape parameters."""
