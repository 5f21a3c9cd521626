"""Tests of the initial estimate of servo gains, on SciPy motions of known frequency and damping."""

import numpy as np
import pytest
from scipy.signal import lsim

from bench.logs.importing.servo_estimation import estimate_servo_response
from tests.bench.logs.test_log_quality import multisine


def run(frequency, damping, seed=0, rate=50.0, hold=True, noise=1e-3):
    rng, times = np.random.default_rng(seed), np.arange(0.0, 20.0, 1.0 / rate)
    command = multisine(times, rng)
    system = [frequency**2], [1.0, 2.0 * damping * frequency, frequency**2]
    _, position, _ = lsim(system, command, times, interp=not hold)
    return times, command, 0.3 + position + noise * rng.standard_normal(times.size)


@pytest.mark.parametrize(("frequency", "damping"), [(8.0, 0.7), (20.0, 1.5), (60.0, 0.5)])
def test_frequency_and_damping_are_found(frequency, damping):
    found = estimate_servo_response([run(frequency, damping, seed) for seed in range(2)])
    # The grid steps are 15 % in frequency and 26 % in damping.
    assert found.frequency == pytest.approx(frequency, rel=0.2)
    assert found.damping == pytest.approx(damping, rel=0.3)


def test_what_does_not_follow_has_none():
    times, command, _ = run(10.0, 1.0)
    rng = np.random.default_rng(1)
    assert estimate_servo_response([(times, command, rng.standard_normal(times.size))]) is None
    assert estimate_servo_response([(times, 0 * command, command)]) is None
    assert estimate_servo_response([(times, command, 0 * command)]) is None
    assert estimate_servo_response([]) is None


def test_samples_that_are_missing_are_left_out():
    times, command, position = run(15.0, 1.0)
    position[100:110] = np.nan
    assert estimate_servo_response([(times, command, position)]).frequency == pytest.approx(
        15.0, rel=0.2
    )
