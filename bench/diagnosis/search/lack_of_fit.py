"""Lack-of-fit test: structure in the residual that no effect of the library explains.

A hat is a triangular basis function of time, position or speed: eq. (1) of
`bench.diagnosis.search.lack_of_fit`. The forces here are for systems in which each coordinate has
its own drive and friction.

There are two tests. If the recording specifies its noise, the residual must not exceed it. In any
case, an additional force of any shape must not improve the fit. Hat basis functions over time,
position and speed, along each axis and against the motion, represent unknown causes (a
nonparametric lack-of-fit test; J. D. Hart, Nonparametric Smoothing and Lack-of-Fit Tests, 1997,
doi:10.1007/978-1-4757-2722-7). The test is calibrated by surrogates, like the score test.

A hat of width w around a centre m of a variable z (time, position or speed) is a force

    f(z) = c max(1 - |z - m| / w, 0) d                                                         (1)

with direction d. Neighbouring hats overlap by half, so the sum of a family over one variable is any
piecewise linear force with `HAT_COUNT` knots.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from bench.diagnosis.evaluation.autoregressive_surrogates import draw_surrogates
from bench.diagnosis.evaluation.noise_model import compute_sigma_standard_error
from bench.diagnosis.evaluation.run_evaluator import RunEvaluator
from bench.diagnosis.fitting.fitted_models import FittedModel, ModelSet
from bench.diagnosis.fitting.trajectory_derivatives import CandidateDirection
from bench.diagnosis.search.candidate_directions import (
    DirectionSet,
    compute_responses,
)
from bench.diagnosis.search.score_test import ScoreTest, compute_calibrated_scores
from bench.diagnosis.search.verdict_rules import (
    STRUCTURE_P_VALUE_THRESHOLD,
    exceeds_noise,
    get_structure_threshold,
    has_structure,
)
from sims.core.effect import Coefficient, Effect, Force
from sims.core.simulator import Array
from sims.core.system import StateSnapshot
from sims.system_simulator import SystemSimulator

TIME, POSITION, SPEED = 0, 1, 2
"""Variables of a hat: time, position or speed of the joint."""
ALONG, AGAINST, DRY = 0, 1, 2
"""Directions of a hat: along the joint, against its motion in proportion to speed, or dry."""
HIGH_SPEED_QUANTILE = 0.98
"""Quantile of the recorded speed that counts as the highest speed of a joint."""


class JointHatForce(Force):
    """A force within an interval of time, position or speed of one joint."""

    name = "probe.joint_hat"
    says = "a force acts in an interval of time, position or speed"
    source = "this module"
    of = "probe.joint_hat"
    is_traceable = False  # joint, variable and direction are chosen by the values of coefficients
    coefficients = tuple(
        Coefficient(name, ("1", "1", "1"), ((-1, 1), (-1, 1), (-1, 1)))
        for name in ("strength", "joint", "variable", "centre", "width", "direction", "slow")
    )

    def force(self, c: Array, moment: StateSnapshot) -> Array:
        """Return the hat force on one joint: its strength times a triangle around the centre.

        It acts while time, position or speed is near the centre, eq. (1) of the module docstring.
        The direction is along the joint, against its motion in proportion to speed, or against it
        as dry friction. All active batch elements of a call have the same joint, variable and
        direction; the force of the others is zero.

        Shapes: B batch elements, J joints.

        Args:
            c: (7, B, 1) coefficients: strength, index of the joint, index of the variable (`TIME`,
                `POSITION`, `SPEED`), centre, half-width, index of the direction (`ALONG`,
                `AGAINST`, `DRY`), and speed over which dry friction reverses.
            moment: state of the batch: time t, positions x (B, J) and velocities v (B, J).

        Returns:
            Forces (B, J) at the joints, zero at all joints but one.
        """
        strength, joint, variable, centre, width, direction, reversal_speed = c
        active_elements = np.flatnonzero(strength[:, 0])
        # The hat is off in all batch elements.
        if not active_elements.size:
            return np.zeros_like(moment.x)
        joint_index, variable_index, direction_index = (
            int(indices[active_elements[0], 0]) for indices in (joint, variable, direction)
        )
        x, v = moment.x[:, joint_index, None], moment.v[:, joint_index, None]
        # In the order of `TIME`, `POSITION` and `SPEED`.
        value = (moment.t, x, np.abs(v))[variable_index]
        # A hat that is off has zero width, which must not be a divisor.
        height = np.maximum(1.0 - np.abs(value - centre) / np.maximum(width, 1e-12), 0.0)
        # Dry friction, whose sign changes smoothly at the reversal speed.
        dry_direction = -v / (np.abs(v) + np.maximum(reversal_speed, 1e-9))
        # In the order of `ALONG`, `AGAINST` and `DRY`.
        force_direction = (np.ones_like(v), -v, dry_direction)[direction_index]
        forces = np.zeros_like(moment.x)
        forces[:, joint_index] = (strength * height * force_direction)[:, 0]
        return forces


HAT_COUNT = 7
"""Number of hats over the range of a variable."""
SURROGATE_COUNT = 150
"""Number of surrogate residuals that calibrate the test."""
SIGN_CHANGE_SPEED_SHARE = 0.05
"""Speed over which dry friction reverses its sign, as a share of the high speed of the runs."""
HAT_STRENGTH_SHARE = 1e-4
"""Strength of a simulated hat, as a share of a typical force; the response is linear there."""
TYPICAL_FORCES = {"point": 2.0, "linear": 5.0, "rotary": 0.5}
"""Typical force of each kind of system: m/s^2 for point, N for linear, N m for rotary."""

AXIS_DIRECTION = 2
"""Direction of a hat: along the first axis; larger numbers are the other axes.

