"""Confirm by simulation what prediction errors select, and determine the verdict.

1. Fit the selected set and its rivals to whole simulated runs.
2. Remove effects that make predictions of held-out runs worse.
3. Test whether a force of any shape is missing (`bench.gap.causes.structure`).
4. Collect other effects that explain the data as well.
5. Determine the verdict by the rules of `bench.gap.causes.rules`.
"""

from __future__ import annotations

from dataclasses import dataclass

from bench.gap.causes.alternatives import Alternatives
from bench.gap.causes.name import Finding, Inquiry, closed
from bench.gap.causes.rules import State, is_unexplained, verdict_of
from bench.gap.causes.search import Search
from bench.gap.causes.structure import remains
from bench.gap.causes.trial import Trial
from bench.gap.held_out import Validation
from bench.gap.model.models import Model
from bench.gap.prediction_error.null_distribution import p_value_of_gain
from bench.gap.prediction_error.search import PredictionErrorSearch

MIMICRY = 0.5
"""Minimum share of the discrepancy that reported effects remove if the cause is unknown."""
NEAR = 15.0
"""Maximum distance in twice the log-likelihood of rivals that are evaluated on held-out runs."""


class Confirmation(Inquiry):
    """The steps of the diagnosis of a robot's recording.

    Args:
        search: search by prediction errors, which contains the fitted base model.
        held_out: held-out runs for validation; None if there are none.
    """

    def __init__(self, search: Search, held_out: Validation | None) -> None:
        super().__init__(search, held_out)
        assert isinstance(search, PredictionErrorSearch)
        self._robot = search

    def answered(self) -> Finding:
        """Return the result of the complete diagnosis.

        Raises:
            EndedError: the search had to end early.
        """
        search, watch = self._robot, self._watch
        unfit = self.unfit_base()
        if unfit is not None:
            return unfit
        base = search.base
        watch.begin("search")
        self._model = search.run()
        watch.begin("rivals")
        self._model = search.fit_rivals(self._model)
        size = len(self._model.names)
        self._measure()
        if 0 < len(self._model.names) < size:
            # The rivals of the remaining effects were fitted together with the removed ones, so fit
            # them again.
            self._model = search.fit_rivals(self._model)
            self._measure()
        watch.begin("structure")
        self._model = search.to_the_end(self._model)
        left = remains(search, self._model)
        watch.begin("alternatives")
        causes = _RobotAlternatives(search, self._trial, left.structure).evidence(self._model)
        watch.check()
        model, trial = self._model, self._trial
        state = State(
            causes=len(causes),
            alternatives=any(cause.alternatives for cause in causes),
            closed=closed(search, model, left),
            unexplained=is_unexplained(left.structure, search.p_value_of_missing_effect(model)),
            missed=trial is not None and trial.misses(model, left),
        )
        verdict = verdict_of(state)
        if verdict == "unknown" and state.closed < MIMICRY:
            # Effects that leave most of the discrepancy only mimic what is missing.
            model, causes = base, ()
        return self._finding(verdict, base, model, causes, left)

    def _measure(self) -> None:
        """Evaluate the models on held-out runs, and remove effects that do not help there."""
        if self._held_out is None or self._model is None:
            return
        search, model = self._robot, self._model
        self._watch.begin("held_out")
        names = set(model.names)
        if len(names) > 1:
            for name in model.names:
                search.without(model, name)
        parts = [m for m in search.models.values() if set(m.names) < names and m.names]
        size = len(names)
        rivals = [m for m in search.models.values() if len(m.names) == size and m is not model]
        rivals = [m for m in rivals if m.merit > model.merit - NEAR]
        trial = Trial(self._held_out)
        trial.measure([search.base, model, *parts, *rivals])
        self._watch.check()
        self._trial = trial
        self._model = trial.without_idle(search, model)


@dataclass(frozen=True)
class _RobotAlternatives(Alternatives):
    """Collects alternatives of a robot's effects; p-values are those of the chi-squared law."""

    def _p_value(self, rest: Model, effect: str, gain: float) -> float:  # noqa: ARG002
        slot = self.search.world.slots[effect]
        return p_value_of_gain(gain, slot.stop - slot.start, len(self.search.world.library))
