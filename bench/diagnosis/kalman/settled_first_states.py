"""First states of a robot on the ground that are in contact equilibrium, and their fit.

A robot on the ground stands or drives, and its pose is recorded. The noise of the pose makes
contacts too deep or opens them, so that a simulation from a measured state begins with a jump. A
first state is settled if its contacts are in equilibrium (`contact_equilibrium` of the robot's
dynamics).

Shapes: R runs of T samples, C channels, and D coordinates; a state has D positions and D
velocities.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from bench.diagnosis.evaluation.noise_model import Mask, NoiseModel
from bench.diagnosis.evaluation.run_evaluator import RunEvaluator
from bench.diagnosis.kalman.kinematic_smoother import estimate_measured_states
from sims.core.simulator import Array
from sims.robot.dynamics.contact_equilibrium import ContactModel, KnownJacobians, settle_contacts
from sims.robot.robot_simulator import RobotSimulator

MEASURED_PRIOR = 10.0
"""Prior standard deviation of a first state of a robot on the ground, in units of its noise.

The noise of a velocity is that of positions per sample interval.
"""
MAX_FIRST_STATE_STEPS = 5
"""Maximum number of Gauss-Newton steps of the first states of a robot on the ground."""
STEP_SHARES = (1.0, 0.5, 0.1)
"""Shares of such a step that are tried."""
MIN_STEP_DECREASE = 0.02
"""Minimum relative decrease of the sum of squares for another such step."""


class FirstState(NamedTuple):
    """First state of a run of a robot on the ground.

    Attributes:
        state: (2 D,) positions and velocities.
        weights: (2 D, 2 D) square root W of the inverse W^T W of its covariance.
    """

    state: Array
    weights: Array


class FirstStateFactors(NamedTuple):
    """Factors of the derivatives H of the readings by the first states, with their prior.

    H is in units of the noise, and p are the prior standard deviations of the first states:

        Q R = [H; diag(1 / p)]

    R^T R is the inverse covariance of the first states, if no force is missing. Columns of Q span
    what first states explain.

    Attributes:
        q: (R, n, 2 D) Q of each run; its n rows are readings, then first states.
        r: (R, 2 D, 2 D) R of each run.
    """

    q: Array
    r: Array


def get_state_noise(evaluator: RunEvaluator, noise: NoiseModel) -> tuple[Array, Array]:
    """Return the noise (D,) of positions, and that of velocities computed from their differences.

    Both are standard deviations: of D positions in rad or m, and of their differences per sample
    interval, in rad/s or m/s.

    Args:
        evaluator: the runs of a robot on the ground, whose joints are recorded.
        noise: sensor noise of each channel.
    """
    channels = list(evaluator.channels)
    names = evaluator.simulator.system.coordinates
    positions = np.array([noise.sigma[channels.index(name)] for name in names])
    return positions, positions / evaluator.sample_interval


def compute_measured_state_prior(evaluator: RunEvaluator, noise: NoiseModel) -> Array:
    """Return prior standard deviations (2 D,) of first states, multiples of the position noise.

    A first state far from the readings would have other contacts open or closed.
    """
    return MEASURED_PRIOR * np.concatenate(get_state_noise(evaluator, noise))


def settle_first_state(
    evaluator: RunEvaluator,
    simulator: RobotSimulator,
    theta: Array,
    noise: NoiseModel,
    run: int,
    first_state: FirstState | None,
) -> tuple[Array, Array]:
    """Return the first positions and velocities (D,) of a run at which contacts are in equilibrium.

    From there, a simulation does not begin with a jump.

    Args:
        evaluator: the runs of a robot on the ground.
        simulator: simulator of the robot, perhaps with other contact settings than the evaluator's.
        theta: (P,) parameters of the model.
        noise: sensor noise of each channel.
        run: index of the run.
        first_state: state near the result, with its weights; None to estimate it from the readings
            alone, with independent errors.
    """
    if first_state is None:
        x, v = np.split(evaluator.initial_state_guesses[run].copy(), 2)
        weights = None
        # Position, velocity and acceleration of each recorded joint at the first sample.
        for joint, states in estimate_measured_states(evaluator, noise.sigma, run).items():
            x[joint], v[joint], _ = states[0]
    else:
        x, v = np.split(first_state.state, 2)
        weights = first_state.weights
    model, scenario = ContactModel(simulator, theta), evaluator.prepared_runs[run].scenario
    return settle_contacts(model, scenario, (x, v), get_state_noise(evaluator, noise), weights)


@dataclass(frozen=True)
class FirstStateFitter:
    """Settles the first states of a robot on the ground, and fits them by simulation.

    Attributes:
        evaluator: the runs.
        noise: sensor noise of each channel.
        recorded: (R, T, C) mask of recorded samples.
        sensitivities: (R, T, C, 2 D) derivatives of simulated readings by the first states.
    """

    evaluator: RunEvaluator
    noise: NoiseModel
    recorded: Mask
    sensitivities: Array

    @cached_property
    def factors(self) -> FirstStateFactors:
        """QR factors of what the readings and the prior tell about the first states of each run."""
        # Derivatives H of the readings (R, T, C, 2 D) in units of the noise, and the rows for the
        # prior standard deviations p, diag(1 / p).
        derivatives = self.scale_by_noise(self.sensitivities)
        prior = np.diag(1.0 / compute_measured_state_prior(self.evaluator, self.noise))
        # Q R = [H; diag(1 / p)] of each run.
        factors = [
            np.linalg.qr(np.concatenate([run_derivatives.reshape(-1, len(prior)), prior]))
            for run_derivatives in derivatives
        ]
        return FirstStateFactors(np.array([f.Q for f in factors]), np.array([f.R for f in factors]))

    def add_weights(self, states: Array) -> list[FirstState]:
        """Return first states (R, 2 D), each with the square root of its inverse covariance."""
        return [FirstState(*pair) for pair in zip(states, self.factors.r, strict=True)]

    def scale_by_noise(self, values: Array) -> Array:
        """Return values of the readings (R, T, C, ...) in units of the noise; 0 if not recorded."""
        sigma = self.noise.sigma.reshape(-1, *[1] * (values.ndim - 3))
        with np.errstate(all="ignore"):
            scaled: Array = values / sigma
        scaled[~self.recorded] = 0.0
        return scaled

    def improve_first_states(self, theta: Array, states: Array) -> Array:
        """Return settled first states (R, 2 D) whose simulations are closer to the readings.

        The given states come from a smoother, which explains a part of the readings by missing
        forces that a simulation does not have. Gauss-Newton steps minimise the residual of the
        simulated runs instead, with the prior of first states. After each step, the contacts are
        brought into equilibrium ("settled"), since other states begin with a jump, which would end
        the fit in a local minimum.

        Args:
            theta: (P,) parameters of the model, near those of the linearisation.
            states: (R, 2 D) settled positions and velocities of D coordinates in R runs.
        """
        runs = np.arange(len(states))
        squares = self.compute_squares(theta, states)
        for _ in range(MAX_FIRST_STATE_STEPS):
            # One row for each run.
            residuals = self.simulate_residuals(theta, states).reshape(len(states), -1)
            # The Gauss-Newton step solves R step = Q' residual with the QR factors of the
            # derivatives. Q has further rows for the prior, which is about the present states of
            # each step, so that its residual is zero and its rows are left out.
            steps = np.array(
                [
                    np.linalg.solve(r, q[: residual.size].T @ residual)
                    for q, r, residual in zip(*self.factors, residuals, strict=True)
                ]
            )
            # Each run takes the best share of its step, or none.
            tried, all_squares = [states], [squares]
            for share in STEP_SHARES:
                tried.append(self.settle(theta, states + share * steps))
                all_squares.append(self.compute_squares(theta, tried[-1]))
            best = np.argmin(all_squares, axis=0)
            states, new_squares = np.array(tried)[best, runs], np.array(all_squares)[best, runs]
            # The sum of squares over all runs hardly decreases.
            is_converged = new_squares.sum() > (1.0 - MIN_STEP_DECREASE) * squares.sum()
            squares = new_squares
            if is_converged:
                break
        return states

    def fit_settled_states(self, theta: Array, states: Array) -> Array:
        """Return first states (R, 2 D) in contact equilibrium, fitted for other parameters.

        Args:
            theta: (P,) parameters of the model, perhaps of another geometry.
            states: (R, 2 D) first states for parameters nearby.
        """
        settled = self.settle(theta, states, is_other_geometry=True)
        return self.improve_first_states(theta, settled)

    def simulate(self, theta: Array, states: Array) -> Array:
        """Simulate all runs (R, T, C) from given first states.

        Args:
            theta: (P,) parameters of the model.
            states: (R, 2 D) positions and velocities of D coordinates in R runs.
        """
        number = len(states)
        return self.evaluator.simulate(np.tile(theta, (number, 1)), np.arange(number), states)

    def simulate_residuals(self, theta: Array, states: Array) -> Array:
        """Return the residuals (R, T, C) of simulations from first states, in units of the noise.

        Args:
            theta: (P,) parameters of the model.
            states: (R, 2 D) positions and velocities of D coordinates in R runs.
        """
        return self.scale_by_noise(self.evaluator.observed - self.simulate(theta, states))

    def compute_squares(self, theta: Array, states: Array) -> Array:
        """Return the sum of squared residuals of each run (R,); infinite if it diverges.

        Residuals are those of simulations, in units of the noise.

        Args:
            theta: (P,) parameters of the model.
            states: (R, 2 D) positions and velocities of D coordinates in R runs.
        """
        with np.errstate(all="ignore"):
            squares = np.square(self.simulate_residuals(theta, states)).sum(axis=(1, 2))
        result: Array = np.where(np.isfinite(squares), squares, np.inf)
        return result

    def settle(
        self,
        theta: Array,
        states: Array,
        is_other_geometry: bool = False,
        known_jacobians: Sequence[KnownJacobians] | None = None,
    ) -> Array:
        """Return first states (R, 2 D) near given ones at which the contacts are in equilibrium.

        Otherwise a simulated robot would jump at the first step, because noise of its pose makes
        contacts too deep.

        Args:
            theta: (P,) parameters of the model.
            states: (R, 2 D) positions and velocities of D coordinates in R runs.
            is_other_geometry: whether the states may be those of another geometry, so that contacts
                farther apart may be closed.
            known_jacobians: derivatives of contacts for each run, see `settle_contacts`; None to
                compute them.
        """
        simulator = self.evaluator.simulator
        assert isinstance(simulator, RobotSimulator)
        # A contact is closed only if it is this near. Another geometry moves the points of contact
        # by more than the noise.
        factor = MEASURED_PRIOR if is_other_geometry else 1.0
        position_noise, velocity_noise = get_state_noise(self.evaluator, self.noise)
        deviations = factor * position_noise, factor * velocity_noise
        model, settled = ContactModel(simulator, theta), []
        for run, state in enumerate(states):
            scenario = self.evaluator.prepared_runs[run].scenario
            x, v = np.split(state, 2)
            known = known_jacobians[run] if known_jacobians is not None else None
            start = settle_contacts(model, scenario, (x, v), deviations, self.factors.r[run], known)
            settled.append(np.concatenate(start))
        return np.array(settled)