Direction 0 is against the motion, proportional to speed; direction 1 is against it, independent of
speed.
"""

TIME_VARIABLE = 0
"""Variable of a hat: time."""
SPEED_VARIABLE = 1
"""Variable of a hat: speed."""
POSITION_VARIABLE = 2
"""Variable of a hat: the first coordinate; larger numbers are the other coordinates."""


class HatForce(Force):
    """A force within an interval of time, position or speed.

    It acts along an axis, against the motion, or as dry friction.
    """

    name = "probe.hat"
    says = "a force acts in an interval of time, position or speed"
    source = "this module"
    coefficients = tuple(
        Coefficient(name, ("1", "1", "1"), ((-1, 1), (-1, 1), (-1, 1)))
        for name in ("strength", "variable", "centre", "width", "direction", "slow")
    )

    def force(self, c: Array, moment: StateSnapshot) -> Array:
        """Return the hat force f(z) = c max(1 - |z - m| / w, 0) d, eq. (1) of the module docstring.

        It acts while the variable z (time, position or speed) is near the centre m, with the
        strength c, the half-width w and the direction d.

        Shapes: B batch elements, J axes of the motion.

        Args:
            c: (6, B, 1) coefficients: strength, index of the variable (time, speed, then the
                coordinates), centre, half-width, index of the direction (against the motion in
                proportion to speed, against it as dry friction, then along each axis), and the
                speed over which dry friction reverses.
            moment: state of the batch: time t, positions x (B, J), velocities v (B, J), and speed
                (B, 1), the norm of v.

        Returns:
            Forces (B, J).
        """
        strength, variable, centre, width, direction, reversal_speed = c
        axes = moment.x.shape[1]
        variables = [moment.t, moment.speed, *(moment.x[:, k, None] for k in range(axes))]
        # Each batch element has one variable and one direction: all other terms of its sums are 0.
        value = sum(
            np.where(variable == i, variable_value, 0.0)
            for i, variable_value in enumerate(variables)
        )
        # A hat that is off has zero width, which must not be a divisor.
        half_width = np.maximum(width, 1e-12)
        distance = np.abs(value - centre) / half_width
        height = np.maximum(1.0 - distance, 0.0)  # (1)
        # The force is smooth in the speed, so no step must be shortened where the motion reverses.
        dry_direction = -moment.v / (moment.speed + np.maximum(reversal_speed, 1e-9))
        force_directions = [-moment.v, dry_direction, *(np.eye(axes)[axis] for axis in range(axes))]
        selected_direction = sum(
            np.where(direction == i, force_direction, 0.0)
            for i, force_direction in enumerate(force_directions)
        )
        result: Array = strength * height * selected_direction
        return result


@dataclass(frozen=True)
class LackOfFitResult:
    """Result of the lack-of-fit test of a model.

    Attributes:
        p_value: p-value of the best force of any shape; 1 if the test does not apply.
        where: variable of that force, e.g. ``position x``.
        excess: (C,) RMS residual in units of the noise floor.
        channels_above_noise: names of channels whose residual exceeds their noise.
        p_value_threshold: p-value threshold of the test.
    """

    p_value: float
    where: str
    excess: Array
    channels_above_noise: tuple[str, ...]
    p_value_threshold: float = STRUCTURE_P_VALUE_THRESHOLD

    @property
    def has_structure(self) -> bool:
        """True if the residual contains more than noise, by the test or by its size."""
        return has_structure(self.p_value, self.p_value_threshold, self.channels_above_noise)


def list_hat_effects(kind: type[SystemSimulator]) -> list[type[Effect]]:
    """Return the effects with which `assess_lack_of_fit` simulates an arbitrary force.

    Run evaluators need them in their library. A robot has a hat force for each joint.
    """
    return [JointHatForce] if kind.has_model else [HatForce]


def assess_lack_of_fit(models: ModelSet, model: FittedModel) -> LackOfFitResult:
    """Test whether the residual of a fitted model has structure that no effect explains.

    1. Compare the size of the residual with the noise.
    2. Test for an unmodelled force with a Kalman filter, if the model set has one. If it finds no
       force, this decides.
    3. Otherwise simulate hat-shaped forces over time, position and speed, and score them against
       the residual. The scores are calibrated by surrogate residuals: random noise with the
       spectrum of the residual.

    Args:
        models: fitted models of the recording.
        model: fitted model to test.

    Returns:
        The result; its p-value is 1 if no force was tested.
    """
    evaluator, is_noise_stated = models.evaluator, models.is_noise_stated
    # 1. Size.
    size_result = assess_residual_size(models, model)
    # Without a hat force in the simulator, only the size is tested.
    if not any(probe.name in evaluator.coefficient_slices for probe in (HatForce, JointHatForce)):
        return size_result
    evaluator.search_control.report_and_check("an unmodelled force")
    # 2. Filter.
    force_test = models.score_unmodelled_force(model)
    # Threshold of the p-value.
    level = get_structure_threshold(bool(is_noise_stated.all()))
    if force_test is not None:
        p_value, variable = force_test
        # The linear filter decides only if it finds no force; otherwise the force is simulated.
        if p_value > level:
            return replace(size_result, p_value=p_value, where=variable, p_value_threshold=level)
    # 3. Hat forces.
    # A hat acts only while time, a position or the speed is in an interval.
    # Scores need derivatives at the parameters of the model itself.
    model = models.refine_jacobian(model)
    directions = compute_hat_directions(evaluator, model)
    # No hat changes the runs.
    if not directions.candidates:
        return size_result
    residual = models.compute_residual(model.fit)
    test = ScoreTest(
        model.fit, directions, models.observed_mask, models.compute_channel_weights(model)
    )
    rng = models.make_rng("structure", model.effects)
    scores = compute_calibrated_scores(
        test,
        residual,
        lambda count: draw_surrogates(
            residual, models.observed_mask, count, rng, project_out=test.project_out
        ),
        SURROGATE_COUNT,
    )
    score_excess = scores.score - scores.null_quantiles
    best_force = scores.effects[int(np.argmax(score_excess))]
    return replace(size_result, p_value=scores.p_value, where=best_force, p_value_threshold=level)


def assess_residual_size(models: ModelSet, model: FittedModel) -> LackOfFitResult:
    """Test only the size of the residual, without an unmodelled force.

    A channel counts as above its noise if the excess is significant. The p-value of the result is
    1: no force was tested.

    Args:
        models: the models of the recording.
        model: the fitted model.
    """
    sigma = model.likelihood.sigma
    # A channel without samples has no sigma and no residual.
    residual_sigma = np.where(np.isfinite(sigma), sigma, 0.0)
    # Here the excess is the ratio to the noise floor, 1 for a residual that is only noise.
    excess = residual_sigma / models.noise.sigma
    channels = []
    for channel_index, name in enumerate(models.evaluator.channels):
        error = compute_sigma_standard_error(
            float(model.likelihood.phi[channel_index]),
            int(models.observed_mask[:, :, channel_index].sum()),
        )
        if exceeds_noise(excess[channel_index], error, models.is_noise_stated[channel_index]):
            channels.append(name)
    return LackOfFitResult(1.0, "", excess, tuple(channels))


def compute_hat_directions(evaluator: RunEvaluator, model: FittedModel) -> DirectionSet:
    """Compute how the simulated runs respond to hats over every recorded variable.

    A hat is a force that acts only in an interval of time, position or speed of the motion.
    Together, hats can represent any force.

    Args:
        evaluator: the runs.
        model: fitted model to which each hat is added, one at a time.

    Returns:
        The K hats that change the runs, and the changes (R, T, C, K) per unit of their strength.
    """
    hats, strength = list_hat_probes(evaluator)
    # Robots have a hat force of their own, which acts at one joint.
    is_robot = JointHatForce.name in evaluator.coefficient_slices
    effect_name = JointHatForce.name if is_robot else HatForce.name
    changes = compute_responses(
        evaluator, model.fit, [(effect_name, hat.coefficients) for hat in hats]
    )
    # A hat without a finite response counts as one without any.
    responses = np.nan_to_num(np.moveaxis(changes, 0, -1)) / strength
    # A hat outside the range of all runs changes nothing and would be a column of zeros.
    active_hats = np.flatnonzero(np.abs(responses).max(axis=(0, 1, 2)) > 0)
    return DirectionSet(tuple(hats[i] for i in active_hats), responses[..., active_hats])


def list_hat_probes(evaluator: RunEvaluator) -> tuple[list[CandidateDirection], float]:
    """Return hats over every recorded variable, and the strength that they all have.

    A hat is a force that depends on one variable by a triangle. The hats of a family overlap and
    cover the range of their variable. They have the same label, because they form one hypothesis
    and act together.

    Args:
        evaluator: the recorded runs.

    Returns:
        The hats, each with the coefficients of `JointHatForce` (robots) or `HatForce`, and their
        strength in the unit of a force.
    """
    strength = HAT_STRENGTH_SHARE * TYPICAL_FORCES[evaluator.simulator.system.kind]
    is_robot = JointHatForce.name in evaluator.coefficient_slices
    probes = []
    for family in (_iterate_joint_families if is_robot else _iterate_families)(evaluator):
        # With this spacing, each hat extends to the centres of its neighbours.
        width = (family.high - family.low) / (HAT_COUNT - 1)
        for centre in np.linspace(family.low, family.high, HAT_COUNT):
            # In the order of the coefficients of the hat force.
            coefficients = np.array([strength, *family.variable, centre, width, *family.direction])
            probes.append(
                CandidateDirection(
                    effect=family.label,
                    grid_point=0,
                    coefficient_index=0,
                    coefficients=coefficients,
                    can_be_negative=True,
                )
            )
    return probes, strength


class _HatFamily(NamedTuple):
    """Hats over the range of one variable, with one direction.

    Attributes:
        label: name of the family.
        variable: coefficients of the effect that name the variable: its index, and before it that
            of the joint of a robot.
        low: lowest centre of a hat, in s, m, rad or their rates.
        high: highest centre.
        direction: index of the direction, and the speed over which dry friction reverses its sign.
    """

    label: str
    variable: tuple[int, ...]
    low: float
    high: float
    direction: tuple[int, float]


def _iterate_joint_families(evaluator: RunEvaluator) -> Iterator[_HatFamily]:
    """Yield every family of hats at the joints of a robot that the recording can show.

    A hat is a force that depends on one variable by a triangle max(1 - |z - m| / w, 0). For each
    recorded joint, the families are forces

    * over time, along the joint;
    * over its position, along the joint, against the motion, or as dry friction;
    * over its speed, against the motion or as dry friction.
    """
    for joint, name, low, high in _iterate_positions(evaluator):
        speeds = np.abs(_compute_rates(evaluator, evaluator.channels.index(name)))
        speed = float(np.nanquantile(speeds, HIGH_SPEED_QUANTILE))
        # Speed over which dry friction reverses its sign.
        reversal_speed = SIGN_CHANGE_SPEED_SHARE * speed
        duration = evaluator.longest_duration
        yield _HatFamily(
            f"time, along {name}", (joint, TIME), 0.0, duration, (ALONG, reversal_speed)
        )
        # Texts of the directions for the labels.
        opposing_directions = {AGAINST: "against it", DRY: "dry"}
        if high > low:
            for direction, text in {ALONG: "along it", **opposing_directions}.items():
                label = f"position {name}, {text}"
                yield _HatFamily(label, (joint, POSITION), low, high, (direction, reversal_speed))
        if speed > 0:
            for direction, text in opposing_directions.items():
                label = f"speed of {name}, {text}"
                yield _HatFamily(label, (joint, SPEED), 0.0, speed, (direction, reversal_speed))


def _iterate_families(evaluator: RunEvaluator) -> Iterator[_HatFamily]:
    """Yield every family of hat forces whose variable the recording shows.

    A hat is a triangular basis function max(1 - |z - m| / w, 0) of a variable z, eq. (1). The
    families together can represent any force that depends on one variable:

    * over time, along each coordinate or against the motion;
    * over a position, along the last coordinate, against the motion, or as dry friction;
    * over the speed, against the motion, or as dry friction.

    A bouncing body flies freely and slides on nothing, so some families are left out for it.
    """
    system = evaluator.simulator.system
    speed = _compute_high_speed(evaluator)
    # Each direction has its index and the speed over which dry friction reverses. The indices are 0
    # against the motion, 1 for dry friction, and then one for each axis.
    against, dry, *axes = [
        (direction, SIGN_CHANGE_SPEED_SHARE * speed)
        for direction in range(AXIS_DIRECTION + len(system.coordinates))
    ]
    spans = [run_data.scenario.times[[0, -1]] for run_data in evaluator.prepared_runs]
    longest_run = max(float(last - first) for first, last in spans)
    positions = list(_iterate_positions(evaluator))
    for axis, name, _, _ in positions:
        yield _HatFamily(f"time, along {name}", (TIME_VARIABLE,), 0.0, longest_run, axes[axis])
    yield _HatFamily("time, against the motion", (TIME_VARIABLE,), 0.0, longest_run, against)
    # The last coordinate of a bouncing body is the height.
    last_axis = len(system.coordinates) - 1
    for axis, name, low, high in positions:
        if not high > low:
            continue
        variable = (POSITION_VARIABLE + axis,)
        if not (system.bounces and axis == last_axis):
            along = f"position {name}, along {system.coordinates[last_axis]}"
            yield _HatFamily(along, variable, low, high, axes[last_axis])
        yield _HatFamily(f"position {name}, against the motion", variable, low, high, against)
        if not system.bounces:
            yield _HatFamily(f"position {name}, dry", variable, low, high, dry)
    if speed > 0:
        yield _HatFamily("speed, against the motion", (SPEED_VARIABLE,), 0.0, speed, against)
    if speed > 0 and not system.bounces:
        yield _HatFamily("speed, dry", (SPEED_VARIABLE,), 0.0, speed, dry)


def _iterate_positions(evaluator: RunEvaluator) -> Iterator[tuple[int, str, float, float]]:
    """Yield index and name of each recorded coordinate, and its 1 % and 99 % quantile.

    Quantiles are used instead of extremes, so that single outliers do not widen the range.
    """
    for axis, name in enumerate(evaluator.simulator.system.coordinates):
        if name in evaluator.channels:
            # (R, T) positions; NaN where no sample exists.
            values = evaluator.observed[:, :, evaluator.channels.index(name)]
            low, high = (float(v) for v in np.nanquantile(values, [0.01, 0.99]))
            yield axis, name, low, high


def _compute_rates(evaluator: RunEvaluator, channel: int) -> Array:
    """Return the rates of a channel in all runs (n,), from differences of its recorded values.

    Args:
        evaluator: evaluator with the recorded runs.
        channel: index of the channel.
    """
    # A zero, so that there is a rate even if all runs are too short.
    rates = [np.zeros(1)]
    for run_data in evaluator.prepared_runs:
        if len(run_data.observed) > 3:
            # Use every third sample, because differences of neighbours are mostly noise.
            step = np.diff(run_data.scenario.times[::3])
            rates.append(np.diff(run_data.observed[::3, channel]) / step)
    return np.concatenate(rates)


def _compute_high_speed(evaluator: RunEvaluator) -> float:
    """Return the 98 % quantile of the speed over all runs; 0 if no coordinate is recorded.

    The speed is the norm of the rates of the recorded coordinates. The quantile is the upper end of
    the hat forces over speed. The maximum is not used, because a single rate may be noise.
    """
    channels = evaluator.channels
    squared_rates = [
        np.square(_compute_rates(evaluator, channels.index(name)))
        for name in evaluator.simulator.system.coordinates
        if name in channels
    ]
    if not squared_rates:
        return 0.0
    return float(np.sqrt(np.nanquantile(sum(squared_rates), HIGH_SPEED_QUANTILE)))
