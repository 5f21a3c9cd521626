"""`simgap explain`: a recording in, a verdict, an extended simulator and a report out. The four
steps in order.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from bench.gap.assess import Assessor
from bench.gap.causes.name import Finding, name
from bench.gap.causes.rules import CHANCE
from bench.gap.causes.search import Search
from bench.gap.causes.structure import Hat
from bench.gap.explanation import Explanation
from bench.gap.measure import HeldOutRuns
from bench.gap.model.base_fit import Base, fit_base
from bench.gap.model.floor import Floor, noise_floor
from bench.gap.model.noise import Noise
from bench.gap.model.world import World
from bench.gap.report import show
from bench.gap.report.story import Shown, Story, Tuned
from bench.gap.verdict import Verdict
from bench.problem.seeds import rng_for
from bench.recordings.inspection import load
from sims import effects as library
from sims import extended as extend
from sims.base import Array, InputError
from sims.extended import Extended, Number
from sims.own import OwnSimulator
from sims.recording.recording import Recording
from sims.simulated import Simulated

LEAST = 2.0
"""Samples for each unknown without which nothing can be said."""
SPARE = 4
"""Samples that there must be besides."""
HUGE = 1e9
"""Values so many times a channel's typical size are none."""
Say = Callable[[str], None]


def explain(
    recording: str | Path | Recording,
    system: str | None = None,
    engine: str = "batch",
    seed: int = 0,
    free: Sequence[str] = (),
    tuner: str | None = None,
    say: Say = lambda _: None,
) -> Explanation:
    """Explain a recording.

    Args:
        recording: the path of the table, or a recording that is in memory.
        system: take it for this system, whatever the description says.
        engine: pybullet, mujoco or batch; a simulator that steps itself has its own.
        seed: of the surrogates and the bootstrap.
        free: constants to estimate with the parameters.
        tuner: a registered tuner that finds where the fit of the base parameters begins.
        say: told what is being done.

    Raises:
        InputError: the recording cannot be read, is too short, or is of nothing that takes effects.
    """
    return _Explainer(recording, system, engine, seed, tuple(free), tuner, say).run()


