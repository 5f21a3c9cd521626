"""Constructed models for tests of the search: effects, log-likelihood and residuals."""

from types import SimpleNamespace

import numpy as np

from bench.diagnosis.evaluation.noise_model import Likelihood
from bench.diagnosis.fitting.fitted_models import FittedModel
from bench.diagnosis.validation.held_out_runs import HeldOutFit
from tests.bench.diagnosis.explained_samples import linear_fit


def model(*names, likelihood=0.0):
    """Return a model with these effects; its log-likelihood is its penalised log-likelihood."""
    fit = linear_fit(np.zeros((1, 1, 1, 1)), 1)
    fit = type(fit)(names, *list(vars(fit).values())[1:])
    return FittedModel(fit, Likelihood(likelihood, np.ones(1), np.zeros(1)), likelihood)


def search_of(*models, excess=None):
    """Return a stub of a search with these models; `excess` maps their effects to excesses."""
    table = {frozenset(m.effects): m for m in models}
    excesses = excess or {}
    return SimpleNamespace(
        models=table,
        settled_effects=None,
        compute_excess_residual=lambda m: excesses.get(m.effects, 0.0),
        remove_effect=lambda m, name: table[frozenset(m.effects) - {name}],
    )


def held_out(left):
    """Return held-out runs with sigma 1, and fits with these RMS residuals by their effects.

    A model with a smaller residual has a higher penalised log-likelihood.
    """
    runs = SimpleNamespace(
        evaluator=SimpleNamespace(observed=np.zeros((1, 4, 1))),
        noise=SimpleNamespace(sigma=np.ones(1)),
        seen=np.ones((1, 4, 1), dtype=bool),
    )
    measured = {
        names: HeldOutFit(np.full((1, 4, 1), float(rms)), -100.0 * rms, np.zeros((1, 1)))
        for names, rms in left.items()
    }
    return runs, measured
