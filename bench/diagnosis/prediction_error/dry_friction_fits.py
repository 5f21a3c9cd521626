"""Fit dry friction before other effects, and test whether it has MuJoCo's soft form.

The force of dry friction is not linear in its limit where a joint sticks or creeps, so a selection
by regression gives poor starts for a fit of all effects at once. MuJoCo simulates dry friction with
a compliant constraint ("soft form"), so that joints creep; the other form ("stiff") lets them
stick. Filters find soft friction, and refits by simulation decide between the forms.
`SoftFrictionError` ends a search in the stiff form.
"""

from __future__ import annotations

import numpy as np

from bench.core.random_streams import make_rng
from bench.diagnosis.dry_friction_form import (
    has_dry_friction,
    has_soft_form,
    make_soft_kind,
    replace_by_stateless_friction,
)
from bench.diagnosis.evaluation.parameter_bounds import clip_coefficients
from bench.diagnosis.evaluation.run_evaluator import RunEvaluator
from bench.diagnosis.fitting.base_fit import compute_start_costs
from bench.diagnosis.fitting.fitted_models import FittedModel, ModelSet
from bench.diagnosis.fitting.levenberg_marquardt import FitStart
from bench.diagnosis.kalman.linearised_filter import FollowedRuns
from bench.diagnosis.prediction_error.effect_proposals import MIN_GAIN_SHARE, SearchContext
from bench.diagnosis.prediction_error.effects_at_joints import get_joint_name
from bench.diagnosis.prediction_error.filters_with_effects import (
    ModelFilters,
    compute_comparison_margin,
)
from bench.diagnosis.prediction_error.regression_selection import Selected
from bench.diagnosis.prediction_error.simulated_fits import (
    compute_likely_cost,
    drop_surplus_effects,
    fit_by_simulation,
    is_explained,
    is_nearly_explained,
    remove_idle_effects,
)
from bench.diagnosis.search.verdict_rules import INDISTINGUISHABLE_LOG_LIKELIHOOD_RATIO
from sims.core.simulator import Array
from sims.robot.model_field_effects import MODEL_FIELD_EFFECTS

FIRST_ITERATIONS = 5
"""Maximum number of steps of the first fit of dry friction."""
SOFT_FACTORS = (0.5, 0.8, 1.2, 1.8)
"""Friction forces tried for dry friction in the soft form, as multiples of the missing force."""
MIN_LEAD = 0.5 * INDISTINGUISHABLE_LOG_LIKELIHOOD_RATIO
"""Minimum lead in log-likelihood of soft dry friction over another model, both by filters."""
MIN_LEAD_SHARE = 0.1
"""Minimum lead in log-likelihood of soft dry friction over a model that does not explain the runs.

It is a share of the gain over the base model.
"""


class SoftFrictionError(Exception):
    """Dry friction of these data has MuJoCo's soft form: search with a simulator of that form.

    Attributes:
        start: the model that shows this; None if it is the present one.
        is_preliminary: whether this is found before other effects than friction are fitted.
    """

    def __init__(self, start: FitStart | None = None, is_preliminary: bool = False) -> None:
        super().__init__()
        self.start, self.is_preliminary = start, is_preliminary


