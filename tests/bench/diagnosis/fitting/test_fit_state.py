"""Tests of Jacobians that serve for several steps: their updates and their renewal."""

from dataclasses import replace

import numpy as np
import pytest

from bench.diagnosis.evaluation.discretisation_error import MAX_CORRECTED_ERROR, StepRefinement
from bench.diagnosis.fitting.levenberg_marquardt import (
    INITIAL_DAMPING,
    INITIAL_DAMPING_GROWTH,
    FitPoint,
    FitStart,
    FitState,
    KnownJacobian,
)
from sims.robot.integrator_settings import IntegratorSettings

RNG = np.random.default_rng(4)
RUNS, LENGTH, CHANNELS, SHARED, STATES = 2, 7, 2, 3, 2
TRUE = RNG.normal(size=(RUNS, LENGTH, CHANNELS, SHARED + STATES))


def linear(theta, states):
    """Return the observations (R, T, C) of a linear model."""
    unknown = np.concatenate([np.broadcast_to(theta, (RUNS, SHARED)), states], axis=1)
    return np.einsum("rtcq,rq->rtc", TRUE, unknown)


def at(theta, states, jacobian):
    start = FitStart((), np.array(theta), np.array(states))
    return FitPoint(start, linear(start.theta, start.initial_states), jacobian, 1.0)


def problem(jacobian, steps=None):
    """Return a fit state at zero whose Jacobian may be wrong."""
    zero = at(np.zeros(SHARED), np.zeros((RUNS, STATES)), jacobian)
    steps = np.ones(SHARED + STATES) if steps is None else steps
    bounds = -np.ones(SHARED), np.ones(SHARED), 2 * np.ones(SHARED)
    damping = np.full((RUNS, STATES), INITIAL_DAMPING)
    growth = np.full((RUNS, STATES), INITIAL_DAMPING_GROWTH)
    predicted = np.zeros((RUNS, CHANNELS))
    return FitState(
        zero, np.arange(SHARED), *bounds, steps, np.eye(CHANNELS, STATES, dtype=bool),
        damping, growth, predicted,
    )  # fmt: skip


def moved(theta, states):
    return np.concatenate([np.broadcast_to(theta, (RUNS, SHARED)), states], axis=1)


def test_derivatives_agree_with_the_step_that_they_have_learnt_from():
    wrong = TRUE + RNG.normal(size=TRUE.shape)
    theta, states = RNG.normal(size=SHARED), RNG.normal(size=(RUNS, STATES))
    learnt = problem(wrong).update_jacobian(at(theta, states, wrong))
    step = moved(theta, states)
    np.testing.assert_allclose(np.einsum("rtcq,rq->rtc", learnt, step), linear(theta, states))
    across = RNG.normal(size=step.shape)
    across -= step * np.sum(across * step, axis=1, keepdims=True) / np.sum(step**2, axis=1)[:, None]
    before, after = (np.einsum("rtcq,rq->rtc", j, across) for j in (wrong, learnt))
    np.testing.assert_allclose(after, before, err_msg="nothing was seen across the step")


def test_as_many_steps_as_unknowns_make_derivatives_right():
    """The steps move one unknown after another, each on its own scale."""
    steps = 10.0 ** RNG.uniform(-4, 2, SHARED + STATES)
    jacobian = np.zeros_like(TRUE)
    for k in range(SHARED + STATES):
        unit = steps * (np.arange(SHARED + STATES) == k)
        theta, states = unit[:SHARED], np.tile(unit[SHARED:], (RUNS, 1))
        jacobian = problem(jacobian, steps).update_jacobian(at(theta, states, jacobian))
    np.testing.assert_allclose(jacobian, TRUE, rtol=1e-9)


def test_a_run_that_nothing_moved_teaches_nothing():
    wrong = TRUE + 1.0
    states = np.array([[0.0, 0.0], [0.3, -0.1]])
    learnt = problem(wrong).update_jacobian(at(np.zeros(SHARED), states, wrong))
    assert np.array_equal(learnt[0], wrong[0])
    assert not np.allclose(learnt[1], wrong[1])


