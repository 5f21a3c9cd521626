"""Identification of a robot's free base parameters by the likelihood of prediction errors.

A cause that the model lacks changes the estimates of the free parameters: without friction, a mass
is overestimated; without a payload, the gains of servos are. So base parameters are estimated alone
and, if they leave a force missing, together with effects, which are then removed again. The search
for causes begins at these estimates.

An effect is proposed with the free parameters at the values of the model file. With both free, the
regression would prefer gains and inertias that are all too small: far from the right model the
filter needs much process noise, and then no forces at all are nearly as likely as the right ones.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from bench.diagnosis.evaluation.noise_model import NoiseModel
from bench.diagnosis.evaluation.parameter_bounds import (
    bound_of,
    compute_range_around,
    get_bounds_by_index,
    use_bounds,
)
from bench.diagnosis.evaluation.run_evaluator import IdentifiedParameters, RunEvaluator
from bench.diagnosis.evaluation.search_control import SearchStoppedError
from bench.diagnosis.kalman.candidate_responses import compute_columns
from bench.diagnosis.kalman.likelihood_fit import (
    Follow,
    maximise_innovation_likelihood,
)
from bench.diagnosis.kalman.linearised_filter import FollowedRuns
from bench.diagnosis.prediction_error.effects_at_joints import has_many_shapes
from bench.diagnosis.prediction_error.regression_columns import group_coefficients
from bench.diagnosis.prediction_error.regression_selection import regress
from bench.diagnosis.search.candidate_directions import list_probes
from sims.core.simulator import Array

MAX_ITERATIONS = 8
"""Maximum number of Gauss-Newton steps."""
RESISTANCE = ("friction.coulomb", "drag.linear", "force.bias")
"""Effects at a joint that are fitted together with base parameters."""
MAX_JOINTS = 3
"""Maximum number of joints at which resisting effects are fitted with base parameters."""
MAX_TRIED_EFFECTS = 6
"""Maximum number of effects from a regression that are tried with base parameters."""
MIN_GAIN_SHARE = 0.8
"""Minimum gain of an effect with nominal base parameters.