def compare_friction_forms(context: SearchContext, selected: Selected) -> FittedModel | None:
    """Return stiff dry friction if it explains the runs, or raise an error if soft friction does.

    The form decides about the simulator of the whole search, so it is tested before anything but
    dry friction is fitted:

    1. Simulate the stiff friction of the selection. If it explains the runs, it is the result.
    2. Find soft friction by filters. It is not considered if another effect at its joint promises
       more.
    3. Simulate stiff friction at this joint. If it explains the runs, it is the result.
    4. If filters find soft friction likelier than the selection, simulate it and compare.

    Nothing is done if the search has the soft form already, or if the base model lacks no force.

    Args:
        context: search, filters and regressions of the recording; `filters.base` is the filter of
            the model without effects.
        selected: the selection.

    Returns:
        Stiff dry friction that explains the runs; None if it does not, or need not be tested.

    Raises:
        SoftFrictionError: simulated soft friction explains the runs, or is clearly likelier than
            stiff friction.
    """
    filters = context.filters
    if filters.is_soft or not filters.base.has_missing_force:
        return None
    friction = make_dry_friction_start(context, selected)
    if friction.effects:
        stiff_friction = context.search.fit_one(friction, FIRST_ITERATIONS)
        if is_explained(context, stiff_friction):
            return remove_idle_effects(context, stiff_friction)
    soft_start = _find_soft_friction(context)
    if soft_start is None:
        return None
    soft_log_likelihood = filters.log_likelihood(soft_start.theta, is_soft=True)
    gain = soft_log_likelihood - filters.base.log_likelihood
    # Another effect at the joint that promises more is fitted first. `effects` has the name of the
    # soft friction only.
    if not gain > max(context.proposals.compute_largest_gain_of_others(soft_start.effects[0]), 0.0):
        return None
    # Stiff friction at this joint alone, unless it was simulated above.
    if soft_start.effects != friction.effects:
        stiff_friction = context.search.fit_one(soft_start, FIRST_ITERATIONS)
        if is_explained(context, stiff_friction):
            return remove_idle_effects(context, stiff_friction)
    # Filters with more and more effects of the selection are slow, so they are made only if it is
    # not far behind.
    if not _is_far_less_likely(context, selected, soft_log_likelihood):
        useful_selection = drop_surplus_effects(context, selected)
        start = context.columns.start(useful_selection.groups, useful_selection.coefficients)
        log_likelihood = filters.log_likelihood(start.theta)
        if not soft_log_likelihood > log_likelihood + MIN_LEAD:
            return None
    # Filters are linear, so simulations of both forms decide. The stiff model is that at the joint
    # of the soft friction, from one of the two fits above.
    soft_friction = refit_if_likelier_soft(
        context.search, stiff_friction, INDISTINGUISHABLE_LOG_LIKELIHOOD_RATIO
    )
    if soft_friction is not None:
        lead = soft_friction.likelihood.value - stiff_friction.likelihood.value
        if is_explained(context, soft_friction) or lead > _compute_margin(context, stiff_friction):
            raise SoftFrictionError(soft_friction.fit.make_start(), is_preliminary=True)
    return None


def check_simulated_soft_friction(context: SearchContext) -> None:
    """Raise `SoftFrictionError` if simulated soft friction of a joint removes most of the residual.

    A regression may miss it, because a joint that creeps under its load responds to the friction of
    the stiff form as to none. A few forces are simulated at each joint, without a fit, so this is
    faster than any further search in the stiff form. Nothing is done if the search has the soft
    form already, or if forces are missing at several joints.

    Args:
        context: search, filters and regressions of the recording; `filters.base` is the filter of
            the model without effects, and `filters.reference` its parameters.

    Raises:
        SoftFrictionError: soft friction leaves little more than noise before any fit.
    """
    filters, evaluator = context.filters, context.evaluator
    if filters.is_soft or not filters.base.has_missing_force:
        return
    states = filters.estimate_first_states(filters.base)
    starts = []
    for joint in range(len(evaluator.simulator.system.coordinates)):
        name = f"friction.coulomb@{get_joint_name(evaluator, joint)}"
        if name in evaluator.library and filters.act_where_forces_are_missing([name]):
            # More or less friction than in the model file.
            thetas = [
                theta
                for sign in (1.0, -1.0)
                for theta in make_soft_friction_models(filters.base, filters.reference, joint, sign)
            ]
            starts += [FitStart((name,), theta, states) for theta in thetas]
    if not starts:
        return
    soft_evaluator = evaluator.with_kind(make_soft_kind(evaluator.kind))
    # The costs of whole runs; infinite if the simulation fails.
    try:
        costs = compute_start_costs(
            soft_evaluator, context.search.noise, starts, share=1.0, failed_residual=np.inf
        )
    finally:
        soft_evaluator.close()
    best = int(np.argmin(costs))
    # Below this cost, most of the residual is removed.
    if costs[best] < compute_likely_cost(context):
        raise SoftFrictionError(starts[best], is_preliminary=True)


