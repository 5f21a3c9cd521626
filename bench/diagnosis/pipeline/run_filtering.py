"""Filter the runs of a robot with a Kalman filter, before the base model is fitted."""

from __future__ import annotations

from typing import TYPE_CHECKING

from bench.diagnosis.pipeline.simulated_runs import SimulatedRuns

if TYPE_CHECKING:
    from bench.diagnosis.kalman.linearised_filter import FollowedRuns


def filter_simulated_runs(runs: SimulatedRuns) -> None:
    """Filter the runs of a robot with the present model (Kalman filter and smoother).

    The filter, stored in the evaluators, provides initial states and starting values of free
    parameters, and later the search by prediction errors.

    1. Filter the runs for fitting with the numbers of the model file. If the linearised model is
       not valid, nothing is stored, and causes are searched by simulation; for a robot in contact,
       a nonlinear filter then estimates the initial states.
    2. Filter them again with fitted base parameters, unless a tuner fits these.
    3. Filter the held-out runs.

    Args:
        runs: the runs of a robot; their run evaluators receive the filters.
    """
    # This import is needed for robots only.
    from bench.diagnosis.kalman.linearised_filter import FollowedRuns

    context = runs.context
    context.search_control.begin_stage("computing prediction errors")
    # 1. Model file.
    filtered_runs = runs.nominal_filter
    is_nonlinear = runs.contacts.needs_nonlinear_filter(filtered_runs)
    # Innovations larger than expected mean that the filter does not follow the runs.
    if is_nonlinear or not filtered_runs.has_expected_innovations:
        if runs.contacts.has_contacts:
            # This import is needed for robots only.
            from bench.diagnosis.kalman.cubature_filter import set_first_states_in_contact

            theta = runs.fitting.get_nominal_theta()
            set_first_states_in_contact(runs.evaluators, theta, runs.noise.sigma)
        return
    # 2. Base parameters.
    if runs.fitting.base_indices.size and context.options.tuner is None:
        filtered_runs = _filter_with_fitted_parameters(runs)
    runs.fitting.follow(filtered_runs)
    if context.search_control.is_over():
        return
    # 3. Held-out runs.
    for evaluator in runs.evaluators[1:]:
        # Held-out runs are only simulated; without a filter they begin at their measured values.
        theta = evaluator.get_nominal_theta()
        held_out = FollowedRuns.follow(evaluator, theta, runs.noise, max_linearisations=1)
        if held_out.has_expected_innovations:
            evaluator.follow(held_out)


def _filter_with_fitted_parameters(runs: SimulatedRuns) -> FollowedRuns:
    """Return the runs, filtered with base parameters from a prediction-error fit.

    The fitted parameters are stored in context and evaluator, unless the fit keeps the nominal
    ones.

    Args:
        runs: the runs of a robot with free numbers of its model file.
    """
    # These imports are needed for robots only.
    from bench.diagnosis.prediction_error.base_parameter_identification import identify_base
    from bench.diagnosis.prediction_error.stepwise_selection_by_filters import is_long

    evaluator = runs.fitting
    with runs.record_widened_ranges():
        # Long recordings are those of real robots, whose joints certainly have friction: then only
        # a fit with friction is made (`is_resisted`).
        result = identify_base(
            evaluator, runs.noise, runs.nominal_filter, is_resisted=is_long(evaluator)
        )
    if result.parameters is not None:
        runs.context.identified = evaluator.identified = result.parameters
    return result.followed