def test_what_has_converged_with_derivatives_of_another_point_is_not_believed():
    there = problem(TRUE)
    there.has_own_jacobian = False
    there.mark_converged()
    assert (there.is_finished, there.is_jacobian_stale, there.is_waiting) == (False, True, True)
    there.has_own_jacobian = True
    there.mark_converged()
    assert there.is_finished


@pytest.mark.parametrize(
    ("mean_square", "can_stick", "own_cost", "asks"),
    [
        pytest.param(2.0, True, np.inf, True, id="sticks"),
        pytest.param(2.0, False, np.inf, False, id="cannot stick"),
        pytest.param(1.0, True, np.inf, False, id="leaves only noise"),
        pytest.param(20.0, True, np.inf, False, id="is very far"),
        pytest.param(2.0, True, 200.0, False, id="has them at this cost"),
    ],
)
def test_a_fit_of_sticking_joints_asks_for_derivatives_of_its_own(
    mean_square, can_stick, own_cost, asks
):
    state = problem(TRUE)
    state.sample_count = 100
    state.point = replace(state.point, cost=100 * mean_square)
    state.can_stick, state.own_state_cost = can_stick, own_cost
    state.mark_converged()
    assert (state.needs_own_state_jacobian, state.is_jacobian_stale) == (asks, asks)
    assert state.is_finished is not asks
    state.is_finished = state.is_jacobian_stale = False
    state.predicted_decrease = 50.0
    state.reject_step()
    assert state.is_jacobian_stale is asks
    assert not state.is_finished


def test_known_derivatives_follow_the_parameters_that_they_are_by():
    known = KnownJacobian(np.array([0, 4, 5]), TRUE[..., :3])
    fewer = known.drop_parameters([4])
    assert fewer.free_indices.tolist() == [0, 5]
    assert np.array_equal(fewer.jacobian, TRUE[..., [0, 2]])
    more = fewer.add_parameters(range(7, 9), TRUE[..., 3:])
    assert more.free_indices.tolist() == [0, 5, 7, 8]
    assert np.array_equal(more.jacobian, TRUE[..., [0, 2, 3, 4]])


@pytest.mark.parametrize(
    ("rest", "left", "suits"),
    [(0.09, 0.0, True), (0.11, 1.0, False), (0.6, 11.0, False), (0.6, 13.0, True)],
)
def test_a_step_suits_whose_error_is_small_against_the_noise_or_the_residual(rest, left, suits):
    own = IntegratorSettings(0.002, "Euler")
    fine = StepRefinement(object, own, own._replace(timestep=0.001), 5.0, rest)
    assert MAX_CORRECTED_ERROR == 0.1
    assert fine.is_accurate_enough(left) is suits


@pytest.mark.parametrize(
    ("rough", "decrease", "is_finished"),
    [(True, 0.9, True), (True, 0.4, False), (False, 0.9, False)],
)
def test_a_rough_fit_ends_at_gains_that_its_own_derivatives_do_not_predict(
    rough, decrease, is_finished
):
    state = problem(TRUE)
    state.has_rough_cost, state.is_final_fit, state.predicted_decrease = rough, True, 0.3
    state.accept_step(decrease, 1000.0, is_own_jacobian=True)
    assert state.is_finished == is_finished


def test_only_the_states_of_a_joint_that_a_step_gets_wrong_are_damped():
    """The first state is shown by the first channel, the second by the second one."""
    state = problem(TRUE)
    state.has_rough_cost = True
    state.predicted_decreases = np.array([[10.0, 10.0], [10.0, 10.0]])
    decreases = np.array([[9.0, -50.0], [9.0, 1.0]])
    state.adapt_state_damping(decreases, np.array([False, True]))
    # Eq. (3) where a step loses or gains far too little, (2) where the run moves, else as before.
    np.testing.assert_allclose(
        state.state_damping / INITIAL_DAMPING, [[1.0, 4.0], [1 - 0.8**3, 4.0]]
    )
    state.predicted_decreases = np.array([[-5.0, 10.0], [0.0, 10.0]])
    state.adapt_state_damping(np.array([[-6.0, -50.0], [0.0, 10.0]]), np.array([True, True]))
    # A loss as predicted changes nothing; the second failure in a row doubles the growth.
    np.testing.assert_allclose(
        state.state_damping / INITIAL_DAMPING, [[1.0, 32.0], [1 - 0.8**3, 0.4]]
    )