def _find_soft_friction(context: SearchContext) -> FitStart | None:
    """Return the likeliest model of soft dry friction at the joint where regression shows friction.

    The joint is that of the Coulomb friction with the largest gain, and the sign of its coefficient
    tells whether there is more or less friction than in the model file.

    Args:
        context: search, filters and regressions of the recording.

    Returns:
        The model; None if the gain of dry friction by regression is far below the largest gain, or
        if friction is already soft.
    """
    columns, evaluator = context.columns, context.evaluator
    regression = columns.base_regression
    gains, groups = regression.gains([]), regression.groups
    # Indices of groups, in descending order of the gain.
    friction_indices = [
        i
        for i in np.argsort(-gains, kind="stable").tolist()
        if gains[i] > MIN_GAIN_SHARE * gains.max()
        and groups[i].effect.startswith("friction.coulomb@")
        and not groups[i].effect.endswith("@*")
        and groups[i].effect in evaluator.library
    ]
    if not friction_indices:
        return None
    best_group = groups[friction_indices[0]]
    (coefficient,) = columns.solve_alone(regression, best_group)
    sign = float(np.copysign(1.0, coefficient))
    return context.filters.get_soft_friction_start(best_group.effect, sign, _search_soft_friction)


def _search_soft_friction(filters: ModelFilters, name: str, sign: float) -> FitStart | None:
    """Return the likeliest model of soft dry friction at a joint, by filters.

    The models have a few friction forces in ascending order. The likelihood has one maximum over
    the force. Beginning at the middle, the search goes in the direction in which the log-likelihood
    of the filter increases, and stops where it decreases.

    Args:
        filters: the filters of the search.
        name: name of a friction effect at a joint.
        sign: 1 for more friction than in the model file, -1 for less.

    Returns:
        Start of a fit with the likeliest force; None if friction is already soft.
    """
    base, joint_name = filters.base, name.partition("@")[2]
    # The filter has a missing force (`force`) for each joint.
    joint_indices = {get_joint_name(filters.evaluator, j): j for j in range(base.force.size)}
    thetas = make_soft_friction_models(base, filters.reference, joint_indices[joint_name], sign)
    if not thetas:
        return None
    followed: dict[int, FollowedRuns] = {}

    def log_likelihood(number: int) -> float:
        """Return the log-likelihood of a model; its filter is made when it is needed."""
        if number not in followed:
            # Jacobians depend little on the force.
            similar = next(iter(followed.values()), None)
            followed[number] = filters.follow_with_soft_friction(thetas[number], similar)
        return followed[number].log_likelihood

    # The log-likelihood at the two middle forces shows the direction in which it increases.
    middle = len(thetas) // 2
    step = 1 if log_likelihood(middle) > log_likelihood(middle - 1) else -1
    best = middle if step > 0 else middle - 1
    while 0 <= best + step < len(thetas) and log_likelihood(best + step) > log_likelihood(best):
        best += step
    return FitStart((name,), thetas[best], filters.estimate_first_states(base))


def make_soft_friction_models(
    followed: FollowedRuns, theta: Array, joint: int, sign: float = 1.0
) -> list[Array]:
    """Return models with dry friction of several sizes at a joint, for a search of the best size.

    They are for a simulator with MuJoCo's soft form. The sizes are multiples of the force that the
    filter misses at the joint. The list is empty if the library has no such effect, or if friction
    is already soft.

    Args:
        followed: the runs, without the effect.
        theta: (P,) parameters without the effect.
        joint: index of the joint.
        sign: 1 for more friction than in the model file, -1 for less.

    Returns:
        The parameters (P,) of each model, in ascending order of the size.
    """
    evaluator = followed.evaluator
    name = f"friction.coulomb@{get_joint_name(evaluator, joint)}"
    if has_soft_form(evaluator) or name not in evaluator.library:
        return []
    models = []
    for factor in SOFT_FACTORS:
        # The missing force of a sliding joint is about the force of its friction.
        size = np.array([sign * factor * float(followed.force[joint])])
        changed = theta.copy()
        changed[evaluator.coefficient_slices[name]] = clip_coefficients(evaluator, name, size)
        models.append(changed)
    return models


