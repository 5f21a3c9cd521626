"""Tests of the linear model about a measured motion against simulations with an effect."""

from dataclasses import replace

import numpy as np
import pytest

from sims.robot.dynamics.linearisation_about_recording import (
    MeasuredLinear,
    Trajectory,
    interpolate_quintic,
)
from sims.robot.dynamics.linearisation_about_simulation import compute_control_changes
from sims.robot.floating_joints import FloatingState

EFFECTS = {
    "drag.linear@elbow": (0.02,),
    "force.bias@shoulder": (0.3,),
    "inertia.armature@elbow": (0.01,),
    "mass.scale@forearm": (0.01,),
    "gravity.scale": (0.02,),
    "input.gain@m_shoulder": (0.03,),
}


def theta_of(example_arm, name, c):
    theta = example_arm.get_nominal_theta()
    theta[example_arm.coefficient_slices[name]] = c
    return theta


def start_of(example_arm, run=0):
    """Return the first positions and velocities of a run."""
    return np.split(example_arm.initial_state_guesses[run], 2)


def follow(example_arm, theta=None, run=0, start=None, trajectory=None):
    """Return the linear model about a motion, by default the one that is simulated from a start."""
    theta = example_arm.get_nominal_theta() if theta is None else theta
    start = start_of(example_arm, run) if start is None else start
    scenario = example_arm.prepared_runs[run].scenario
    return MeasuredLinear(example_arm.simulator, theta, scenario, start, trajectory)


def motion_with(example_arm, theta):
    """Return the linear model about the motion simulated with these parameters."""
    x, v, _ = follow(example_arm, theta).trajectory
    nothing = FloatingState(np.zeros((len(x), 0)), np.zeros((len(x), 0)))
    return follow(example_arm, trajectory=Trajectory(x, v, nothing))


