"""What held-out runs say about the models of a search: they have a veto and a voice.

Where runs are too few to hold one out, each is predicted by fits to the others
(`bench.gap.cross_validation`), and counts as held out.

An effect that makes them worse goes. A gap that only they show is something that the model has not
learnt. And between models that explain the fitted runs alike, their likelihood counts too.
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
"""Share of the excess of fitted runs below which an effect must bring it, to be kept though it is
hardly seen in that of held-out runs.
"""
RICHER = 8
"""So many of the nearest models that contain what was found are tried on held-out runs."""


@dataclass(frozen=True)
class Trial:
    """Models on held-out runs.

    Attributes:
        runs: predicts the held-out runs, or each run by cross-validation.
        measured: the models that were tried there, by their effects.
    """

    runs: Validation
    measured: dict[Names, Measured] = field(default_factory=dict)

    def measure(self, models: Iterable[Model]) -> None:
        """Try models, all at once: each is compared with the nearest of them."""
        # By effects, so that a model that is asked for twice is simulated once.
        chosen = {model.names: model for model in models}
        results = self.runs.validate([model.fit for model in chosen.values()])
        self.measured.update(zip(chosen, results, strict=True))

    def excess(self, names: Names, sigma: Array | None = None) -> float:
        """RMS of what a model leaves of the held-out runs in units of the noise, less one.

        Args:
            names: its effects; it has been measured.
            sigma: (C,) the noise; that of the runs if None.
        """
        runs = self.runs
        noise = runs.noise.sigma if sigma is None else sigma
        residual = runs.world.observed - self.measured[names].simulated
        scaled = residual / noise
        squares = np.square(scaled[runs.seen])
        return float(np.sqrt(squares.mean())) - 1.0

    def without_idle(self, search: Search, model: Model) -> Model:
        """The model without effects that make held-out runs worse, or hardly better while much is
        left of the gap.
        """
        while model.names and model.names in self.measured:
            smaller = self._smaller(search, model)
            idle = [m for m in smaller if not self._helps(search, m, model)]
            if not idle:
                return model
            # Of several that could go, the one goes without which held-out runs are best.
            model = max(idle, key=lambda m: self.measured[m.names].merit)
        return model

    def richer(self, search: Search, model: Model) -> Model:
        """Of the accounts that keep what was found and have more, the one that held-out runs bear
        out best; the model itself where they bear out none.

        Where structure is left, merits say little of what the fitted runs show, since each model
        mimics what none has. What leaves clearly less of runs that no fit has seen mimics nothing.

        Args:
            search: with every model that was fitted.
            model: what was found; it has been measured.
        """
        names = set(model.names)
        fuller = [m for m in search.models.values() if names < set(m.names)]
        fuller = sorted(fuller, key=lambda m: m.fit.cost)[:RICHER]
        known = search.models.values()
        parts = [m for m in known if any(set(m.names) < set(other.names) for other in fuller)]
        # The model again, so that initial states of all are begun from the same ones.
        self.measure([model, *fuller, *parts])
        borne = {m.names: self._share(search, model, m) for m in fuller}
        best = min(fuller, key=lambda m: borne[m.names], default=model)
        if best is model or not borne[best.names] < 1.0:
            return model
        lean = self.without_idle(search, best)
        return lean if names < set(lean.names) else model

    def _share(self, search: Search, model: Model, fuller: Model) -> float:
        """How much a fuller account leaves, by what further effects have to bring: one where it is
        just enough, on the fitted or the held-out runs, whichever show it less.
        """
        enough = IDLE ** (len(fuller.names) - len(model.names))
        fitted = ratio_of(search.excess(fuller), search.excess(model))
        unseen = ratio_of(self.excess(fuller.names), self.excess(model.names))
        return max(fitted, unseen) / enough

    def _smaller(self, search: Search, model: Model) -> list[Model]:
        """Models that were tried and lack one of the model's effects."""
        names = set(model.names)
        size = len(names) - 1
        smaller = []
        for other in search.models.values():
            # What was not tried on held-out runs has no voice there.
            if other.names not in self.measured:
                continue
            if len(other.names) == size and set(other.names) < names:
                smaller.append(other)
        return smaller

    def _helps(self, search: Search, without: Model, having: Model) -> bool:
        """Whether the effect by which two models differ makes held-out runs better; or explains the
        fitted ones, where held-out runs hardly show it.
        """
        before = self.measured[without.names].merit
        after = self.measured[having.names].merit
        # Both are asked: far from the noise a merit alone may be mimicry.
        excesses = self.excess(without.names), self.excess(having.names)
        if helps((before, after), excesses):
            return True
        left, closed = search.excess(without), search.excess(having)
        # Errors of a motion without feedback add up, whatever makes them.
        better = after > before + SWITCH and excesses[1] < excesses[0]
        if better and closed < CLEARLY_CLOSED * left:
            return True
        # A limit that no held-out run comes near has no voice there: chance would speak for it.
        faint = max(excesses) < NOTICED and is_alike(before - after)
        return faint and left > NOTICED and explains((left - closed) / left)

    def misses(self, model: Model, left: Remains) -> bool:
        """Whether held-out runs show a gap that the model does not close: something acts there that
        it has not learnt.
        """
        own = np.nan_to_num(model.likelihood.sigma)
        # What is left of fitted runs is noise where it has no structure; else only the floor is.
        known = np.where(left.structure, 0.0, own)
        noise = np.maximum(self.runs.noise.sigma, known)
        before = self.excess((), noise)
        after = self.excess(model.names, noise)
        return is_missed(before, after)