def _is_far_less_likely(context: SearchContext, selected: Selected, log_likelihood: float) -> bool:
    """Return whether a selection is far less likely than another model.

    This is a quick estimate: both the likelihood of the regression and that of a filter with the
    first effect of the selection must be far lower. The margin is a share of the gain of the other
    model over the base model.

    Args:
        context: search, filters and regressions of the recording; `filters.base` is the filter of
            the model without effects.
        selected: the selection.
        log_likelihood: log-likelihood of the other model.
    """
    base = context.filters.base.log_likelihood
    limit = log_likelihood - MIN_LEAD_SHARE * max(log_likelihood - base, 0.0)
    if not max(base, selected.log_likelihood) < limit:
        return False
    # One filter is made only if the regression, which needs none, does not decide.
    first = context.columns.start(selected.groups[:1], selected.coefficients[:1])
    return context.filters.log_likelihood(first.theta) < limit


def check_filter(context: SearchContext, log_likelihood: float) -> None:
    """Raise `SoftFrictionError` if soft dry friction of one joint is likelier than a model.

    Both are compared by the log-likelihoods of their filters.

    Args:
        context: search, filters and regressions of the recording.
        log_likelihood: log-likelihood of the model's filter.

    Raises:
        SoftFrictionError: soft friction is likelier.
    """
    soft_start = _find_soft_friction(context)
    if soft_start is None:
        return
    soft_log_likelihood = context.filters.log_likelihood(soft_start.theta, is_soft=True)
    if soft_log_likelihood > log_likelihood + MIN_LEAD:
        raise SoftFrictionError(soft_start)


def check_simple_friction(context: SearchContext, model: FittedModel) -> None:
    """Raise `SoftFrictionError` if soft dry friction may explain the runs as a richer law does.

    A law with several coefficients in the stiff form may imitate soft friction, which has one
    coefficient. Filters are linear, so soft friction need only be nearly as likely by a filter: the
    simulations of the search in the soft form decide. Nothing is done if the search has the soft
    form already, or if the model has no dry friction.

    Args:
        context: search, filters and regressions of the recording.
        model: the fitted model.

    Raises:
        SoftFrictionError: soft friction is nearly as likely.
    """
    filters = context.filters
    if filters.is_soft or not has_dry_friction(context.evaluator, model.effects):
        return
    count = sum(len(context.evaluator.get_coefficient_indices(name)) for name in model.effects)
    followed = filters.get_filter(model)
    # In twice the log-likelihood; soft friction saves all coefficients but one.
    margin = compute_comparison_margin(filters.compute_gain(followed))
    margin += (count - 1) * context.search.parameter_penalty
    check_filter(context, followed.log_likelihood - 0.5 * margin)


def check_fit(context: SearchContext, model: FittedModel) -> None:
    """Raise `SoftFrictionError` if a fitted model is likelier with soft dry friction.

    It is refitted with the same effects in the soft form.

    Args:
        context: search, filters and regressions of the recording.
        model: the fitted model.

    Raises:
        SoftFrictionError: the soft form is likelier.
    """
    margin = _compute_margin(context, model)
    if refit_if_likelier_soft(context.search, model, margin) is not None:
        raise SoftFrictionError


def _compute_margin(context: SearchContext, model: FittedModel) -> float:
    """Return by how much soft friction must be likelier than a model, in twice the log-likelihood.

    A model that leaves more than noise changes its likelihood a lot with any law, so the soft form
    must then gain a share of what the model gains over the base model.

    Args:
        context: search, filters and regressions of the recording.
        model: the fitted model, with stiff friction.
    """
    margin = INDISTINGUISHABLE_LOG_LIKELIHOOD_RATIO
    if is_nearly_explained(context, model):
        return margin
    gain = model.likelihood.value - context.search.base_model.likelihood.value
    return max(margin, MIN_LEAD_SHARE * gain)


