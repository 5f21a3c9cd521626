from dataclasses import replace

import numpy as np
import pytest

from bench.diagnosis.evaluation.parameter_bounds import (
    MAX_RANGE_FACTOR,
    MAX_RANGE_FACTOR_DRY_FRICTION,
    compute_coefficient_bounds,
)
from bench.diagnosis.evaluation.run_evaluator import FREED_CONSTANT_RANGE_FACTOR
from sims.core.simulator import InputError, Scenario
from sims.systems.pendulum import Pendulum
from tests.bench.diagnosis.explained_samples import evaluator, recorded, recording, with_runs


def test_a_vector_holds_parameters_constants_set_free_and_coefficients():
    there = evaluator(
        recording(runs=2, seconds=0.5, rate=50),
        free=["length", "mass"],
        candidates=["drag.linear", "spring.linear"],
    )
    assert [p.name for p in there.parameters[:3]] == ["inertia", "length", "mass"]
    assert there.coefficient_slices["drag.linear"] == slice(3, 4)
    assert list(there.base_indices) == [0, 1, 2]
    np.testing.assert_allclose(there.get_nominal_theta()[:3], [3.3e-3, 0.15, 0.15])
    assert not there.get_nominal_theta()[3:].any()
    assert there.parameters[1].bounds == pytest.approx(
        (0.15 / FREED_CONSTANT_RANGE_FACTOR, 0.15 * FREED_CONSTANT_RANGE_FACTOR)
    )


def test_cached_elements_equal_the_simulation():
    made = []
    # The runs differ in length and sampling rate.
    for q, rate, samples in ((1.0, 50, 40), (0.4, 80, 90)):
        times = np.arange(samples) / rate
        made.append(recorded(Pendulum(), [3e-3], [{"q": q}], times))
    there = evaluator(
        with_runs(made[0], [part.runs[0] for part in made]),
        candidates=["drag.linear"],
        free=["gravity"],
    )
    # Columns: inertia, gravity, drag.
    rows = [
        [3e-3, 9.81, 0.0],
        [4e-3, 5.0, 1e-3],
        [2e-3, 12.0, 5e-4],
    ]
    theta = np.array(rows)
    runs = np.array([0, 1, 1])
    states = np.array([[1.0, 0.0], [0.4, 0.5], [-2.0, 0.0]])
    before = there.simulation_count
    seen = there.simulate(theta, runs, states)
    assert there.simulation_count - before == 3
    assert seen.shape == (3, 90, 2)
    for lane in range(3):
        times = there.prepared_runs[runs[lane]].scenario.times
        initial = dict(zip(("q", "qd"), states[lane], strict=True))
        scenario = Scenario(times, initial, constants={"gravity": theta[lane, 1]})
        # Simulate each element separately with a step ten times shorter.
        fine = Pendulum(fixed={"drag.linear": theta[lane, 2]}, time_step=1e-3).simulate(
            theta[lane : lane + 1, :1], scenario
        )
        np.testing.assert_allclose(seen[lane, : times.size], fine[0], atol=3e-3)
    assert np.isnan(seen[0, 40:]).all()
    part = there.simulate(theta, runs, states, 0.5)
    np.testing.assert_allclose(part[:, :20], seen[:, :20], atol=1e-3)
    assert np.isnan(part[0, 20:]).all()
    assert np.isnan(part[1:, 45:]).all()
    np.testing.assert_array_equal(there.get_sample_mask(0.5).sum(axis=(1, 2)), [40, 90])


def test_no_sets_of_parameters_give_no_simulations():
    """A robot without free parameters displaces none for its central differences."""
    there = evaluator(recording(runs=2, seconds=0.5, rate=50))
    theta = np.empty((0, len(there.parameters)))
    simulated = there.simulate_all_runs(theta, there.initial_state_guesses)
    assert simulated.shape == (0, *there.observed.shape)


def test_a_later_clock_changes_nothing():
    made = recording(runs=1, seconds=1, rate=50, noise=["0.003"])
    run = made.runs[0]
    later = replace(made, runs=(replace(run, times=run.times + 1e4),))
    one, two = (evaluator(part, candidates=["drag.linear"]) for part in (made, later))
    np.testing.assert_allclose(one.initial_state_guesses, two.initial_state_guesses, atol=1e-6)
    lane = one.get_nominal_theta()[None], np.array([0]), one.initial_state_guesses
    seen = [there.simulate(*lane) for there in (one, two)]
    np.testing.assert_allclose(*seen, atol=1e-4)


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("drag.linear", [(0.0, 0.1 * MAX_RANGE_FACTOR)]),
        ("force.bias", [(-0.5 * MAX_RANGE_FACTOR, 0.5 * MAX_RANGE_FACTOR)]),
        # A shape parameter keeps its range.
        (
            "friction.stribeck",
            [
                (0.0, 0.5 * MAX_RANGE_FACTOR_DRY_FRICTION),
                (0.0, 0.5 * MAX_RANGE_FACTOR_DRY_FRICTION),
                (0.02, 2.0),
            ],
        ),
    ],
)
def test_effects_may_grow_beyond_what_is_plausible_but_not_change_their_meaning(name, expected):
    there = evaluator(recording(runs=1, seconds=0.5), candidates=[name])
    assert compute_coefficient_bounds(there, name) == expected


def test_only_what_sticks_by_itself_has_the_narrow_range_of_dry_friction():
    name = "friction.load_quadratic"
    there = evaluator(recording("servo", runs=1, seconds=0.5), candidates=[name])
    (_, share), (_, square) = (p.bounds for p in there.parameters[there.coefficient_slices[name]])
    expected = [(0.0, MAX_RANGE_FACTOR_DRY_FRICTION * share), (0.0, MAX_RANGE_FACTOR * square)]
    assert compute_coefficient_bounds(there, name) == expected


@pytest.mark.parametrize(
    ("free", "message"),
    [
        (
            ["weight"],
            "unknown constant of system pendulum 'weight'; there are: gravity, length, mass",
        ),
        (
            ["gravity"],
            "free constant gravity: expected a value that is not zero and equal in all runs",
        ),
    ],
)
def test_constants_that_cannot_be_free(free, message):
    made = recording(runs=1, seconds=0.5)
    made = replace(made, runs=(replace(made.runs[0], constants={"gravity": 1.6}),))
    with pytest.raises(InputError, match=message):
        evaluator(made, free=free)


def test_constants_of_a_run_are_its_own():
    made = recording(runs=2, seconds=0.5, initial=["q=0.5"])
    first, second = made.runs
    second = replace(second, constants={"gravity": 0.001})
    made = replace(made, runs=(first, second))
    there = evaluator(made, candidates=[])
    theta = np.tile(there.get_nominal_theta(), (2, 1))
    states = np.array([[0.5, 0.0]] * 2)
    seen = there.simulate(theta, np.arange(2), states)
    # Without gravity, the pendulum stays at its release angle.
    assert np.ptp(seen[0, :, 0]) > 0.9
    assert np.ptp(seen[1, :, 0]) < 1e-3
