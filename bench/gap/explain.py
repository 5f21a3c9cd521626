"""`simgap explain`: a recording in, a verdict, an extended simulator and a report out. The four steps in order."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from bench.gap import extend, show
from bench.gap.base import Base, fit_base
from bench.gap.colour import Noise
from bench.gap.extend import Extended, Number
from bench.gap.floor import Floor, noise_floor
from bench.gap.measure import Gain, HeldOut, gain, intervals
from bench.gap.name import Finding, name
from bench.gap.propose import next_experiment
from bench.gap.remains import CHANCE, Hat, Remains
from bench.gap.score import tail
from bench.gap.search import Model, Search
from bench.gap.story import Shown, Story, Tuned
from bench.gap.world import World
from bench.inspection import load
from bench.seeds import rng_for
from methods.base import Array
from sims import effects as library
from sims.base import InputError
from sims.own import OwnSimulator
from sims.simulated import Simulated

LEAST = 2.0
"""Samples for each unknown without which nothing can be said."""
HUGE = 1e9
"""Values so many times a channel's typical size are none."""
STILL = 6.0
"""A channel whose range is below so many sigmas shows no motion."""
Say = Callable[[str], None]


@dataclass(frozen=True)
class Explanation:
    """The result.

    Attributes:
        verdict: as verdict.json.
        story: everything a person is told.
        extended: the extended simulator.
    """

    verdict: dict[str, Any]
    story: Story
    extended: Extended

    def write(self, folder: Path) -> list[Path]:
        """Write verdict.json, extended.toml, figures and report.html into a folder that exists."""
        from bench.gap.pictures import draw
        from bench.gap.report import write_report

        paths = [folder / "verdict.json", folder / "extended.toml"]
        paths[0].write_text(json.dumps(self.verdict, indent=1, allow_nan=False) + "\n", encoding="utf-8")
        extend.write(self.extended, paths[1])
        figures = draw(self.story, folder)
        return [*paths, *figures, write_report(self.story, folder, figures)]


def explain(
    path: str | Path,
    system: str | None = None,
    engine: str = "batch",
    seed: int = 0,
    free: Sequence[str] = (),
    tuner: str | None = None,
    say: Say = lambda _: None,
) -> Explanation:
    """Explain a recording.

    Args:
        path: the table.
        system: take it for this system, whatever the description says.
        engine: pybullet, mujoco or batch; a simulator that steps itself has its own.
        seed: of the surrogates and the bootstrap.
        free: constants to estimate with the parameters.
        tuner: a registered tuner that finds where the fit of the base parameters begins.
        say: told what is being done.

    Raises:
        InputError: the recording cannot be read, is too short, or is of nothing that takes effects.
    """
    return _Explainer(Path(path), system, engine, seed, tuple(free), tuner, say).run()


