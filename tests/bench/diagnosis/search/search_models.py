"""Models that nothing was fitted for: effects, a merit, and what they leave."""

from types import SimpleNamespace

import numpy as np

from bench.diagnosis.evaluation.noise_model import Likelihood
from bench.diagnosis.fitting.model_set import FittedModel
from bench.diagnosis.validation.held_out_runs import HeldOutFit
from tests.bench.diagnosis.explained_samples import linear_fit


def model(*names, merit=0.0):
    """A model with these effects; its likelihood is its merit."""
    fit = linear_fit(np.zeros((1, 1, 1, 1)), 1)
    fit = type(fit)(names, *list(vars(fit).values())[1:])
    return FittedModel(fit, Likelihood(merit, np.ones(1), np.zeros(1)), merit)


def search_of(*models, excess=None):
    """What stands for a search that has fitted them; `excess` by the effects of each."""
    table = {frozenset(m.effects): m for m in models}
    excesses = excess or {}
    return SimpleNamespace(
        models=table,
        settled_effects=None,
        compute_excess=lambda m: excesses.get(m.effects, 0.0),
        remove_effect=lambda m, name: table[frozenset(m.effects) - {name}],
    )


def held_out(left):
    """Held-out runs of one channel with sigma 1 where models leave this RMS, by their effects; and
    what was measured there: a model that leaves less has more merit.
    """
    runs = SimpleNamespace(
        world=SimpleNamespace(observed=np.zeros((1, 4, 1))),
        noise=SimpleNamespace(sigma=np.ones(1)),
        seen=np.ones((1, 4, 1), dtype=bool),
    )
    measured = {
        names: HeldOutFit(np.full((1, 4, 1), float(rms)), -100.0 * rms, np.zeros((1, 1)))
        for names, rms in left.items()
    }
    return runs, measured
