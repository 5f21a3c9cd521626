"""Names the cause: asks one question after another, and judges by the answers.

Does anything move? Are the base parameters fixed? Which effects did the search find, and do they
stand against their rivals? Do held-out runs bear them out? What would do as well? What is left? The
thresholds that answer stand in `bench.gap.causes.rules`.
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
"""So many of the best models with one effect are tried on held-out runs, to be shown."""


@dataclass(frozen=True)
class Finding:
    """What was found.

    Attributes:
        verdict: one of six words.
        model: the extended model; the base model where nothing was found.
        base: the base model.
        causes: strongest first.
        remains: what the extended model leaves.
        vague: base parameters that the data do not fix.
        measured: models on held-out runs, by their effects; None where there are none.
        cut: what was not asked; None where the search came to its end.
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
    """Search, check on held-out runs, collect alternatives, and judge.

    Args:
        search: with the base model entered.
        held_out: the runs for measuring; None if there are none.
    """
    return answer(Inquiry(search, held_out))


def answer(inquiry: Inquiry) -> Finding:
    """Answer all questions, or those for which there is time."""
    try:
        return inquiry.answered()
    except EndedError:
        return inquiry.so_far()


class Inquiry:
    """The questions in their order, and what has been answered.

    Args:
        search: with the base model entered.
        held_out: predicts held-out runs, or each run by cross-validation; None if there are
            neither.
    """

    def __init__(self, search: Search, held_out: Validation | None) -> None:
        self._search = search
        self._held_out = held_out
        self._watch = search.world.watch
        self._trial: Trial | None = None
        self._model: Model | None = None

    def answered(self) -> Finding:
        """The finding when all is answered.

        Raises:
            EndedError: the search has to end before.
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
        # The base is the one that was asked first, whatever better fit of it the search came upon.
        return self._finding(verdict_of(state), base, model, causes, left)

    def unfit_base(self) -> Finding | None:
        """Return the finding where nothing moves, or where the data do not fix the base model; None
        where causes can be asked for.

        Raises:
            EndedError: the search had to end before the base model was fitted.
        """
        search = self._search
        # A base model that is not fitted to its end says nothing, of motion neither.
        if self._watch.left():
            raise EndedError
        # Without motion any test of the residuals is one of rounding.
        if shows_nothing(search):
            return _without_motion(search)
        base = search.base
        vague = unfixed(search, base)
        # Causes would stand for values of parameters that the data do not fix.
        if vague:
            left = remains(search, base)
            return Finding(verdict_of(State(fixed=False)), base, base, (), left, vague)
        return None

    def _try(self) -> None:
        """Ask the held-out runs."""
        if self._held_out is None or self._model is None:
            return
        self._watch.begin("held_out")
        trial = _trial(self._search, self._model, self._held_out)
        # Initial states that were left off would speak against their model.
        self._watch.check()
        self._trial = trial
        # What is left where an idle effect was may have a simpler form, too.
        self._model = self._search.plainer(trial.without_idle(self._search, self._model))

    def _fuller(self, left: Remains) -> bool:
        """Whether held-out runs bear out an account that has more of what the model leaves; it
        takes the model's place.
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
        """The finding where the search had to end: never more than what was answered supports."""
        search = self._search
        cut = self._watch.cut(self._held_out is not None)
        model = self._model or search.so_far()
        # What nobody asked about is taken for structure, so that no share is called closed for it.
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
        measured = self._trial.measured if self._trial is not None else None
        return Finding(verdict, model, base, causes, left, measured=measured)


def shows_nothing(search: Search) -> bool:
    """Whether nothing moves in the recording, and nothing should."""
    observed = search.world.observed
    largest = np.nanmax(observed, axis=(0, 1))
    smallest = np.nanmin(observed, axis=(0, 1))
    ranges = largest - smallest
    # Parameters that the simulated runs do not show were frozen by the base fit.
    touched = len(search.frozen) != search.world.base.size
    left = search.base.likelihood.sigma
    return rules.shows_nothing(ranges, left, search.noise.sigma, touched)


def _without_motion(search: Search) -> Finding:
    """Return the finding about a recording in which nothing moves."""
    base, world = search.base, search.world
    # Nothing can be known of any of them, and no test of what is left would mean anything.
    vague = tuple(world.parameters[i].name for i in world.base)
    excess = base.likelihood.sigma / search.noise.sigma
    nothing = Remains(1.0, "", excess, ())
    return Finding(verdict_of(State(fixed=False)), base, base, (), nothing, vague)


def unfixed(search: Search, base: Model) -> tuple[str, ...]:
    """Base parameters that shape the data and are not fixed by them, the widest first."""
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
    """On held-out runs: the base model, the best ones with one effect, and all that are near the
    one found.
    """
    models = search.models.values()
    # Parts of the model, since an effect without which held-out runs are as good will go.
    names = set(model.names)
    parts = [m for m in models if set(m.names) < names]
    singles = [m for m in models if len(m.names) == 1]
    singles.sort(key=lambda m: -m.merit)
    near = rivals(search, model)
    trial = Trial(held_out)
    # All at once: initial states are begun again from those of the nearest model.
    trial.measure([search.base, model, *near, *parts, *singles[:SHOWN]])
    return trial


def _preferred(
    search: Search, trial: Trial | None, model: Model, left: Remains
) -> tuple[Model, tuple[Evidence, ...]]:
    """The model of those effects that should stand for their sets, and its causes."""
    alternatives = Alternatives(search, trial, left.structure)
    causes = alternatives.evidence(model)
    names = frozenset(cause.preferred for cause in causes)
    preferred = search.models.get(names, model)
    if preferred is model:
        return model, causes
    return preferred, alternatives.evidence(preferred)


def _is_unexplained(search: Search, model: Model, left: Remains) -> bool:
    chance = search.tests.get(frozenset(model.names))
    # What is loud was not scored while the search had no need of it.
    if chance is None:
        loud = not left.structure and not search.quiet(model)
        chance = search.scan(model).p_value if loud else 1.0
    return rules.is_unexplained(left.structure, chance)


def closed(search: Search, model: Model, left: Remains) -> float:
    """Share of the gap on the fitted runs that a model closes, channels in units of noise.

    With b and a the RMS that the base model and this one leave in units of the noise, it is
    (b - max(a, 1)) / (b - 1); 0 where the base model leaves no gap.
    """
    own = model.likelihood.sigma
    # What is left without structure is noise, and may be more than an estimated floor.
    usable = np.isfinite(own) & ~left.structure
    floor = np.where(usable, own, search.noise.sigma)
    noise = np.maximum(floor, search.noise.sigma)
    before = _loudness(search, search.base, noise)
    after = _loudness(search, model, noise)
    # At the noise there is no gap, and a share of it would be a quotient of rounding.
    if not before > 1.0 + 1e-9:
        return 0.0
    return (before - max(after, 1.0)) / (before - 1.0)


def _loudness(search: Search, model: Model, noise: Array) -> float:
    """RMS of what a model leaves, in units of the noise."""
    left = search.residual(model.fit) / noise
    squares = np.square(left[search.seen])
    return float(np.sqrt(squares.mean()))
