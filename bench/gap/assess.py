"""Build the verdict from a finding: intervals, held-out gain and ranked candidates."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np

from bench.gap.causes import rules
from bench.gap.causes.alternatives import Evidence
from bench.gap.causes.name import Finding
from bench.gap.causes.score_test import tail
from bench.gap.causes.search import Search
from bench.gap.friction_form import form_of, with_solver_parameters
from bench.gap.held_out import Validation
from bench.gap.measure import Gain, gain, intervals
from bench.gap.model.bounds import bound_of, coefficient_bounds, is_unusual
from bench.gap.model.floor import Floor
from bench.gap.model.models import Model, Names
from bench.gap.model.time_scale import is_instant
from bench.gap.model.world import World
from bench.gap.propose import Experiment, next_experiment
from bench.gap.verdict import Candidate, Cause, Heldout, Verdict, finite
from bench.problem.seeds import rng_for
from sims.base import Array
from sims.extended import Number
from sims.recording.recording import Recording
from sims.robot.causes import GRAVITY_COMPENSATED, is_gravity_compensated
from sims.system import Effect, members_of

WORST = -9.0
"""Lower limit of a candidate's reported share of the held-out gap; it only means "worse"."""


@dataclass(frozen=True)
class Assessor:
    """Builds the verdict and its numbers from a finding.

    Attributes:
        recording: Recording that is explained.
        fitting: Run evaluator of the runs for fitting.
        validation: Validation on held-out runs or by cross-validation; None without either.
        floor: Noise floor of each channel.
        engine: Name of the engine; None for a simulator with its own integrator.
        before: Base prediction of the held-out runs with the model file's own step, if that step
            was found too coarse; otherwise None.
    """

    recording: Recording
    fitting: World
    validation: Validation | None
    floor: Floor
    engine: str | None
    before: Array | None = None

    @property
    def measuring(self) -> World | None:
        """Return the runs that the validation predicts; all runs if it is cross-validation."""
        return None if self.validation is None else self.validation.world

    @property
    def _by_stretches(self) -> bool:
        """Return whether gains are resampled by segments, because cross-validated runs are few."""
        return self.validation is not None and self.validation.is_cross_validation

    def verdict(
        self, search: Search, finding: Finding, rng: np.random.Generator, started: float
    ) -> Verdict:
        """Build the verdict for a finding.

        Args:
            search: Search that produced the finding.
            finding: Outcome of the search.
            rng: Random generator of the bootstrap.
            started: Value of `time.perf_counter` at the start of the diagnosis.
        """
        world = self.fitting
        numbers = self.numbers(search, finding.model)
        causes = self.causes(search, finding)
        parameters = {world.parameters[i].name: numbers[i] for i in world.base.tolist()}
        # Simulations for the proposal of an experiment are not part of the answer.
        simulations = world.simulations
        if self.validation is not None:
            simulations += self.validation.simulations
        heldout = self._heldout(finding, rng)
        candidates = self._candidates(search, finding)
        proposed = self._next(search, finding)
        return Verdict(
            finding.verdict,
            self.recording.system,
            self.engine or "its own",
            causes,
            parameters,
            heldout,
            candidates,
            proposed,
            int(simulations),
            time.perf_counter() - started,
            finding.cut,
        )

    def causes(self, search: Search, finding: Finding) -> tuple[Cause, ...]:
        """Return the causes of a finding with their fitted numbers.

        Args:
            search: Search that produced the finding.
            finding: Outcome of the search.
        """
        numbers = self.numbers(search, finding.model)
        return tuple(self._cause(cause, numbers) for cause in finding.causes)

    def numbers(self, search: Search, model: Model) -> dict[int, Number]:
        """Collect the estimates of all parameters and coefficients by index.

        Args:
            search: Search that produced the model.
            model: Fitted model.

        Returns:
            Estimates by index in the parameter vector; those that were not fitted have no interval.
        """
        fitted = intervals(search, model)
        ranges = self._ranges(model)
        result = {}
        for place, parameter in enumerate(self.fitting.parameters):
            # Insensitive parameters stay nominal; effects that are not in the model are zero.
            given = float(model.fit.theta[place]), np.nan, np.nan
            value, low, high = fitted.get(place, given)
            if is_instant(parameter):
                # The time of an event is only known to one sample spacing.
                low, high = low - self.fitting.spacing / 2, high + self.fitting.spacing / 2
            at_bound = bound_of(value, *ranges[place]) if place in fitted else None
            # JSON has no number for an unknown bound; at a bound the curvature gives no interval.
            bounded = np.isfinite(low) and np.isfinite(high) and at_bound is None
            ends = (low, high) if bounded else (None, None)
            usual = self._usual(place) if place in fitted else parameter.bounds
            unusual = usual if not is_instant(parameter) and is_unusual(value, *usual) else None
            unit = parameter.unit
            low_end, high_end = ends
            result[place] = Number(value, unit, low_end, high_end, at_bound, usual_range=unusual)
        return self._with_totals(model, result)

    def _usual(self, place: int) -> tuple[float, float]:
        """Return the plausible range, narrower than the bounds for a robot's free numbers."""
        parameter = self.fitting.parameters[place]
        free = self.fitting.kind.has_model and place in self.fitting.base
        return parameter.training or parameter.bounds if free else parameter.bounds

    def _with_totals(self, model: Model, numbers: dict[int, Number]) -> dict[int, Number]:
        """Add specified and resulting values to the numbers that a robot's model file contains."""
        kind: Any = self.fitting.kind
        if not kind.has_model:
            return numbers
        # This import is needed for robots only.
        from sims.robot.totals import totals

        placed = list(self._placed(model))
        fitted = [(effect, [numbers[i].value for i in places]) for effect, places in placed]
        for (effect, places), made in zip(placed, totals(kind.robot, fitted), strict=True):
            # The model file keeps its gravity if the bodies are gravity-compensated.
            keeps = is_gravity_compensated(effect.name, {"": numbers[places[0]]})
            if keeps or not any(numbers[i].value for i in places):
                continue
            for i, found in zip(places, made, strict=True):
                if found is not None:
                    unit = found.unit if found.unit != numbers[i].unit else ""
                    stated, total = found.stated, found.total
                    numbers[i] = replace(numbers[i], stated=stated, total=total, total_unit=unit)
        return numbers

    def _placed(self, model: Model) -> Iterator[tuple[type[Effect], list[int]]]:
        """Yield the fitted effects with a single place, and the indices of their coefficients."""
        world, kind = self.fitting, cast(Any, self.fitting.kind)
        # The free numbers of the user come first, in the order of their effects.
        places = iter(range(world.own))
        for effect in kind.system.freed_effects:
            yield effect, [next(places) for _ in effect.coefficients]
        for name in model.names:
            effect = world.effects[name]
            members = members_of(effect)
            places = iter(world.places(name))
            # A family with one coefficient for all places changes no number of the file.
            if sum(len(member.coefficients) for member in members) == len(world.places(name)):
                for member in members:
                    yield type(member), [next(places) for _ in member.coefficients]

    def _ranges(self, model: Model) -> dict[int, tuple[float, float]]:
        """Return the range of each fitted number, by index in the parameter vector."""
        world = self.fitting
        ranges = {i: world.parameters[i].bounds for i in world.base.tolist()}
        for name in model.names:
            ranges |= dict(zip(world.places(name), coefficient_bounds(world, name), strict=True))
        return ranges

    def judged(self, search: Search, finding: Finding) -> Finding:
        """Return the finding with the verdict that its numbers and the fitted models allow.

        Args:
            search: Search that produced the finding.
            finding: Outcome of the search.
        """
        if finding.verdict == "unknown" and self._refutes(search, finding):
            return replace(finding, verdict="adequate")
        numbers = self.numbers(search, finding.model)
        certain = [cause for cause in finding.causes if not cause.alternatives]
        places = [i for cause in certain for i in self.fitting.places(cause.effect)]
        results = all(numbers[i].is_result for i in places) and not self._ends_at_bound(numbers)
        return replace(finding, verdict=rules.verdict_of_numbers(finding.verdict, results))

    def _refutes(self, search: Search, finding: Finding) -> bool:
        """Return whether fitted models refute a missing effect that only the linear score suggests.

        This is so if no fitted model with effects has a higher penalised log-likelihood than the
        base model, or none predicts the held-out runs better. In closed loops and at rest,
        derivatives may predict a gain that no fit achieves.
        """
        if finding.causes or finding.remains.structure or finding.cut is not None:
            return False
        tried = [model for model in search.models.values() if model.names]
        better = [model.names for model in tried if model.merit > search.base.merit]
        held_out = finding.measured or {}
        excess = self._held_out_excess(finding)
        if not tried or (excess is not None and rules.is_missed(excess, excess)):
            return False
        return not any(
            names not in held_out or held_out[names].merit > held_out[()].merit for names in better
        )

    def _held_out_excess(self, finding: Finding) -> float | None:
        """Return the excess RMS residual of the base model on held-out runs; None without them."""
        runs, measured = self.measuring, finding.measured
        if runs is None or measured is None or () not in measured:
            return None
        left = (runs.observed - measured[()].simulated) / self.floor.sigma
        return float(np.sqrt(np.square(left[np.isfinite(runs.observed)]).mean())) - 1.0

    def _ends_at_bound(self, numbers: Mapping[int, Number]) -> bool:
        """Return whether a base parameter of the extended model is at a bound of its range.

        A cause may then compensate for a value beyond the bound.
        """
        fitted = [numbers[i] for i in self.fitting.base.tolist()]
        return any(n.at_bound is not None and not n.is_result for n in fitted)

    def sigma(self, finding: Finding) -> Array:
        """Return the noise floor (C,).

        It is the specified noise, or else the residual of a model without lack of fit.
        """
        left = finding.model.likelihood.sigma
        # The noise estimate assumes white noise, so the residual of a good model may exceed it.
        usable = ~self.floor.stated & np.isfinite(left) & (left > self.floor.sigma)
        return np.where(usable & (not finding.remains.structure), left, self.floor.sigma)

    def _cause(self, evidence: Evidence, numbers: dict[int, Number]) -> Cause:
        world = self.fitting
        # The coefficients of an effect are contiguous in the parameter vector, in the effect's
        # order.
        effect = world.effects[evidence.effect]
        coefficients = effect.on(world.simulator.system)
        places = range(*world.slots[evidence.effect].indices(len(world.parameters)))
        # A coefficient that cannot be observed is fixed at zero and is not a result.
        by_name = {
            c.name: numbers[i]
            for c, i in zip(coefficients, places, strict=True)
            if c.least is None or c.least != c.most
        }
        form = form_of(world, evidence.effect)
        says = effect.says
        if form is not None:
            says = with_solver_parameters(world, evidence.effect, says)
        if world.kind.has_model and is_gravity_compensated(evidence.effect, by_name):
            says = GRAVITY_COMPENSATED
        return Cause(evidence.effect, evidence.alternatives, says, by_name, evidence.p_value, form)

    def _counted(self) -> list[int]:
        """List the channels with the same unit as the channel that sensor effects act on."""
        world = self.fitting
        units = [channel.unit for channel in world.simulator.channels]
        reading = world.simulator.system.reading(world.channels)
        # Errors of different units cannot be added.
        unit = units[world.channels.index(reading)]
        return [c for c, other in enumerate(units) if other == unit]

    def _floor_of(self, finding: Finding) -> float:
        """Compute the RMS of the noise floor over the channels that count."""
        return float(np.sqrt(np.square(self.sigma(finding)[self._counted()]).mean()))

    def _heldout(self, finding: Finding, rng: np.random.Generator) -> Heldout | None:
        runs, measured, names = self.measuring, finding.measured, finding.model.names
        if runs is None or measured is None or names not in measured:
            return None
        before, after = measured[()].simulated, measured[names].simulated
        before = before if self.before is None else self.before
        # Without a prediction of the base model there is no gap to measure.
        if not np.isfinite(before[np.isfinite(runs.observed)]).all():
            return None
        counted = self._counted()
        given = counted, self._floor_of(finding), rng, self._by_stretches
        result = gain(runs, before, after, *given)
        return _heldout(result, self.fitting.simulator.channels[counted[0]].unit)

    def _candidates(self, search: Search, finding: Finding) -> tuple[Candidate, ...]:
        """List all effects of the library with their scores about the base model, best first.

        A score is reduced by the price of each coefficient beyond the first, so that an effect
        precedes more general effects that contain it.
        """
        scores = search.about_base
        if scores is None:
            return ()
        base = search.base.likelihood.value
        rows = []
        for i, effect in enumerate(scores.effects):
            score = float(scores.score[i])
            # A fit may gain more than the linear score predicts, in particular far from the data.
            alone = search.models.get(frozenset({effect}))
            if alone is not None:
                score = max(score, float(alone.likelihood.value - base))
            beyond_chance = np.array([score - scores.chance[i]])
            p_value = float(np.clip(tail(scores.by_chance, beyond_chance), 0.0, 1.0))
            share = self._share(finding, (effect,))
            slot = search.world.slots[effect]
            score -= search.price * (slot.stop - slot.start - 1)
            rows.append(Candidate(effect, max(score, 0.0), p_value, share))
        return tuple(sorted(rows, key=lambda row: -row.score))

    def _share(self, finding: Finding, names: Names) -> float | None:
        """Return the share of the held-out gap that a model closes; None if it is not measured."""
        runs, measured = self.measuring, finding.measured
        if runs is None or measured is None or names not in measured:
            return None
        counted = self._counted()
        floor = self._floor_of(finding)
        # As for the gain of the whole model, an error below the noise floor is not a gain.
        before = _rmse(runs, measured[()].simulated, counted)
        after = _rmse(runs, measured[names].simulated, counted)
        share = 0.0
        # At the noise floor there is no gap, and the quotient would be a rounding error.
        if before > floor * 1.001:
            share = (before - max(after, floor)) / (before - floor)
        return float(np.clip(share, WORST, 1.0)) if np.isfinite(share) else None

    def share_intervals(self, finding: Finding) -> dict[str, tuple[float, float]]:
        """Compute 95 % intervals of the share of the held-out gap that single effects close.

        Args:
            finding: Outcome of the search, with the simulated held-out runs.

        Returns:
            Low and high end by effect, for effects that were simulated alone on held-out runs.
        """
        runs, measured = self.measuring, finding.measured
        if runs is None or measured is None:
            return {}
        before = measured[()].simulated
        found = {}
        for names, simulated in measured.items():
            share = self._share(finding, names)
            if len(names) != 1 or share is None or share <= WORST:
                continue
            # Each effect has its own random stream, so that its interval does not depend on the
            # others.
            rng = rng_for("held-out share", *names)
            given = self._counted(), self._floor_of(finding), rng, self._by_stretches
            result = gain(runs, before, simulated.simulated, *given)
            if np.isfinite(result.low) and np.isfinite(result.high):
                found[names[0]] = result.low, result.high
        return found

    def _next(self, search: Search, finding: Finding) -> Experiment | None:
        """Propose the next experiment; None if nothing is open or the search was stopped early."""
        if finding.cut is not None:
            return None
        if finding.verdict == "unidentifiable":
            return _apart(finding.vague)
        # Causes come strongest first, and alternatives most plausible first.
        for cause in finding.causes:
            for other in cause.alternatives:
                rest = {name for name in finding.model.names if name != cause.effect}
                rival = search.models.get(frozenset({*rest, other}))
                if rival is not None:
                    return next_experiment(search, finding.model, rival)
        return None


def _rmse(world: World, simulated: Array, channels: list[int]) -> float:
    """Compute the RMS error over the channels that count, in their unit."""
    seen = np.isfinite(world.observed)[..., channels]
    error = (world.observed - simulated)[..., channels][seen]
    return float(np.sqrt(np.square(error).mean()))


def _apart(vague: tuple[str, ...]) -> Experiment:
    """Propose how to identify parameters that the data do not identify."""
    several = len(vague) > 1
    how = "they act differently from each other" if several else "it makes a difference"
    names = " and ".join(vague)
    return Experiment(f"Measure {names} apart, or record runs in which {how}")


def _heldout(found: Gain, unit: str) -> Heldout:
    """Convert a gain to the form of the verdict; an interval that the data do not give is None."""
    return Heldout(
        finite(found.base),
        finite(found.extended),
        finite(found.floor),
        finite(found.closed),
        finite(found.low),
        finite(found.high),
        unit,
    )
