"""Diagnose a recording: search for causes, validate them on held-out runs, and select a verdict.

The questions are asked in order. Does anything move? Do the data determine the base parameters?
Which effects does the search find, and are they better than their rivals? Do held-out runs confirm
them? Which alternatives explain the data as well? Does the residual have structure? The thresholds
are in `bench.gap.causes.rules`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from bench.gap.causes import rules
from bench.gap.causes.alternatives import Alternatives, Evidence
from bench.gap.causes.foresee import sought
from bench.gap.causes.rules import State, VerdictName, verdict_of, verdict_of_cut
from bench.gap.causes.search import Search
from bench.gap.causes.settle import rivals, settle
from bench.gap.causes.structure import Remains, remains, unasked
from bench.gap.causes.trial import Trial
from bench.gap.held_out import Measured, Validation
from bench.gap.measure import covariance
from bench.gap.model.models import Model, Names
from bench.gap.model.watch import Cut, EndedError
from sims.base import Array

SHOWN = 6
"""Number of best single-effect models that are evaluated on held-out runs, for display."""


@dataclass(frozen=True)
class Finding:
    """Result of a diagnosis.

    Attributes:
        verdict: one of six verdicts.
        model: the extended model; the base model if no cause was found.
        base: the base model.
        causes: the causes, strongest first.
        remains: lack-of-fit result of the extended model.
        vague: names of base parameters that the data do not determine.
        measured: models on held-out runs, by their effects; None if there are none.
        cut: early end of the search with its open questions; None if it was completed.
    """

    verdict: VerdictName
    model: Model
    base: Model
    causes: tuple[Evidence, ...]
    remains: Remains
    vague: tuple[str, ...] = ()
    measured: Mapping[Names, Measured] | None = None
    cut: Cut | None = None


def name(search: Search, held_out: Validation | None) -> Finding:
    """Search, validate on held-out runs, collect alternatives, and select a verdict.

    Args:
        search: the search, which contains the fitted base model.
        held_out: held-out runs for validation; None if there are none.
    """
    return answer(Inquiry(search, held_out))


def answer(inquiry: Inquiry) -> Finding:
    """Answer all questions, or those for which there is time."""
    try:
        return inquiry.answered()
    except EndedError:
        return inquiry.so_far()


class Inquiry:
    """The steps of a diagnosis, and their results so far.

    Args:
        search: the search, which contains the fitted base model.
        held_out: predicts held-out runs, or each run by cross-validation; None if neither is
            possible.
    """

    def __init__(self, search: Search, held_out: Validation | None) -> None:
        self._search = search
        self._held_out = held_out
        self._watch = search.world.watch
        self._trial: Trial | None = None
        self._model: Model | None = None

    def answered(self) -> Finding:
        """Return the result of the complete diagnosis.

        Raises:
            EndedError: the search had to end early.
        """
        unfit = self.unfit_base()
        if unfit is not None:
            return unfit
        search, base = self._search, self._search.base
        self._watch.begin("search")
        self._model = sought(search)
        self._watch.begin("rivals")
        self._model = search.plainer(settle(search, self._model))
        self._model = search.to_the_end(self._model)
        told = self._model.names
        self._try()
        self._watch.begin("structure")
        left = remains(search, self._model)
        if search.thorough and self._fuller(left):
            left = remains(search, self._model)
        self._watch.begin("alternatives")
        model, causes = _preferred(search, self._trial, self._model, left)
        trial = self._trial
        if model.names != told:
            model = search.to_the_end(model)
            if trial is not None:
                trial.measure([model])
        self._watch.check()
        state = State(
            causes=len(causes),
            alternatives=any(cause.alternatives for cause in causes),
            closed=closed(search, model, left),
            unexplained=_is_unexplained(search, model, left),
            missed=trial is not None and trial.misses(model, left),
        )
        # Report the base model that was fitted first, even if the search found a better fit of it.
        return self._finding(verdict_of(state), base, model, causes, left)

    def unfit_base(self) -> Finding | None:
        """Return the result if causes cannot be searched, else None.

        This is the case if nothing moves, or if the data do not determine the base model.

        Raises:
            EndedError: the search had to end before the base model was fitted.
        """
        search = self._search
        # An unfinished base fit gives no information, not even about motion.
        if self._watch.left():
            raise EndedError
        # Without motion, residual tests would only test rounding.
        if shows_nothing(search):
            return _without_motion(search)
        base = search.base
        vague = unfixed(search, base)
        # Causes would represent values of parameters that the data do not determine.
        if vague:
            left = remains(search, base)
            return Finding(verdict_of(State(fixed=False)), base, base, (), left, vague)
        return None

    def _try(self) -> None:
        """Validate models on held-out runs, and drop idle effects."""
        if self._held_out is None or self._model is None:
            return
        self._watch.begin("held_out")
        trial = _trial(self._search, self._model, self._held_out)
        # Unfinished fits of initial states would be held against their model.
        self._watch.check()
        self._trial = trial
        # The effects that remain after dropping an idle one may have simpler forms.
        self._model = self._search.plainer(trial.without_idle(self._search, self._model))

    def _fuller(self, left: Remains) -> bool:
        """Replace the model by one with more effects if held-out runs confirm it.

        Returns:
            Whether the model was replaced.
        """
        found, trial, search = self._model, self._trial, self._search
        if found is None or trial is None or not found.names or not left.structure:
            return False
        fuller = trial.richer(search, found)
        if fuller is found:
            return False
        self._model = search.plainer(search.to_the_end(fuller))
        trial.measure([self._model])
        return True

    def so_far(self) -> Finding:
        """Return the result of a search that had to end, which claims only what was tested."""
        search = self._search
        cut = self._watch.cut(self._held_out is not None)
        model = self._model or search.so_far()
        # The residual was not tested, so it is counted as structure and not as noise.
        left = replace(unasked(search, model), p_value=0.0)
        alternatives = Alternatives(search, self._trial, structure=False, simulates=False)
        causes = alternatives.evidence(model)
        share = closed(search, model, left)
        verdict = verdict_of_cut(len(causes), share, cut.not_asked)
        found = self._finding(verdict, search.base, model, causes, unasked(search, model))
        return replace(found, cut=cut)

    def _finding(
        self,
        verdict: VerdictName,
        base: Model,
        model: Model,
        causes: tuple[Evidence, ...],
        left: Remains,
    ) -> Finding:
        """Return a result with the held-out evaluations."""
        measured = self._trial.measured if self._trial is not None else None
        return Finding(verdict, model, base, causes, left, measured=measured)


def shows_nothing(search: Search) -> bool:
    """Return whether the recording shows no motion, and the model expects none."""
    observed = search.world.observed
    largest = np.nanmax(observed, axis=(0, 1))
    smallest = np.nanmin(observed, axis=(0, 1))
    ranges = largest - smallest
    # Parameters that do not influence the simulated runs were fixed by the base fit.
    touched = len(search.frozen) != search.world.base.size
    left = search.base.likelihood.sigma
    return rules.shows_nothing(ranges, left, search.noise.sigma, touched)


def _without_motion(search: Search) -> Finding:
    """Return the result for a recording without motion."""
    base, world = search.base, search.world
    # No parameter can be determined, and no test of the residual is meaningful.
    vague = tuple(world.parameters[i].name for i in world.base)
    excess = base.likelihood.sigma / search.noise.sigma
    nothing = Remains(1.0, "", excess, ())
    return Finding(verdict_of(State(fixed=False)), base, base, (), nothing, vague)


def unfixed(search: Search, base: Model) -> tuple[str, ...]:
    """Return the sensitive base parameters that the data do not determine, the worst first.

    Args:
        search: the search.
        base: the base model.
    """
    variances = np.diagonal(covariance(search, base))
    spread = np.sqrt(np.maximum(variances, 0.0))
    parameters = [search.world.parameters[place] for place in base.fit.free]
    vague = []
    for parameter, sd in zip(parameters, spread.tolist(), strict=True):
        low, high = parameter.bounds
        if not rules.is_fixed(sd, low, high):
            vague.append((sd / (high - low), parameter.name))
    return tuple(name for _, name in sorted(vague, key=lambda one: -one[0]))


def _trial(search: Search, model: Model, held_out: Validation) -> Trial:
    """Evaluate the base model, the best singles, the result and its rivals on held-out runs."""
    models = search.models.values()
    # Parts of the model are included, because an effect that does not help on held-out runs is
    # dropped.
    names = set(model.names)
    parts = [m for m in models if set(m.names) < names]
    singles = [m for m in models if len(m.names) == 1]
    singles.sort(key=lambda m: -m.merit)
    near = rivals(search, model)
    trial = Trial(held_out)
    # All models are evaluated together, so that initial states start from those of the nearest
    # model.
    trial.measure([search.base, model, *near, *parts, *singles[:SHOWN]])
    return trial


def _preferred(
    search: Search, trial: Trial | None, model: Model, left: Remains
) -> tuple[Model, tuple[Evidence, ...]]:
    """Return the model with the preferred effect of each set, and its causes."""
    alternatives = Alternatives(search, trial, left.structure)
    causes = alternatives.evidence(model)
    names = frozenset(cause.preferred for cause in causes)
    preferred = search.models.get(names, model)
    if preferred is model:
        return model, causes
    return preferred, alternatives.evidence(preferred)


def _is_unexplained(search: Search, model: Model, left: Remains) -> bool:
    """Return whether the model lacks something, with a score test if none exists yet."""
    chance = search.tests.get(frozenset(model.names))
    # A model with a residual above the noise was not scored, because the search did not need it.
    if chance is None:
        loud = not left.structure and not search.quiet(model)
        chance = search.scan(model).p_value if loud else 1.0
    return rules.is_unexplained(left.structure, chance)


def closed(search: Search, model: Model, left: Remains) -> float:
    """Return the share of the discrepancy on the fitted runs that a model removes.

    With the RMS residuals b of the base model and a of this model, in units of the noise, it is (b
    - max(a, 1)) / (b - 1), or 0 if the base model leaves no discrepancy.

    Args:
        search: the search.
        model: the extended model.
        left: its lack-of-fit result.
    """
    own = model.likelihood.sigma
    # A residual without structure is noise, even if it exceeds an estimated noise floor.
    usable = np.isfinite(own) & ~left.structure
    floor = np.where(usable, own, search.noise.sigma)
    noise = np.maximum(floor, search.noise.sigma)
    before = _loudness(search, search.base, noise)
    after = _loudness(search, model, noise)
    # At the noise floor there is no discrepancy, and the quotient would be rounding error.
    if not before > 1.0 + 1e-9:
        return 0.0
    return (before - max(after, 1.0)) / (before - 1.0)


def _loudness(search: Search, model: Model, noise: Array) -> float:
    """Return the RMS residual of a model in units of the noise."""
    left = search.residual(model.fit) / noise
    squares = np.square(left[search.seen])
    return float(np.sqrt(squares.mean()))
