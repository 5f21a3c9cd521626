"""What verdict.json says: the causes, the numbers and their intervals, the held-out gain, the
ranked candidates.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import numpy as np

from bench.gap.causes.name import Finding
from bench.gap.causes.score_test import tail
from bench.gap.causes.search import Search
from bench.gap.measure import Gain, gain, intervals
from bench.gap.model.floor import Floor
from bench.gap.model.models import Model
from bench.gap.model.world import World
from bench.gap.propose import next_experiment
from sims.base import Array
from sims.extended import Number
from sims.recording.recording import Recording


@dataclass(frozen=True)
class Answer:
    """Puts a finding into numbers.

    Attributes:
        recording: what was explained.
        fitting, measuring: its runs; None where none are held out.
        floor: the noise.
        engine: the engine's name; None for a simulator that steps itself.
    """

    recording: Recording
    fitting: World
    measuring: World | None
    floor: Floor
    engine: str | None

    def verdict(
        self, search: Search, finding: Finding, rng: np.random.Generator, started: float
    ) -> dict[str, Any]:
        """What verdict.json says; `started` is `time.perf_counter` at the beginning."""
        world = self.fitting
        numbers = self.numbers(search, finding.model)
        causes = []
        for cause in finding.causes:
            effect = world.effects[cause.effect]
            there = effect.on(world.simulator.system)
            names = [c.name for c in there]
            places = range(*world.slots[cause.effect].indices(len(world.parameters)))
            causes.append(
                {
                    "effect": cause.effect,
                    "alternatives": list(cause.alternatives),
                    "says": effect.says,
                    "coefficients": {
                        n: _estimate(numbers[i]) for n, i in zip(names, places, strict=True)
                    },
                    "p_value": cause.p_value,
                }
            )
        simulations = world.simulations + (self.measuring.simulations if self.measuring else 0)
        result = {
            "verdict": finding.verdict,
            "system": self.recording.system,
            "engine": self.engine or "its own",
            "causes": causes,
            "parameters": {
                world.parameters[i].name: _estimate(numbers[i]) for i in world.base.tolist()
            },
            "heldout": self._heldout(finding, rng),
            "candidates": self._candidates(search, finding),
            "next_experiment": self._next(search, finding),
            "simulations": int(simulations),
            "seconds": 0.0,
        }
        result["seconds"] = time.perf_counter() - started
        return result

    def numbers(self, search: Search, model: Model) -> dict[int, Number]:
        """Every parameter and coefficient by its place; without an interval where it was not
        fitted.
        """
        world = self.fitting
        known = intervals(search, model)
        result = {}
        for place, parameter in enumerate(world.parameters):
            value, low, high = known.get(place, (float(model.fit.theta[place]), np.nan, np.nan))
            bounded = np.isfinite(low) and np.isfinite(high)
            result[place] = Number(
                value, parameter.unit, low if bounded else None, high if bounded else None
            )
        return result

    def _counted(self) -> list[int]:
        """Channels that share the unit of the one that sensor effects act on."""
        world = self.fitting
        units = [c.unit for c in world.simulator.channels]
        reading = world.simulator.system.reading(world.channels)
        return [c for c, unit in enumerate(units) if unit == units[world.channels.index(reading)]]

    def sigma(self, finding: Finding) -> Array:
        """(C,) the noise floor: stated, or what a model that leaves no structure leaves."""
        left = finding.model.likelihood.sigma
        usable = ~self.floor.stated & np.isfinite(left) & (left > self.floor.sigma)
        return np.where(usable & (not finding.remains.structure), left, self.floor.sigma)

    def _heldout(self, finding: Finding, rng: np.random.Generator) -> dict[str, Any] | None:
        if (
            self.measuring is None
            or finding.measured is None
            or finding.model.names not in finding.measured
        ):
            return None
        counted = self._counted()
        floor = float(np.sqrt(np.square(self.sigma(finding)[counted]).mean()))
        before, after = (finding.measured[names].simulated for names in ((), finding.model.names))
        if not (np.isfinite(before[np.isfinite(self.measuring.observed)]).all()):
            return None
        found = gain(self.measuring, before, after, counted, floor, rng)
        return _heldout(found, self.fitting.simulator.channels[counted[0]].unit)

    def _candidates(self, search: Search, finding: Finding) -> list[dict[str, Any]]:
        """Every effect of the library with its evidence about the base model, the strongest first."""
        if frozenset() not in search.scanned:
            return []
        scores = search.scanned[frozenset()][1]
        base = search.models[frozenset()].likelihood.value
        rows = []
        for i, effect in enumerate(scores.effects):
            alone = search.models.get(frozenset({effect}))
            score = float(scores.score[i])
            if alone is not None:
                score = max(score, float(alone.likelihood.value - base))
            p_value = tail(scores.by_chance, np.array([score - scores.chance[i]]))
            rows.append(
                {
                    "effect": effect,
                    "score": max(score, 0.0),
                    "p_value": float(np.clip(p_value, 0.0, 1.0)),
                    "heldout_gain": self._share(finding, (effect,)),
                }
            )
        return sorted(rows, key=lambda row: -row["score"])

    def _share(self, finding: Finding, names: tuple[str, ...]) -> float | None:
        """Share of the held-out gap that a model closes; None where it was not measured."""
        if self.measuring is None or finding.measured is None or names not in finding.measured:
            return None
        counted, seen = self._counted(), np.isfinite(self.measuring.observed)
        floor = float(np.sqrt(np.square(self.sigma(finding)[counted]).mean()))
        before, after = (
            float(
                np.sqrt(
                    np.square(
                        (self.measuring.observed - s)[..., counted][seen[..., counted]]
                    ).mean()
                )
            )
            for s in (finding.measured[()].simulated, finding.measured[names].simulated)
        )
        share = (before - max(after, floor)) / (before - floor) if before > floor * 1.001 else 0.0
        return float(np.clip(share, -9.0, 1.0)) if np.isfinite(share) else None

    def _next(self, search: Search, finding: Finding) -> dict[str, Any] | None:
        if finding.verdict == "unidentifiable":
            names = " and ".join(finding.vague)
            differently = (
                "they act differently from each other"
                if len(finding.vague) > 1
                else "it makes a difference"
            )
            return {"says": f"Measure {names} apart, or record runs in which {differently}"}
        for cause in finding.causes:
            for other in cause.alternatives:
                rest = {n for n in finding.model.names if n != cause.effect}
                rival = search.models.get(frozenset({*rest, other}))
                if rival is not None:
                    return next_experiment(search, finding.model, rival)
        return None


def _estimate(number: Number) -> dict[str, Any]:
    return {"value": number.value, "unit": number.unit, "low": number.low, "high": number.high}


def _heldout(found: Gain, unit: str) -> dict[str, Any] | None:
    """As in verdict.json; an interval that the data do not give is null."""
    values = {
        "rmse_base": found.base,
        "rmse_extended": found.extended,
        "noise_floor": found.floor,
        "gap_closed": found.closed,
        "low": found.low,
        "high": found.high,
    }
    return {**{k: v if np.isfinite(v) else None for k, v in values.items()}, "unit": unit}