class _Explainer:
    def __init__(
        self, path: Path, system: str | None, engine: str, seed: int, free: tuple[str, ...], tuner: str | None, say: Say
    ) -> None:
        self.started, self.path, self.seed, self.tuner, self.say = time.perf_counter(), path, seed, tuner, say
        self.recording, kind = load(path, system)
        if not issubclass(kind, Simulated):
            raise InputError(
                f"{path}: simulator {self.recording.system} takes no effects, so nothing can be missing from it"
            )
        extend.refuse_extended(kind)
        self.kind: type[Simulated] = kind
        self.engine = None if issubclass(kind, OwnSimulator) else engine
        self.fitting = World(kind, self.recording, self.recording.training(), self.engine, [Hat], free)
        held_out = self.recording.held_out()
        self.measuring = World(kind, self.recording, held_out, self.engine, [Hat], free) if held_out else None
        self.floor: Floor = noise_floor(self.fitting, self.recording)
        self.noise = Noise(self.floor.sigma, np.zeros(len(self.floor.sigma)))
        self._check()

    def _check(self) -> None:
        world = self.fitting
        samples = int(np.isfinite(world.observed).sum())
        unknowns = world.base.size + int((~world.known).sum())
        if samples < LEAST * unknowns + 4:
            raise InputError(
                f"{self.path}: too short: {samples} samples for fitting, expected at least {int(LEAST * unknowns) + 4} "
                f"for {unknowns} parameters and initial states"
            )

        parts = [part.observed for part in (world, self.measuring) if part is not None]
        for c, channel in enumerate(world.simulator.channels):
            largest = max(float(np.nanmax(np.abs(part[..., c]), initial=0.0)) for part in parts)
            if largest >= HUGE * channel.scale:
                expected = f"expected values of about {channel.scale:g} {channel.unit}, found {largest:.3g}"
                raise InputError(f"{self.path}: column {channel.name}: {expected}; is the unit right?")

    def run(self) -> Explanation:
        self.say("fitting the base model")
        base = fit_base(self.fitting, self.noise, self._given())
        rng = rng_for("explain", self.recording.system, self.seed)
        search = Search(self.fitting, self.noise, base.untouched, rng, self.floor.stated)
        search.enter(base.fit)
        self.say("looking for what is missing")
        held_out = HeldOut(self.measuring, self.noise) if self.measuring else None
        finding = self._still(search, base) or name(search, held_out)
        self.say("measuring the gain")
        verdict = self._verdict(search, finding, rng)
        story = self._story(search, base, finding, verdict)
        extended = self._extended(search, finding)
        for world in (self.fitting, self.measuring):
            if world is not None:
                world.close()
        return Explanation(verdict, story, extended)

    def _given(self) -> Array | None:
        """Where a registered tuner would begin; None without one."""
        if self.tuner is None:
            return None
        from bench.gap.begin import tuned

        return tuned(self.tuner, self.fitting, self.noise, self.seed)

    def _still(self, search: Search, base: Base) -> Finding | None:
        """The verdict on a recording in which nothing moves, and nothing should."""
        world, model = self.fitting, search.models[frozenset()]
        ranges = np.nanmax(world.observed, axis=(0, 1)) - np.nanmin(world.observed, axis=(0, 1))
        small = model.likelihood.sigma < 3.0 * self.floor.sigma
        still = (ranges < STILL * self.floor.sigma).all() and small.all() and len(base.untouched) == world.base.size
        if still or not ranges.any():
            vague = tuple(world.parameters[i].name for i in world.base)
            nothing = Remains(1.0, "", model.likelihood.sigma / self.floor.sigma, ())
            return Finding("unidentifiable", model, model, (), nothing, vague)
        return None

    def _verdict(self, search: Search, finding: Finding, rng: np.random.Generator) -> dict[str, Any]:
        world = self.fitting
        numbers = self._numbers(search, finding.model)
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
                    "coefficients": {n: _estimate(numbers[i]) for n, i in zip(names, places, strict=True)},
                    "p_value": cause.p_value,
                }
            )
        simulations = world.simulations + (self.measuring.simulations if self.measuring else 0)
        result = {
            "verdict": finding.verdict,
            "system": self.recording.system,
            "engine": self.engine or "its own",
            "causes": causes,
            "parameters": {world.parameters[i].name: _estimate(numbers[i]) for i in world.base.tolist()},
            "heldout": self._heldout(finding, rng),
            "candidates": self._candidates(search, finding),
            "next_experiment": self._next(search, finding),
            "simulations": int(simulations),
            "seconds": 0.0,
        }
        result["seconds"] = time.perf_counter() - self.started
        return result

    def _numbers(self, search: Search, model: Model) -> dict[int, Number]:
        """Every parameter and coefficient by its place; without an interval where it was not fitted."""
        world = self.fitting
        known = intervals(search, model)
        result = {}
        for place, parameter in enumerate(world.parameters):
            value, low, high = known.get(place, (float(model.fit.theta[place]), np.nan, np.nan))
            bounded = np.isfinite(low) and np.isfinite(high)
            result[place] = Number(value, parameter.unit, low if bounded else None, high if bounded else None)
        return result

    def _counted(self) -> list[int]:
        """Channels that share the unit of the one that sensor effects act on."""
        world = self.fitting
        units = [c.unit for c in world.simulator.channels]
        reading = world.simulator.system.reading(world.channels)
        return [c for c, unit in enumerate(units) if unit == units[world.channels.index(reading)]]

    def _sigma(self, finding: Finding) -> Array:
        """(C,) the noise floor: stated, or what a model that leaves no structure leaves."""
        left = finding.model.likelihood.sigma
        usable = ~self.floor.stated & np.isfinite(left) & (left > self.floor.sigma)
        return np.where(usable & (not finding.remains.structure), left, self.floor.sigma)

    def _heldout(self, finding: Finding, rng: np.random.Generator) -> dict[str, Any] | None:
        if self.measuring is None or finding.measured is None or finding.model.names not in finding.measured:
            return None
        counted = self._counted()
        floor = float(np.sqrt(np.square(self._sigma(finding)[counted]).mean()))
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
            rows.append({
                "effect": effect, "score": max(score, 0.0), "p_value": float(np.clip(p_value, 0.0, 1.0)),
                "heldout_gain": self._share(finding, (effect,)),
            })  # fmt: skip
        return sorted(rows, key=lambda row: -row["score"])

    def _share(self, finding: Finding, names: tuple[str, ...]) -> float | None:
        """Share of the held-out gap that a model closes; None where it was not measured."""
        if self.measuring is None or finding.measured is None or names not in finding.measured:
            return None
        counted, seen = self._counted(), np.isfinite(self.measuring.observed)
        floor = float(np.sqrt(np.square(self._sigma(finding)[counted]).mean()))
        before, after = (
            float(np.sqrt(np.square((self.measuring.observed - s)[..., counted][seen[..., counted]]).mean()))
            for s in (finding.measured[()].simulated, finding.measured[names].simulated)
        )
        share = (before - max(after, floor)) / (before - floor) if before > floor * 1.001 else 0.0
        return float(np.clip(share, -9.0, 1.0)) if np.isfinite(share) else None

    def _next(self, search: Search, finding: Finding) -> dict[str, Any] | None:
        if finding.verdict == "unidentifiable":
            names = " and ".join(finding.vague)
            differently = "they act differently from each other" if len(finding.vague) > 1 else "it makes a difference"
            return {"says": f"Measure {names} apart, or record runs in which {differently}"}
        for cause in finding.causes:
            for other in cause.alternatives:
                rest = {n for n in finding.model.names if n != cause.effect}
                rival = search.models.get(frozenset({*rest, other}))
                if rival is not None:
                    return next_experiment(search, finding.model, rival)
        return None

    def _story(self, search: Search, base: Base, finding: Finding, verdict: dict[str, Any]) -> Story:
        world, sigma = self.fitting, self._sigma(finding)
        before, after = finding.base.fit.simulated, finding.model.fit.simulated
        places = show.places(world, before, after, sigma)
        held_out = None
        if self.measuring is not None and finding.measured is not None and finding.model.names in finding.measured:
            first, last = (finding.measured[names].simulated for names in ((), finding.model.names))
            held_out = show.side(self.measuring, first, last)
            places += [p for p in show.places(self.measuring, first, last, sigma, " (held out)") if p.kind == "run"]
        channels = tuple(
            Shown(c.name, c.unit, float(sigma[i]), bool(self.floor.stated[i]), float(self.floor.step[i]))
            for i, c in enumerate(world.simulator.channels)
        )
        title = self.recording.title or self.path.stem
        return Story(
            title, self.path, verdict, channels, show.side(world, before, after), held_out, tuple(places),
            tuple(show.profiles(world, before, after, sigma)), self._tuned(search, base, finding),
            tuple(self._remains(base, finding)), tuple(self._why(finding)), finding.vague,
        )  # fmt: skip

    def _tuned(self, search: Search, base: Base, finding: Finding) -> tuple[Tuned, ...]:
        sides = [self._numbers(search, model) for model in (finding.base, finding.model)]
        result = []
        for i in self.fitting.base.tolist():
            before, after = (_triple(side[i]) for side in sides)
            parameter = self.fitting.parameters[i]
            result.append(Tuned(parameter.name, parameter.unit, before, after, i not in base.untouched))
        return tuple(result)

    def _remains(self, base: Base, finding: Finding) -> list[str]:
        lines = []
        for channel in finding.remains.loud:
            times = finding.remains.excess[self.fitting.channels.index(channel)]
            lines.append(f"channel {channel} still misses by {times:.3g} times its noise")
        if finding.remains.structure and finding.remains.where:
            lines.append(f"what is left behaves like a force that depends on {finding.remains.where}")
        untouched = [self.fitting.parameters[i].name for i in sorted(base.untouched)]
        if untouched:
            lines.append(f"the recording does not touch {', '.join(untouched)}: kept at the nominal value")
        return lines

    def _why(self, finding: Finding) -> list[str]:
        lines = []
        if finding.verdict == "unknown" and finding.causes:
            lines.append("the effects that help most do not close enough of the gap to be its explanation")
        if finding.verdict in ("partial", "unknown") and finding.remains.structure:
            chance = finding.remains.p_value
            told = f"structure is left over (chance {chance:.2g}) that the sensor's noise does not have"
            lines.append(told if chance < CHANCE else "what is left over exceeds the stated noise of the sensors")
        for cause in finding.causes:
            if cause.alternatives:
                others = ", ".join(cause.alternatives)
                lines.append(
                    f"{cause.effect} and {others} make the same difference in these runs, once parameters and initial "
                    "states are fitted with each: their likelihoods differ by odds of less than 33 to 1"
                )
        return lines

    def _extended(self, search: Search, finding: Finding) -> Extended:
        world, numbers = self.fitting, self._numbers(search, finding.model)
        own = {world.parameters[i].name: numbers[i] for i in range(world.own)}
        freed = {p.name: numbers[world.own + i].value for i, p in enumerate(world.freed)}
        added = {}
        for effect in (n for n in world.slots if n in finding.model.names):
            places = range(*world.slots[effect].indices(len(world.parameters)))
            names = [c.name for c in library.get(effect).on(world.simulator.system)]
            added[effect] = {n: numbers[i] for n, i in zip(names, places, strict=True)}
        return Extended(
            f"{self.recording.system}_extended", self.recording.system, self.engine, self.recording.title, own, added,
            {**self.recording.constants, **freed}, world.channels,
        )  # fmt: skip


def _estimate(number: Number) -> dict[str, Any]:
    return {"value": number.value, "unit": number.unit, "low": number.low, "high": number.high}


def _triple(number: Number) -> tuple[float, float, float]:
    low, high = (np.nan if bound is None else bound for bound in (number.low, number.high))
    return number.value, low, high


def _heldout(found: Gain, unit: str) -> dict[str, Any] | None:
    """As in verdict.json; an interval that the data do not give is null."""
    values = {
        "rmse_base": found.base, "rmse_extended": found.extended, "noise_floor": found.floor,
        "gap_closed": found.closed, "low": found.low, "high": found.high,
    }  # fmt: skip
    return {**{k: v if np.isfinite(v) else None for k, v in values.items()}, "unit": unit}