def refit_if_likelier_soft(
    models: ModelSet, model: FittedModel, margin: float
) -> FittedModel | None:
    """Refit a robot model in MuJoCo's soft form of dry friction, and return it if it is likelier.

    The dry friction may be an effect or a free number. A model without dry friction, or with soft
    friction already, is not refitted.

    Args:
        models: models with stiff friction, with their noise and frozen parameters.
        model: one of these models, fitted.
        margin: minimum gain in twice the log-likelihood.

    Returns:
        The model with soft friction; None if stiff friction is kept.
    """
    if not has_dry_friction(models.evaluator, model.effects) or has_soft_form(models.evaluator):
        return None
    soft_evaluator = models.evaluator.with_kind(make_soft_kind(models.evaluator.kind))
    try:
        return choose_friction_form(models, model, soft_evaluator, margin)
    finally:
        soft_evaluator.close()


def choose_friction_form(
    models: ModelSet, model: FittedModel, other_evaluator: RunEvaluator, margin: float
) -> FittedModel | None:
    """Refit a model with the other form of dry friction, and return it if it is likelier.

    The forms are stiff and soft: how hard the constraint of MuJoCo's `frictionloss` is solved.
    Effects with a state that contain dry friction, such as hysteresis, do not act through
    `frictionloss`. They are replaced by the dry friction that they contain, because they may only
    imitate the other form.

    Args:
        models: models of the present form, with their noise and frozen parameters.
        model: one of these models, for which `has_dry_friction` is true.
        other_evaluator: run evaluator of the same runs and parameters, with a simulator of the
            other form.
        margin: minimum gain in twice the log-likelihood. The sum of squares must be lower, too.

    Returns:
        The model in the other form; None if the present form is kept.
    """
    refitted_model = _refit_with_other_form(other_evaluator, models, model)
    gain = refitted_model.likelihood.value - model.likelihood.value
    # Of two models that leave much more than noise, the likelihood with autocorrelated noise may
    # prefer the one with the larger residual, because it is smoother.
    is_residual_smaller = refitted_model.fit.cost < model.fit.cost
    return refitted_model if gain >= margin and is_residual_smaller else None


def _refit_with_other_form(
    evaluator: RunEvaluator, models: ModelSet, model: FittedModel
) -> FittedModel:
    """Fit the effects of a model with the other form of dry friction, stiff or soft.

    Both forms can then be compared by their likelihoods. If the discretisation error of the
    integrator was corrected for the model, it is corrected for the refit, too.

    Args:
        evaluator: the same runs, with a simulator of the other form.
        models: models of the present form.
        model: fitted model of these.
    """
    names, theta = replace_by_stateless_friction(models.evaluator, model.effects, model.fit.theta)
    # The random numbers of these models do not affect the result.
    other_models = ModelSet(
        evaluator,
        models.noise,
        models.fixed_parameters,
        make_rng("friction form"),
        models.is_noise_stated,
    )
    refitted_model = other_models.fit_one(FitStart(names, theta, model.fit.initial_states))
    if models.evaluator.discretisation_correction is None:
        return refitted_model
    # Both forms are compared without the discretisation error of the integrator.
    from bench.diagnosis.evaluation.discretisation_error import correct_discretisation

    correct_discretisation(
        evaluator, models.noise, refitted_model.fit.theta, refitted_model.fit.initial_states
    )
    # Otherwise the fit without the correction, which is known, might be returned again.
    other_models.models.clear()
    return other_models.fit_one(refitted_model.fit.make_start())


