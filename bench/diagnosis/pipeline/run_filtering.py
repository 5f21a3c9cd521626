"""Filter the runs of a robot with a Kalman filter, before the base model is fitted."""

from __future__ import annotations

from typing import TYPE_CHECKING

from bench.diagnosis.pipeline.simulated_runs import SimulatedRuns

if TYPE_CHECKING:
    from bench.diagnosis.kalman.linearised_filter import FollowedRuns

MAX_FORCE_SHARE_AT_CONTACTS = 1.0
"""Maximum missing force of a filter, as a share of the typical force, if the robot has contacts."""
MAX_JOINTS_OF_NONLINEAR_FILTER = 8
"""Maximum number of joints of a robot whose states in contact a cubature filter estimates."""


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
    is_nonlinear = needs_nonlinear_filter(runs)
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
    # 3. Held-out runs. The first run evaluator is that of the runs for fitting.
    for evaluator in runs.evaluators[1:]:
        # Held-out runs are only simulated; without a filter they begin at their measured values.
        theta = evaluator.get_nominal_theta()
        held_out = FollowedRuns.follow(evaluator, theta, runs.noise, max_linearisations=1)
        if held_out.has_expected_innovations:
            evaluator.follow(held_out)


def needs_nonlinear_filter(runs: SimulatedRuns) -> bool:
    """Return whether a robot is in contact, and its linear model fails there.

    The depth of a contact is smaller than the noise of most encoders, so that a model that is
    linearised about the readings has wrong contact forces. The filter then needs a missing force
    that is larger than all typical forces. A robot on the ground is linearised about a simulated
    motion instead. Another robot with many joints keeps the linear model, with process noise at its
    contacts: the nonlinear filter, whose time grows with the square of the number of joints, would
    take hours.

    Args:
        runs: Runs of a robot. Their filter with the linear model has the missing force (standard
            deviation of the process noise) and the typical force of each joint.
    """
    filtered_runs = runs.nominal_filter
    force_share = float((filtered_runs.force / filtered_runs.typical).max())
    has_few_joints = len(filtered_runs.typical) <= MAX_JOINTS_OF_NONLINEAR_FILTER
    # Negated, so that the NaN of a filter that diverged counts as wrong.
    is_wrong = not force_share <= MAX_FORCE_SHARE_AT_CONTACTS
    return runs.contacts.has_contacts_off_ground and has_few_joints and is_wrong


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