It is a share of the gain of the best base parameters so far, in log-likelihood.
"""
EFFECT_ITERATIONS = 3
"""Maximum number of Gauss-Newton steps of an effect with nominal base parameters."""
MIN_GAIN = 2.0
"""Minimum gain in log-likelihood of base parameters over the nominal ones."""


class IdentifiedBase(NamedTuple):
    """Result of an identification.

    Attributes:
        followed: the runs, filtered with the identified base parameters and without any effect.
        parameters: the identified parameters; None if they are the nominal ones.
    """

    followed: FollowedRuns
    parameters: IdentifiedParameters | None


class _Start(NamedTuple):
    """Start of a fit of base parameters.

    Attributes:
        followed: the runs, filtered with the initial parameters.
        effects: names of the effects that are fitted too.
        penalty: minimum gain in log-likelihood that these effects need.
        is_cause: whether the effects may be a cause of the gap.
    """

    followed: FollowedRuns
    effects: Sequence[str]
    penalty: float = 0.0
    is_cause: bool = False


def identify_base(
    evaluator: RunEvaluator, noise: NoiseModel, followed: FollowedRuns, is_resisted: bool = False
) -> IdentifiedBase:
    """Identify the base parameters of a robot from the innovations (prediction errors) of a filter.

    An effect that the model lacks biases the estimates. So up to three fits are tried, until one
    leaves no force missing:

    1. the parameters alone;
    2. together with friction and constant forces at the joints;
    3. together with the effect of the library that explains most.

    The likeliest fit gives the parameters. Fits that do not follow the runs, or end at the widest
    bounds of a parameter, do not count. The effects are then removed again, and the runs are
    filtered with the parameters alone.

    Args:
        evaluator: the runs for fitting; ranges that do not contain an estimate are replaced.
        noise: sensor noise.
        followed: the runs, filtered with the nominal parameters.
        is_resisted: whether friction is certain, so that only the fit with friction and constant
            forces is made.

    Returns:
        The filter and the identified parameters, with the effects of the third fit if it is the
        likeliest and leaves no force missing. `parameters` is None and the filter is the given one,
        with nominal parameters, if no fit counts or gains enough, or if the search has to end.
    """
    search_control = evaluator.search_control

    def follow(theta: Array, best: FollowedRuns) -> FollowedRuns:
        """Filter the runs with other parameters; the process noise starts from that of `best`."""
        search_control.begin_stage("identifying the base parameters")
        return FollowedRuns.follow(evaluator, theta, noise, force=best.force)

    base_indices = evaluator.base_indices.tolist()
    # The widest bounds of each base parameter.
    limits = {i: compute_range_around(evaluator, i) for i in base_indices}
    # A fit must exceed the nominal parameters by MIN_GAIN.
    best, best_log_likelihood = followed, followed.log_likelihood + MIN_GAIN
    effects: dict[str, Array] = {}
    # Starts are made late, because the last one depends on the best fit before it.
    start_makers: list[Callable[[], _Start | None]] = [
        lambda: _Start(followed, _list_resisting_effects(followed))
    ]
    if not is_resisted:
        start_makers.insert(0, lambda: _Start(followed, ()))
        start_makers.append(lambda: _start_with_effect(followed, best, follow))
    for make_start in start_makers:
        try:
            start = make_start()
            if start is None:
                continue
            bounds = limits | get_bounds_by_index(evaluator, start.effects)
            fitted = maximise_innovation_likelihood(start.followed, bounds, MAX_ITERATIONS, follow)
        except SearchStoppedError:
            # An unfinished identification counts as none, and the search is marked as incomplete.
            search_control.record_abandoned_fit(True)
            return IdentifiedBase(followed, None)
        is_at_bound = any(bound_of(float(fitted.theta[i]), *limits[i]) for i in base_indices)
        log_likelihood = fitted.log_likelihood - start.penalty
        if not fitted.has_expected_innovations or is_at_bound:
            continue
        # Without a missing force, further fits with effects are not needed.
        is_complete = not fitted.has_missing_force
        if log_likelihood > best_log_likelihood:
            best, best_log_likelihood = fitted, log_likelihood
            causes = start.effects if start.is_cause and is_complete else ()
            effects = {name: fitted.theta[evaluator.coefficient_slices[name]] for name in causes}
        if is_complete:
            break
    if best is followed:
        return IdentifiedBase(followed, None)
    _widen_ranges(evaluator, best.theta)
    # Without the effects, whose coefficients are zero in the given filter.
    theta = followed.theta.copy()
    theta[base_indices] = best.theta[base_indices]
    identified = IdentifiedParameters(theta[evaluator.base_indices], effects)
    return IdentifiedBase(follow(theta, best), identified)


def _widen_ranges(evaluator: RunEvaluator, theta: Array) -> None:
    """Replace the range of each base parameter that does not contain its estimate.

    The new range lies around the estimate.

    Args:
        evaluator: the runs, in which the ranges are replaced.
        theta: (P,) parameters with the estimates.
    """
    wider_bounds = {}
    for i in evaluator.base_indices.tolist():
        value, (low, high) = float(theta[i]), evaluator.parameters[i].bounds
        if not low <= value <= high:
            wider_bounds[evaluator.parameters[i].name] = compute_range_around(evaluator, i, value)
    use_bounds(evaluator, wider_bounds)


def _list_resisting_effects(followed: FollowedRuns) -> list[str]:
    """Return names of effects that resist the motion of the joints with the largest missing forces.

    These are friction, drag and a constant force, as far as the evaluator has them. The joints are
    the first `MAX_JOINTS` in descending order of the loss in likelihood if the filter gets no
    process noise there, which stands for a missing force.

    Args:
        followed: the runs, filtered without these effects.
    """
    evaluator = followed.evaluator
    coordinates = evaluator.simulator.system.coordinates
    joints = [coordinates[j].removeprefix("q.") for j in followed.joints_by_loss[:MAX_JOINTS]]
    names = [f"{effect}@{joint}" for joint in joints for effect in RESISTANCE]
    return [name for name in names if name in evaluator.coefficient_slices]


def _start_with_effect(followed: FollowedRuns, best: FollowedRuns, follow: Follow) -> _Start | None:
    """Return a start with the effect that explains most while base parameters are nominal.

    A regression of the innovations ranks the effects of the library. The best few are put into the
    filter's model one by one, and their coefficients are improved. An effect that ends at a bound
    other than zero is left out. The start contains the likeliest one.

    Args:
        followed: the runs, filtered with the nominal parameters.
        best: the runs, filtered with the best parameters so far.
        follow: filters the runs with other parameters.

    Returns:
        The start; None if the regression proposes no effect whose gain in likelihood is at least
        the share `MIN_GAIN_SHARE` of that of the best parameters so far.
    """
    evaluator = followed.evaluator
    names = [name for name in evaluator.library if not has_many_shapes(name)]
    evaluator.search_control.begin_stage(f"testing {len(names)} effects with the base parameters")
    columns = compute_columns(followed, list_probes(evaluator, (), names))
    regression = regress(followed, [columns])
    gains = regression.compute_net_gains()
    # Gain in log-likelihood of the best base parameters so far.
    best_gain = best.log_likelihood - followed.log_likelihood
    starts, tried = list[_Start](), set[str]()
    # An effect has one group of columns for each of its shapes: its best one comes first.
    for i in np.argsort(-gains, kind="stable").tolist():
        group = regression.groups[i]
        if len(tried) == MAX_TRIED_EFFECTS or not gains[i] > 0.0:
            break
        if group.effect in tried:
            continue
        tried.add(group.effect)
        theta = followed.theta.copy()
        (solution,) = regression.solve([group]).coefficients
        theta[evaluator.coefficient_slices[group.effect]] = group_coefficients(
            evaluator, columns.probes, group, solution
        )
        bounds = get_bounds_by_index(evaluator, [group.effect])
        # The coefficients of the regression alone must already gain much.
        fitted = follow(theta, followed)
        if fitted.log_likelihood - followed.log_likelihood < MIN_GAIN_SHARE * best_gain:
            continue
        fitted = maximise_innovation_likelihood(fitted, bounds, EFFECT_ITERATIONS, follow)
        # At a bound other than zero, the effect stands in for something else.
        values = {index: float(fitted.theta[index]) for index in bounds}
        if any(value and bound_of(value, *bounds[index]) for index, value in values.items()):
            continue
        # The price, the minimum gain of an effect, is in twice the log-likelihood.
        penalty = 0.5 * regression.price(group)
        starts.append(_Start(fitted, (group.effect,), penalty, is_cause=True))
    return max(starts, key=lambda one: one.followed.log_likelihood - one.penalty, default=None)
