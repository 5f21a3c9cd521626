"""Validation of the models of a search on held-out runs.

If there are too few runs to hold one out, each run is predicted by fits to the others
(`bench.gap.cross_validation`), and counts as held out. An effect that makes held-out predictions
worse is dropped. A discrepancy that only held-out runs show is something that the model does not
contain. Between models that explain the fitted runs equally well, the held-out likelihood counts,
too.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

from bench.gap.causes.rules import NOTICED, SWITCH, explains, helps, is_alike, is_missed, ratio_of
from bench.gap.causes.search import IDLE, Search
from bench.gap.causes.structure import Remains
from bench.gap.held_out import Measured, Validation
from bench.gap.model.models import Model, Names
from sims.base import Array

CLEARLY_CLOSED = 0.5
"""Maximum excess on fitted runs, as a share of that without the effect, to keep the effect.

It applies to an effect that improves the held-out runs only slightly.
"""
RICHER = 8
"""Maximum number of models that contain the result and are evaluated on held-out runs."""


@dataclass(frozen=True)
class Trial:
    """Models evaluated on held-out runs.

    Attributes:
        runs: predicts the held-out runs, or each run by cross-validation.
        measured: evaluated models, by their effects.
    """

    runs: Validation
    measured: dict[Names, Measured] = field(default_factory=dict)

    def measure(self, models: Iterable[Model]) -> None:
        """Evaluate models together; each starts from the initial states of the nearest one."""
        # Stored by effects, so that a repeated model is simulated only once.
        chosen = {model.names: model for model in models}
        results = self.runs.validate([model.fit for model in chosen.values()])
        self.measured.update(zip(chosen, results, strict=True))

    def excess(self, names: Names, sigma: Array | None = None) -> float:
        """Return the RMS residual of a model on the held-out runs in units of the noise, minus one.

        Args:
            names: effects of a model that has been evaluated.
            sigma: (C,) noise; None for the noise of the runs.
        """
        runs = self.runs
        noise = runs.noise.sigma if sigma is None else sigma
        residual = runs.world.observed - self.measured[names].simulated
        scaled = residual / noise
        squares = np.square(scaled[runs.seen])
        return float(np.sqrt(squares.mean())) - 1.0

    def without_idle(self, search: Search, model: Model) -> Model:
        """Return the model without idle effects.

        An effect is idle if it makes held-out predictions worse, or hardly better while the excess
        is large.

        Args:
            search: the search, with every fitted model.
            model: the model.
        """
        while model.names and model.names in self.measured:
            smaller = self._smaller(search, model)
            idle = [m for m in smaller if not self._helps(search, m, model)]
            if not idle:
                return model
            # If several effects are idle, drop the one without which held-out runs are predicted
            # best.
            model = max(idle, key=lambda m: self.measured[m.names].merit)
        return model

    def richer(self, search: Search, model: Model) -> Model:
        """Return the extension of a model that held-out runs confirm best, or the model itself.

        If the residual has structure, merits on fitted runs are unreliable, because each model
        mimics what is missing. A clearly lower residual on runs that were not fitted is not
        mimicry.

        Args:
            search: the search, with every fitted model.
            model: the model that was found; it has been evaluated.
        """
        names = set(model.names)
        fuller = [m for m in search.models.values() if names < set(m.names)]
        fuller = sorted(fuller, key=lambda m: m.fit.cost)[:RICHER]
        known = search.models.values()
        parts = [m for m in known if any(set(m.names) < set(other.names) for other in fuller)]
        # The model is included again, so that all initial states start from the same values.
        self.measure([model, *fuller, *parts])
        borne = {m.names: self._share(search, model, m) for m in fuller}
        best = min(fuller, key=lambda m: borne[m.names], default=model)
        if best is model or not borne[best.names] < 1.0:
            return model
        lean = self.without_idle(search, best)
        return lean if names < set(lean.names) else model

    def _share(self, search: Search, model: Model, fuller: Model) -> float:
        """Return the excess of a larger model relative to what its further effects must achieve.

        The value is one if the reduction is just enough; the worse of fitted and held-out runs
        counts.
        """
        enough = IDLE ** (len(fuller.names) - len(model.names))
        fitted = ratio_of(search.excess(fuller), search.excess(model))
        unseen = ratio_of(self.excess(fuller.names), self.excess(model.names))
        return max(fitted, unseen) / enough

    def _smaller(self, search: Search, model: Model) -> list[Model]:
        """Return the evaluated models that lack one of the effects of the model."""
        names = set(model.names)
        size = len(names) - 1
        smaller = []
        for other in search.models.values():
            # A model that was not evaluated on held-out runs cannot be compared there.
            if other.names not in self.measured:
                continue
            if len(other.names) == size and set(other.names) < names:
                smaller.append(other)
        return smaller

    def _helps(self, search: Search, without: Model, having: Model) -> bool:
        """Return whether the effect by which two models differ improves held-out predictions.

        It is also accepted if it explains the fitted runs, and held-out runs hardly show it.
        """
        before = self.measured[without.names].merit
        after = self.measured[having.names].merit
        # Both merit and excess are tested, because far from the noise merit alone may be mimicry.
        excesses = self.excess(without.names), self.excess(having.names)
        if helps((before, after), excesses):
            return True
        left, closed = search.excess(without), search.excess(having)
        # Errors of a motion without feedback accumulate, whatever their cause.
        better = after > before + SWITCH and excesses[1] < excesses[0]
        if better and closed < CLEARLY_CLOSED * left:
            return True
        # A limit that no held-out run approaches cannot be tested there; the result would be
        # random.
        faint = max(excesses) < NOTICED and is_alike(before - after)
        return faint and left > NOTICED and explains((left - closed) / left)

    def misses(self, model: Model, left: Remains) -> bool:
        """Return whether held-out runs show a discrepancy that the model does not remove.

        Args:
            model: the model, which has been evaluated.
            left: its lack-of-fit result.
        """
        own = np.nan_to_num(model.likelihood.sigma)
        # The residual of fitted runs is noise if it has no structure; otherwise only the noise
        # floor is.
        known = np.where(left.structure, 0.0, own)
        noise = np.maximum(self.runs.noise.sigma, known)
        before = self.excess((), noise)
        after = self.excess(model.names, noise)
        return is_missed(before, after)
