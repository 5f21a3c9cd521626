"""Simulate and fit elasticity and backlash between a drive and its links.

These series effects (an elastic joint, or one with a gap, in series with a joint) have states of
their own, which filters do not follow. A regression does not find them, so that each is simulated
at several coefficients, and those with the lowest cost are fitted.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence

import numpy as np

from bench.diagnosis.fitting.fitted_models import FittedModel, select_likeliest
from bench.diagnosis.fitting.levenberg_marquardt import FitStart
from bench.diagnosis.prediction_error.effect_proposals import SearchContext
from bench.diagnosis.prediction_error.effects_at_joints import acts_at_joint, has_series
from bench.diagnosis.prediction_error.regression_selection import Selected
from bench.diagnosis.prediction_error.simulated_fits import (
    RatedStart,
    fit_by_simulation,
    remove_idle_effects,
    select_lowest_of_each,
)
from bench.diagnosis.search.fit_starts import add_effect_to_start
from sims.core.simulator import Array
from sims.robot.dynamics.series_joints import is_series_effect

SMALLER_SERIES_SHARES = (0.1, 0.35)
"""Shares of the smallest trial compliance or gap that are tried too."""


def simulate_series_effects(context: SearchContext, selected: Selected) -> list[RatedStart]:
    """Simulate elastic joints and backlash between drive and links at the most affected joints.

    These effects have their own states, so a regression cannot score them, and each of their trial
    coefficients is simulated. The most affected joint is the one at which a filter needs process
    noise most. It is taken from two filters: that of the model without effects, and that with the
    selected effects, which may be wrong.

    Args:
        context: search, filters and regressions of the recording; `filters.base` is the filter of
            the model without effects, and `filters.reference` its parameters.
        selected: the selection, whose missing forces determine one of the joints.

    Returns:
        The best start of each effect.
    """
    evaluator = context.evaluator
    joints = {followed.joints_by_loss[0] for followed in (context.filters.base, selected.followed)}
    alone = FitStart((), context.filters.reference, evaluator.initial_state_guesses)
    return _simulate_at_joints(context, alone, joints)


def _simulate_at_joints(
    context: SearchContext, start: FitStart, joints: Collection[int]
) -> list[RatedStart]:
    """Simulate elasticity and backlash at some joints, in addition to the effects of a model.

    Args:
        context: search, filters and regressions of the recording.
        start: the model.
        joints: indices of the joints.

    Returns:
        The best start of each effect.
    """
    evaluator = context.evaluator
    names = [
        name
        for name in evaluator.library
        if is_series_effect(evaluator.available_effects[name])
        and acts_at_joint(evaluator, name, joints)
    ]
    starts = [
        add_effect_to_start(evaluator, start, name, coefficients)
        for name in names
        for coefficients in _list_series_coefficients(context, name)
    ]
    if not starts:
        return []
    evaluator.search_control.begin_stage(
        "testing elasticity and backlash between drives and links", len(starts)
    )
    return select_lowest_of_each(context, starts)


def _list_series_coefficients(context: SearchContext, name: str) -> list[Array]:
    """Return the trial coefficients (k,) of an effect between a drive and its link.

    A fit from a much larger gap than the true one ends in a local minimum, so that shares of the
    smallest trial coefficient are added to the trial coefficients of the library (probes).

    Args:
        context: search, filters and regressions of the recording.
        name: name of the effect; its first coefficient is a compliance or a gap.
    """
    probes = [probe.coefficients for probe in context.columns.probes([name])]
    smallest = min(probes, key=lambda coefficients: float(coefficients[0]))
    for share in SMALLER_SERIES_SHARES:
        smaller = smallest.copy()
        smaller[0] *= share
        probes.append(smaller)
    return probes


def fit_series_effects(
    context: SearchContext, simulated: Sequence[RatedStart], limit: float = np.inf
) -> FittedModel:
    """Fit elastic joints and backlash that were not fitted before, the likeliest to convergence.

    Each effect is fitted from its start. The likeliest of these models is then fitted again, with
    restarts.

    Args:
        context: search, filters and regressions of the recording.
        simulated: start of each effect (`simulate_series_effects`).
        limit: cost below which a start is fitted.

    Returns:
        The fitted model, whether or not it is good; the base model if there are no such effects.
    """
    search = context.search
    starts = [
        start
        for cost, start in simulated
        if cost < limit and frozenset(start.effects) not in search.models
    ]
    if not starts:
        return search.base_model
    return fit_by_simulation(context, select_likeliest(*search.fit_all(starts)).fit.make_start())


def add_series_effect(context: SearchContext, best: FittedModel) -> FittedModel:
    """Return a model with an elastic joint or backlash in addition, if that is likelier.

    A regression does not find these effects. If one of them acts together with another effect, the
    best model so far has the other effect only.

    Args:
        context: search, filters and regressions of the recording.
        best: the best model so far, which does not explain the runs.
    """
    if not best.effects or has_series(context.evaluator, best.effects):
        return best
    # The joint at which the filter of the model most needs process noise, which stands for a
    # missing force.
    joints = {context.filters.get_filter(best).joints_by_loss[0]}
    simulated = _simulate_at_joints(context, best.fit.make_start(), joints)
    added = fit_series_effects(context, simulated, best.fit.cost)
    if not added.effects:
        return best
    return select_likeliest(best, remove_idle_effects(context, added))