class _Explainer:
    def __init__(
        self,
        source: str | Path | Recording,
        system: str | None,
        engine: str,
        seed: int,
        free: tuple[str, ...],
        tuner: str | None,
        say: Say,
    ) -> None:
        self.started, self.seed, self.tuner, self.say = time.perf_counter(), seed, tuner, say
        self.recording, kind = load(source, system)
        self.path = self.recording.path
        if not issubclass(kind, Simulated):
            raise InputError(
                f"{self.path}: simulator {self.recording.system} takes no effects, "
                "so nothing can be missing from it"
            )
        extend.refuse_extended(kind)
        self.kind: type[Simulated] = kind
        self.engine = None if issubclass(kind, OwnSimulator) else engine
        self.fitting = World(
            kind, self.recording, self.recording.training(), self.engine, [Hat], free
        )
        held_out = self.recording.held_out()
        # The same effects in the same places, so that a fitted vector means the same there.
        self.measuring = (
            World(kind, self.recording, held_out, self.engine, [Hat], free) if held_out else None
        )
        self.floor: Floor = noise_floor(self.fitting, self.recording)
        self.noise = Noise(self.floor.sigma, np.zeros(len(self.floor.sigma)))
        self.assessor = Assessor(
            self.recording, self.fitting, self.measuring, self.floor, self.engine
        )
        self._check()

    def _check(self) -> None:
        world = self.fitting
        samples = int(np.isfinite(world.observed).sum())
        unknowns = world.base.size + int((~world.known).sum())
        if samples < LEAST * unknowns + SPARE:
            least = int(LEAST * unknowns) + SPARE
            raise InputError(
                f"{self.path}: too short: {samples} samples for fitting, "
                f"expected at least {least} for {unknowns} parameters and initial states"
            )
        # What is larger by so many orders is of a wrong unit, and nothing that a fit could follow.
        parts = [part.observed for part in (world, self.measuring) if part is not None]
        for c, channel in enumerate(world.simulator.channels):
            largest = max(float(np.nanmax(np.abs(part[..., c]), initial=0.0)) for part in parts)
            if largest >= HUGE * channel.scale:
                raise InputError(
                    f"{self.path}: column {channel.name}: expected values of about "
                    f"{channel.scale:g} {channel.unit}, found {largest:.3g}; is the unit right?"
                )

    def run(self) -> Explanation:
        self.say("fitting the base model")
        base = fit_base(self.fitting, self.noise, self._given())
        rng = rng_for("explain", self.recording.system, self.seed)
        search = Search(self.fitting, self.noise, base.untouched, rng, self.floor.stated)
        search.enter(base.fit)
        self.say("looking for what is missing")
        held_out = HeldOutRuns(self.measuring, self.noise) if self.measuring else None
        finding = name(search, held_out)
        self.say("measuring the gain")
        verdict = self.assessor.verdict(search, finding, rng, self.started)
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
        from bench.gap.model.tuner_start import tuned

        return tuned(self.tuner, self.fitting, self.noise, self.seed)

    def _story(self, search: Search, base: Base, finding: Finding, verdict: Verdict) -> Story:
        world, sigma = self.fitting, self.assessor.sigma(finding)
        before, after = finding.base.fit.simulated, finding.model.fit.simulated
        places = show.places(world, before, after, sigma)
        held_out = None
        if (
            self.measuring is not None
            and finding.measured is not None
            and finding.model.names in finding.measured
        ):
            first, last = (finding.measured[names].simulated for names in ((), finding.model.names))
            held_out = show.side(self.measuring, first, last)
            there = show.places(self.measuring, first, last, sigma, " (held out)")
            # Channels and phases are told of the fitted runs alone; of held-out ones, each run.
            places += [place for place in there if place.kind == "run"]
        channels = tuple(
            Shown(
                c.name,
                c.unit,
                float(sigma[i]),
                bool(self.floor.stated[i]),
                float(self.floor.step[i]),
            )
            for i, c in enumerate(world.simulator.channels)
        )
        title = self.recording.title or self.path.stem
        return Story(
            title,
            self.path,
            verdict,
            channels,
            show.side(world, before, after),
            held_out,
            tuple(places),
            tuple(show.profiles(world, before, after, sigma)),
            self._tuned(search, base, finding),
            tuple(self._remains(base, finding)),
            tuple(self._why(finding)),
            finding.vague,
        )

    def _tuned(self, search: Search, base: Base, finding: Finding) -> tuple[Tuned, ...]:
        sides = [self.assessor.numbers(search, model) for model in (finding.base, finding.model)]
        result = []
        for i in self.fitting.base.tolist():
            before, after = (_triple(side[i]) for side in sides)
            parameter = self.fitting.parameters[i]
            result.append(
                Tuned(parameter.name, parameter.unit, before, after, i not in base.untouched)
            )
        return tuple(result)

    def _remains(self, base: Base, finding: Finding) -> list[str]:
        lines = []
        for channel in finding.remains.loud:
            times = finding.remains.excess[self.fitting.channels.index(channel)]
            lines.append(f"channel {channel} still misses by {times:.3g} times its noise")
        if finding.remains.structure and finding.remains.where:
            lines.append(
                f"what is left behaves like a force that depends on {finding.remains.where}"
            )
        untouched = [self.fitting.parameters[i].name for i in sorted(base.untouched)]
        if untouched:
            lines.append(
                f"the recording does not touch {', '.join(untouched)}: kept at the nominal value"
            )
        return lines

    def _why(self, finding: Finding) -> list[str]:
        lines = []
        if finding.verdict == "unknown" and finding.causes:
            lines.append(
                "the effects that help most do not close enough of the gap to be its explanation"
            )
        if finding.verdict in ("partial", "unknown") and finding.remains.structure:
            chance = finding.remains.p_value
            left = "what is left over exceeds the stated noise of the sensors"
            if chance < CHANCE:
                left = (
                    f"structure is left over (chance {chance:.2g}) "
                    "that the sensor's noise does not have"
                )
            lines.append(left)
        for cause in finding.causes:
            if cause.alternatives:
                others = ", ".join(cause.alternatives)
                lines.append(
                    f"{cause.effect} and {others} make the same difference in these runs, "
                    "once parameters and initial states are fitted with each: "
                    "their likelihoods differ by odds of less than 33 to 1"
                )
        return lines

    def _extended(self, search: Search, finding: Finding) -> Extended:
        world, numbers = self.fitting, self.assessor.numbers(search, finding.model)
        own = {world.parameters[i].name: numbers[i] for i in range(world.own)}
        # A freed constant is a constant of the extended simulator, with the value that was fitted.
        freed = {p.name: numbers[world.own + i].value for i, p in enumerate(world.freed)}
        added = {}
        for effect in (n for n in world.slots if n in finding.model.names):
            places = range(*world.slots[effect].indices(len(world.parameters)))
            names = [c.name for c in library.get(effect).on(world.simulator.system)]
            added[effect] = {n: numbers[i] for n, i in zip(names, places, strict=True)}
        return Extended(
            f"{self.recording.system}_extended",
            self.recording.system,
            self.engine,
            self.recording.title,
            own,
            added,
            {**self.recording.constants, **freed},
            world.channels,
            self.kind,
        )


def _triple(number: Number) -> tuple[float, float, float]:
    low, high = (np.nan if bound is None else bound for bound in (number.low, number.high))
    return number.value, low, high
