"""Proposals of effects at contacts, for the search by simulation.

The score of an effect at a contact is misleading: without it, the simulation slides where the robot
sticks, and a small change of a coefficient does not show what a large one does. Each such effect is
therefore fitted from several values. The initial states are then estimated again with the best
model, because the first estimate belongs to the model without the effect.
"""

from __future__ import annotations

from collections.abc import Sequence

from bench.diagnosis.evaluation.coefficient_bounds import compute_coefficient_bounds
from bench.diagnosis.evaluation.run_evaluator import RunEvaluator
from bench.diagnosis.evaluation.search_control import SearchStoppedError
from bench.diagnosis.fitting.fit_state import FitStart
from bench.diagnosis.kalman.first_states import estimate_first_states
from bench.diagnosis.search.effect_search import EffectSearch
from sims.core.simulator import Array

START_SHARES = (0.5, 0.25)
"""Values at which fits begin, as shares of the lowest and the highest plausible coefficient."""
FIRST_STATE_MARGIN = 3.0
"""Prior standard deviation of a first state in contact, in standard deviations of its estimate.

The margin is needed since the estimate depends on a model that may lack causes.
"""


def set_first_states_in_contact(
    evaluators: Sequence[RunEvaluator], theta: Array, sigma: Array
) -> None:
    """Estimate the initial states of a robot whose geoms touch.

    Args:
        evaluators: runs for fitting, and held-out runs.
        theta: (P,) parameters of the model.
        sigma: (C,) standard deviation of the noise of each channel.
    """
    for evaluator in evaluators:
        found = estimate_first_states(evaluator, theta, sigma)
        if found is not None:
            evaluator.begin_at(found.states, FIRST_STATE_MARGIN * found.deviations)


def propose_contact_effects(search: EffectSearch, evaluators: Sequence[RunEvaluator]) -> None:
    """Fit each effect at a contact, and estimate the initial states again with the best model.

    Args:
        search: search with the fitted base model; it gets models with one effect each.
        evaluators: its runs, followed by held-out runs, whose initial states are estimated again.

    Raises:
        SearchStoppedError: the search had to end; it has the models that were fitted so far.
    """
    evaluator, base = search.evaluator, search.base_model.fit
    names = [
        name for name in evaluator.library if evaluator.available_effects[name].at == "contact"
    ]
    starts = []
    for name in names:
        low, high = compute_coefficient_bounds(evaluator, name)[0]
        for c in (START_SHARES[0] * low, START_SHARES[1] * high):
            theta = base.theta.copy()
            theta[evaluator.coefficient_slices[name]] = c
            starts.append(FitStart((name,), theta, base.initial_states))
    search.refit_models(starts, is_racing=False)
    fits = [search.models[frozenset((name,))] for name in names]
    best = max([search.base_model, *fits], key=lambda model: model.penalised_log_likelihood)
    if not best.effects:
        return
    set_first_states_in_contact(evaluators, best.fit.theta, search.noise.sigma)
    # Sums of squares about other initial states are not comparable.
    known = dict(search.models)
    search.models.clear()
    starts = [
        FitStart(model.effects, model.fit.theta, evaluator.initial_state_guesses)
        for model in known.values()
    ]
    try:
        search.refit_models(starts, is_racing=False)
    except SearchStoppedError:
        search.models.update(known)
        raise
    search.fit_to_convergence(search.models[frozenset(best.effects)])
