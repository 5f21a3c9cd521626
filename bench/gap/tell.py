"""Tells a finding: gathers what account, figures and page say of it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from bench.gap.apart import Apart, Spread, spreads
from bench.gap.assess import Assessor
from bench.gap.causes.name import Finding
from bench.gap.causes.rules import CHANCE
from bench.gap.causes.search import Search
from bench.gap.identify import Number, identified
from bench.gap.model.base_fit import Base
from bench.gap.report import show
from bench.gap.report.places import of_set
from bench.gap.report.story import Place, Shown, Side, Story, Tuned
from bench.gap.report.words import END, in_file
from bench.gap.verdict import Verdict
from sims.base import Array
from sims.extended import Number as Estimate

TRACKED = {"u", "v", "radius_px"}
"""Columns that tell the recording of a tracked film."""
PNG = b"\x89PNG\r\n\x1a\n"
"""How a file of that kind begins."""
MOST_PICTURE = 1_000_000
"""Bytes of the picture of a track that a page takes in."""


@dataclass(frozen=True)
class Teller:
    """Tells what was found.

    Attributes:
        assessor: puts it into numbers; it knows the recording, the worlds and the noise.
        search: that has found it.
        base: the fit of the base model.
        finding: what was found.
        notes: what else is to be borne in mind, a sentence each.
    """

    assessor: Assessor
    search: Search
    base: Base
    finding: Finding
    notes: tuple[str, ...] = ()

    def story(self, verdict: Verdict) -> Story:
        """The story of a verdict on the finding."""
        world = self.assessor.fitting
        recording = self.assessor.recording
        before = self.finding.base.fit.simulated
        after = self.finding.model.fit.simulated
        # Of the finding, not of the recording: a good model knows the noise better.
        sigma = self.assessor.sigma(self.finding)
        held_out, held_out_places = self._held_out(sigma)
        return Story(
            # A recording without a description is known by its file.
            recording.title or recording.path.stem,
            recording.path,
            verdict,
            self._channels(sigma),
            show.side(world, before, after),
            held_out,
            (*show.places(world, before, after, sigma), *held_out_places),
            tuple(show.profiles(world, before, after, sigma)),
            tuple(self._parameters()),
            () if verdict.recording_faults else tuple(self._remains()),
            () if verdict.recording_faults else tuple(self._why()),
            self.finding.vague,
            show.robot_of(world),
            fixable=self._fixable(),
            apart=Apart() if verdict.recording_faults else self._apart(),
            track=self._track(),
            logs=max(1, len({run.log for run in recording.runs})),
            thorough=self.search.thorough,
            cross_validated=self._is_cross_validated,
            share_intervals=self.assessor.share_intervals(self.finding),
        )

    def _track(self) -> bytes:
        """The picture that tracking a film has put beside its recording; nothing of others."""
        recording = self.assessor.recording
        path = recording.path.with_suffix(".png")
        if not recording.extra.keys() >= TRACKED:
            return b""
        try:
            with path.open("rb") as file:
                picture = file.read(MOST_PICTURE + 1)
        except OSError:
            return b""
        return picture if picture.startswith(PNG) and len(picture) <= MOST_PICTURE else b""

    def _apart(self) -> Apart:
        """What runs, logs and loads say by themselves, of the base model and of what was found."""
        if self.finding.cut is not None or self.finding.vague:
            return Apart()
        before = spreads(self.search, self.finding.base)
        after = spreads(self.search, self.finding.model) if self.finding.model.names else before
        return Apart(before, after, self._rival())

    def _rival(self) -> tuple[Spread, ...]:
        """Of one cause: what its best rival's coefficients would have to be in each group."""
        if len(self.finding.causes) != 1:
            return ()
        (cause,) = self.finding.causes
        alike = {cause.effect, *cause.alternatives, *self.finding.model.names}
        singles = [m for m in self.search.models.values() if len(m.names) == 1]
        others = [
            model
            for model in singles
            if not alike & set(model.names)
            and np.isfinite(model.merit)
            # A number that moves is to be seen in effects that are one number.
            and len(self.search.world.places(model.names[0])) == 1
        ]
        if not others:
            return ()
        best = max(others, key=lambda model: model.merit)
        (name,) = best.names
        own = [one for one in spreads(self.search, best) if one.number.startswith(name)]
        return tuple(own)

    def _fixable(self) -> tuple[Number, ...]:
        """What the recording can say at all, by what was simulated about the base model anyway."""
        key: frozenset[str] = frozenset()
        scanned = self.search.scanned.get(key) or self.search.former.get(key)
        known = self.search.directions_known()
        if known is not None:
            return identified(self.search.world, self.search.noise, *known)
        if scanned is None:
            return ()
        return identified(self.search.world, self.search.noise, scanned.at, scanned.directions)

    @property
    def _is_cross_validated(self) -> bool:
        validation = self.assessor.validation
        return validation is not None and validation.is_cross_validation

    @property
    def _how_validated(self) -> str:
        return "left out" if self._is_cross_validated else "held out"

    def _held_out(self, sigma: Array) -> tuple[Side | None, list[Place]]:
        """The held-out runs and where their gap is; None and nothing where none was measured."""
        world = self.assessor.measuring
        measured = self.finding.measured
        names = self.finding.model.names
        # Where the data do not fix the base model, nothing is tried on held-out runs.
        if world is None or measured is None or names not in measured:
            return None, []
        before = measured[()].simulated
        after = measured[names].simulated
        places = show.places(world, before, after, sigma, f" ({self._how_validated})")
        # Channels and phases are told of the fitted runs alone; of held-out ones, each run.
        runs = [place for place in places if place.kind == "run"]
        return show.side(world, before, after), runs

    def _channels(self, sigma: Array) -> tuple[Shown, ...]:
        floor = self.assessor.floor
        rows = zip(
            self.assessor.fitting.simulator.channels,
            sigma.tolist(),
            floor.stated.tolist(),
            floor.step.tolist(),
            strict=True,
        )
        return tuple(Shown(c.name, c.unit, size, stated, step) for c, size, stated, step in rows)

    def _parameters(self) -> Iterator[Tuned]:
        """The base parameters before and after; those that the data do not touch are marked."""
        world = self.assessor.fitting
        before = self.assessor.numbers(self.search, self.finding.base)
        after = self.assessor.numbers(self.search, self.finding.model)
        for i in world.base.tolist():
            parameter = world.parameters[i]
            touched = i not in self.base.frozen
            yield Tuned(
                parameter.name,
                parameter.unit,
                _triple(before[i]),
                _triple(after[i]),
                touched,
                (before[i].at_bound, after[i].at_bound),
                in_file(after[i]),
            )

    def _remains(self) -> Iterator[str]:
        """What the extended model leaves unexplained, and what to bear in mind."""
        world = self.assessor.fitting
        remains = self.finding.remains
        for channel in remains.loud:
            times = remains.excess[world.channels.index(channel)]
            yield f"channel {channel} still misses by {times:.3g} times its noise"
        # Where the test for a force of any shape does not apply, there is nothing to name.
        if remains.structure and remains.where:
            yield f"what is left behaves like a force that depends on {remains.where}"
        untouched = [world.parameters[i].name for i in sorted(self.base.untouched)]
        if untouched:
            names = ", ".join(untouched)
            yield f"the recording does not touch {names}: kept at the nominal value"
        vague = [world.parameters[i].name for i in sorted(self.base.vague)]
        if vague:
            names = ", ".join(vague)
            yield f"the recording does not fix {names} beside the others: kept at the nominal value"
        yield from self._bordering()
        yield from self.notes

    def _bordering(self) -> Iterator[str]:
        """Parameters that a fit leaves at a bound of their range."""
        for one in self._parameters():
            values = one.before[0], one.after[0]
            for when, value, bound in zip(
                ("in the base fit ", ""), values, one.bounds, strict=True
            ):
                if bound is None:
                    continue
                yield (
                    f"{when}{one.name} lies at the {END[bound]} bound of its range, {value:g}"
                    f" {one.unit}: larger ranges were not searched, and a cause may compensate for"
                    " a value beyond the bound. Check the units and constants of the recording"
                )
                break

    def _why(self) -> Iterator[str]:
        """Why the verdict is what it is, the most important first."""
        finding = self.finding
        if finding.cut is not None:
            return
        if finding.verdict == "unknown" and finding.causes:
            yield "the effects that help most do not close enough of the gap to be its explanation"
        if finding.verdict in ("partial", "unknown") and finding.remains.structure:
            yield self._structure()
        for cause in finding.causes:
            if cause.alternatives:
                names = [cause.effect, *cause.alternatives]
                placed = any("@" in name for name in names)
                all_of_them = of_set(names, "and") if placed else _named(names)
                yield (
                    f"{all_of_them} make the same difference in these runs, "
                    "once parameters and initial states are fitted with each: "
                    "their likelihoods differ by odds of less than 33 to 1"
                )

    def _structure(self) -> str:
        chance = self.finding.remains.p_value
        # Both count as structure: a residual with a pattern, and one that is merely too large.
        if chance < CHANCE:
            return (
                f"structure is left over (chance {chance:.2g}) "
                "that the sensor's noise does not have"
            )
        return "what is left over exceeds the stated noise of the sensors"


def _named(effects: list[str]) -> str:
    """Registered names in a row."""
    return f"{effects[0]} and {', '.join(effects[1:])}"


def _triple(number: Estimate) -> tuple[float, float, float]:
    """Value and interval as figures have them: NaN where the data give no bound."""
    low = np.nan if number.low is None else number.low
    high = np.nan if number.high is None else number.high
    return number.value, low, high
