from dataclasses import replace

import numpy as np
import pytest

from bench.diagnosis.evaluation.initial_state_guesses import (
    estimate_initial_value_and_slope,
    take_first_samples,
)
from sims.core.simulator import Scenario
from sims.systems.ball import Ball
from tests.bench.diagnosis.explained_samples import changed, evaluator, recorded, recording


def test_first_samples_tell_place_and_slope():
    times = 5.0 + np.arange(20) / 100
    values = 2.0 - 3.0 * (times - 5.0) + 4.0 * (times - 5.0) ** 2
    assert estimate_initial_value_and_slope(times, values) == (
        pytest.approx(2.0),
        pytest.approx(-3.0),
    )
    assert estimate_initial_value_and_slope(times[:3], values[:3]) == (
        pytest.approx(2.0, abs=1e-3),
        pytest.approx(-2.92, abs=0.01),
    )
    assert estimate_initial_value_and_slope(times[:1], values[:1]) == (2.0, 0.0)
    assert estimate_initial_value_and_slope(times, np.full(20, np.nan)) == (0.0, 0.0)
    late = np.where(times < 5.04, np.nan, values)
    assert estimate_initial_value_and_slope(times, late) == (
        pytest.approx(2.0),
        pytest.approx(-3.0),
    ), "of the first instant, not of the first sample"


def test_guesses_are_near_stated_states_are_kept_and_hidden_axes_stay():
    starts = [{"z": 3.0, "vx": 2.0, "vz": 1.0}] * 2
    times = np.arange(50) / 100
    made = recorded(Ball(observe=["x", "z"]), [0.7], starts, times, 0.001)
    # The second run specifies other initial values.
    first, second = made.runs
    second = replace(second, initial={"z": 2.5, "vx": 7.0})
    made = replace(made, runs=(first, second))
    there = evaluator(made, candidates=[])
    assert there.state_names == ["x", "y", "z", "vx", "vy", "vz"]
    np.testing.assert_allclose(there.initial_state_guesses[0], [0, 0, 3, 2, 0, 1], atol=0.15)
    # No recorded channel depends on y.
    known = [
        [0, 1, 0, 0, 1, 0],
        [0, 1, 1, 1, 1, 0],
    ]
    np.testing.assert_array_equal(there.known_state_mask, known)
    assert (there.initial_state_guesses[1, 2], there.initial_state_guesses[1, 3]) == (2.5, 7.0)


def test_a_ball_whose_height_is_not_recorded_begins_too_high_for_an_impact():
    start, times = {"z": 3.0, "vx": 2.0}, np.arange(100) / 50
    made = recorded(Ball(observe=["x"]), [0.7], [start], times, 0.001)
    there = evaluator(made, candidates=[])
    z = there.state_names.index("z")
    assert there.initial_state_guesses[0, z] > 0.5 * 9.81 * 2.0**2 + 10
    assert (
        there.known_state_mask[0, z]
        or there.simulate(
            there.get_nominal_theta()[None], np.array([0]), there.initial_state_guesses
        )[0, -1, 0]
        > 3.5
    )


def test_missing_samples_at_the_beginning_and_first_samples():
    made = recording(runs=1, seconds=1, rate=100, initial=["q=1"], noise=["0.001"])
    # The first four angles are missing, but their rates are present.
    run = changed(made.runs[0], q=lambda v: np.where(np.arange(v.size) < 4, np.nan, v))
    there = evaluator(replace(made, runs=(run,)), candidates=[])
    assert there.initial_state_guesses[0, 0] == pytest.approx(1.0, abs=0.02)
    scenario = Scenario(np.arange(5.0), inputs={"u": np.arange(5.0)})
    cut = take_first_samples(scenario, 3)
    np.testing.assert_array_equal(cut.times, [0, 1, 2])
    np.testing.assert_array_equal(cut.inputs["u"], [0, 1, 2])
    assert take_first_samples(scenario, 9) is scenario