def added(linear, example_arm, name, c):
    """Return the force and readings that an effect adds about the motion, at zero deviation."""
    size = 2 * (len(example_arm.state_names) // 2)
    return linear.added(
        [(example_arm.available_effects[name], c)], np.zeros((linear.knots.size, size))
    )


@pytest.mark.parametrize("name", EFFECTS)
def test_the_model_misses_a_motion_by_what_the_missing_effect_adds(example_arm, name):
    """Eq. (3) of `linearisation_about_recording` with δ = 0: the defects are Σ c b."""
    c = np.array(EFFECTS[name])
    linear = motion_with(example_arm, theta_of(example_arm, name, c))
    maps = linear.interval_maps()
    pushed, _ = added(linear, example_arm, name, c)
    expected = (maps.inputs @ pushed)[:, :, 0]
    joints = len(example_arm.state_names) // 2
    # Only velocities are compared: the model uses the mean force, which moves positions
    # differently.
    found, wanted = maps.defects[:, joints:], expected[:, joints:]
    error = np.sqrt(np.square(found - wanted).mean()) / np.sqrt(np.square(wanted).mean())
    assert error < 0.02, f"{name}: {error:.3f}"


def test_without_an_effect_nothing_is_missed(example_arm):
    maps = motion_with(example_arm, example_arm.get_nominal_theta()).interval_maps()
    assert np.abs(maps.defects).max() < 1e-9


def test_a_sensor_effect_changes_readings_alone(example_arm):
    linear = motion_with(example_arm, example_arm.get_nominal_theta())
    pushed, readings = added(linear, example_arm, "sensor.bias@q.elbow", np.array([0.01]))
    column = example_arm.channels.index("q.elbow")
    np.testing.assert_allclose(readings[:, column, 0], 0.01, atol=1e-7)
    assert not pushed.any()


def test_a_gain_of_a_sensor_acts_on_what_is_predicted(example_arm):
    """If the gain scaled the reading itself, it would explain the noise."""
    linear = motion_with(example_arm, example_arm.get_nominal_theta())
    predicted = np.zeros((linear.knots.size, 2 * (len(example_arm.state_names) // 2)))
    elbow = example_arm.channels.index("q.elbow")
    predicted[:, example_arm.simulator.system.coordinates.index("q.elbow")] = 0.2
    _, readings = linear.added(
        [(example_arm.available_effects["sensor.gain@q.elbow"], np.array([0.5]))], predicted
    )
    wanted = 0.5 * (linear.observed[:, elbow] + 0.2)
    np.testing.assert_allclose(readings[:, elbow, 0], wanted, atol=1e-6)


def test_jacobians_of_other_commands_are_not_used_again(example_arm):
    """Delayed steps change between samples, so the model is evaluated at more times."""
    scenario, start = example_arm.prepared_runs[0].scenario, start_of(example_arm)
    steps = {name: np.full_like(values, values[0]) for name, values in scenario.inputs.items()}
    for values in steps.values():
        for sample in (3, 8, 14, 21, 29):
            values[sample:] += 0.06
    scenario = replace(scenario, inputs=steps)
    nominal = MeasuredLinear(
        example_arm.simulator, example_arm.get_nominal_theta(), scenario, start
    )
    delayed = theta_of(example_arm, "input.delay@m_shoulder", (0.013,))
    given = delayed, scenario, start, nominal.trajectory
    anew = MeasuredLinear(example_arm.simulator, *given)
    reused = MeasuredLinear(example_arm.simulator, *given, nearby=nominal)
    np.testing.assert_allclose(
        reused.interval_maps().defects, anew.interval_maps().defects, atol=1e-4
    )


def test_maps_carry_a_deviation_as_the_simulator_does(example_arm):
    """Compare a state deviation mapped to the next sample with that of two simulations."""
    linear = motion_with(example_arm, example_arm.get_nominal_theta())
    maps = linear.interval_maps()
    half = len(example_arm.state_names) // 2
    moved = 1e-5
    base, (positions, velocities) = follow(example_arm), start_of(example_arm)
    for column in range(half):
        other = positions + moved * np.eye(half)[column]
        changed = follow(example_arm, start=(other, velocities))
        for sample in (1, 4):
            step = base.knots[sample]
            x = (changed.trajectory.x[step] - base.trajectory.x[step]) / moved
            mapped = np.linalg.multi_dot([*maps.states[:sample][::-1], np.eye(2 * half)])
            np.testing.assert_allclose(mapped[:half, column], x, rtol=5e-3, atol=5e-4)


def test_a_quintic_goes_through_values_and_derivatives():
    times = np.array([0.0, 0.1, 0.25, 0.4])
    power = np.arange(6)

    def samples(t):
        t = t[:, None]
        value = (t**power).sum(axis=1)
        slope = (power[1:] * t ** (power[1:] - 1)).sum(axis=1)
        curve = (power[2:] * (power[2:] - 1) * t ** (power[2:] - 2)).sum(axis=1)
        return np.stack([value, slope, curve], axis=1)

    between = np.linspace(0.0, 0.4, 37)
    value, slope = interpolate_quintic(times, samples(times), between)
    np.testing.assert_allclose(value, samples(between)[:, 0], atol=1e-12)
    np.testing.assert_allclose(slope, samples(between)[:, 1], atol=1e-10)
    beyond, rate = interpolate_quintic(times, samples(times), np.array([0.6]))
    assert rate[0] == pytest.approx(slope[-1])
    assert beyond[0] == pytest.approx(value[-1] + 0.2 * slope[-1])


def test_control_changes_of_several_runs_are_those_of_each_run(example_arm):
    linear = [follow(example_arm, run=run) for run in range(len(example_arm.prepared_runs))]
    laws = ("input.lag@", "input.rate@")
    names = [n for n in example_arm.library if n.startswith(laws) and not n.endswith("@*")]
    effects = [
        (
            example_arm.available_effects[name],
            np.full(len(example_arm.get_coefficient_indices(name)), 0.02),
        )
        for name in names
    ]
    together = compute_control_changes(linear, effects)
    assert len(effects) >= 2
    for run, changes in zip(linear, together, strict=True):
        (alone,) = compute_control_changes([run], effects)
        assert alone.keys() == changes.keys()
        for number, (change,) in alone.items():
            (other,) = changes[number]
            np.testing.assert_array_equal(change.series, other.series)