def fit_dry_friction(context: SearchContext, selected: Selected) -> FittedModel:
    """Fit the dry friction of a selection alone, before its other effects.

    Where joints stick, friction is far from linear, so the coefficients of the regression are poor
    starts for a fit of all effects at once. A fit of the same friction laws from before is reused:
    it is the result if it explains the runs, and else the start.

    Args:
        context: search, filters and regressions of the recording.
        selected: the selection.

    Returns:
        The fitted model, also if it does not explain the runs. The base model if the selection has
        no friction, or leaves no force missing, so that it is fitted whole.
    """
    friction = make_dry_friction_start(context, selected)
    if not friction.effects or not selected.followed.has_missing_force:
        return context.search.base_model
    fitted_before = context.search.models.get(frozenset(friction.effects))
    if fitted_before is not None and is_explained(context, fitted_before):
        return remove_idle_effects(context, fitted_before)
    if fitted_before is not None and np.isfinite(fitted_before.fit.cost):
        friction = fitted_before.fit.make_start()
    fitted = fit_by_simulation(context, friction)
    return remove_idle_effects(context, fitted) if is_explained(context, fitted) else fitted


def make_dry_friction_start(context: SearchContext, selected: Selected) -> FitStart:
    """Return a start with only the dry friction of a selection, in its form without a state.

    Friction laws with an internal state (such as bristles) are replaced by the law without one.
    Only laws are used that MuJoCo simulates by a field of its model, which is fast. A law that
    another one of them contains, such as the member of a family, is left out.

    Args:
        context: search, filters and regressions of the recording; `filters.base` is the filter of
            the model without effects, and `filters.reference` its parameters.
        selected: the selection.
    """
    evaluator, filters = context.evaluator, context.filters
    start = context.columns.start(selected.groups, selected.coefficients)
    stateless_names, stateless_theta = replace_by_stateless_friction(
        evaluator, start.effects, start.theta
    )
    model_field_effects = [
        name for name in stateless_names if name.partition("@")[0] in MODEL_FIELD_EFFECTS
    ]
    friction = [name for name in model_field_effects if has_dry_friction(evaluator, [name])]
    contained = {part for name in friction for part in evaluator.available_effects[name].contains}
    names = tuple(name for name in friction if name not in contained)
    theta = filters.reference.copy()
    for name in names:
        theta[evaluator.coefficient_slices[name]] = stateless_theta[
            evaluator.coefficient_slices[name]
        ]
    return FitStart(names, theta, filters.estimate_first_states(filters.base))


def is_friction_sufficient(
    context: SearchContext, selected: Selected, friction: FittedModel
) -> bool:
    """Return whether dry friction without an internal state follows the data as well.

    A filter follows the runs with the whole selection, and with friction laws that have an internal
    state (such as bristles) replaced by laws without, in the stiff form and in MuJoCo's soft form.
    The better log-likelihood of these two must not be clearly lower than that of the selection. The
    result is true if nothing was replaced.

    Args:
        context: search, filters and regressions of the recording.
        selected: the selection.
        friction: its dry friction, fitted alone.

    Raises:
        SoftFrictionError: the soft form is clearly likelier, and simulations confirm it.
    """
    filters = context.filters
    start = context.columns.start(selected.groups, selected.coefficients)
    _, stateless_theta = replace_by_stateless_friction(
        context.evaluator, start.effects, start.theta
    )
    stiff_log_likelihood = filters.log_likelihood(stateless_theta)
    # Minus infinity for what is not compared: the soft form if the search has it already, and the
    # selection if nothing was replaced.
    soft_log_likelihood = selected_log_likelihood = -np.inf
    if not filters.is_soft:
        soft_log_likelihood = filters.log_likelihood(stateless_theta, is_soft=True)
    if not np.array_equal(stateless_theta, start.theta):
        selected_log_likelihood = filters.log_likelihood(start.theta)
    # The ratio is twice the difference of log-likelihoods.
    margin = 0.5 * INDISTINGUISHABLE_LOG_LIKELIHOOD_RATIO
    if not max(stiff_log_likelihood, soft_log_likelihood) > selected_log_likelihood - margin:
        return False
    if soft_log_likelihood > max(stiff_log_likelihood, selected_log_likelihood) + margin:
        check_fit(context, friction)
    return True
