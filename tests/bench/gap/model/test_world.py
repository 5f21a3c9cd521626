from dataclasses import replace

import numpy as np
import pytest

from bench.gap.model.bounds import BEYOND, DRY, coefficient_bounds
from bench.gap.model.tracks import beginning, first_of
from bench.gap.model.world import FREED
from sims.ball.simulator import Ball
from sims.base import InputError, Scenario
from sims.pendulum.simulator import Pendulum
from tests.bench.gap.made import changed, recorded, recording, with_runs, world


def test_a_vector_holds_parameters_constants_set_free_and_coefficients():
    there = world(
        recording(runs=2, seconds=0.5, rate=50),
        free=["length", "mass"],
        candidates=["drag.linear", "spring.linear"],
    )
    assert [p.name for p in there.parameters[:3]] == ["inertia", "length", "mass"]
    assert there.slots["drag.linear"] == slice(3, 4)
    assert list(there.base) == [0, 1, 2]
    np.testing.assert_allclose(there.nominal()[:3], [3.3e-3, 0.15, 0.15])
    assert not there.nominal()[3:].any()
    assert there.parameters[1].bounds == pytest.approx((0.15 / FREED, 0.15 * FREED))


def test_lanes_are_what_the_simulator_gives():
    made = [
        recorded(Pendulum(), [3e-3], [{"q": q}], np.arange(n) / rate)
        for q, rate, n in ((1.0, 50, 40), (0.4, 80, 90))
    ]
    there = world(
        with_runs(made[0], [part.runs[0] for part in made]),
        candidates=["drag.linear"],
        free=["gravity"],
    )
    theta = np.array([[3e-3, 9.81, 0.0], [4e-3, 5.0, 1e-3], [2e-3, 12.0, 5e-4]])
    runs, states = np.array([0, 1, 1]), np.array([[1.0, 0.0], [0.4, 0.5], [-2.0, 0.0]])
    before = there.simulations
    seen = there.simulate(theta, runs, states)
    assert there.simulations - before == 3
    assert seen.shape == (3, 90, 2)
    for lane in range(3):
        times = there.tracks[runs[lane]].scenario.times
        scenario = Scenario(
            times,
            dict(zip(("q", "qd"), states[lane], strict=True)),
            constants={"gravity": theta[lane, 1]},
        )
        fine = Pendulum(fixed={"drag.linear": theta[lane, 2]}, time_step=1e-3).simulate(
            theta[lane : lane + 1, :1], scenario
        )
        np.testing.assert_allclose(seen[lane, : times.size], fine[0], atol=3e-3)
    assert np.isnan(seen[0, 40:]).all()
    part = there.simulate(theta, runs, states, 0.5)
    np.testing.assert_allclose(part[:, :20], seen[:, :20], atol=1e-3)
    assert np.isnan(part[0, 20:]).all()
    assert np.isnan(part[1:, 45:]).all()
    np.testing.assert_array_equal(there.counted(0.5).sum(axis=(1, 2)), [40, 90])


def test_first_samples_tell_place_and_slope():
    times = 5.0 + np.arange(20) / 100
    values = 2.0 - 3.0 * (times - 5.0) + 4.0 * (times - 5.0) ** 2
    assert beginning(times, values) == (pytest.approx(2.0), pytest.approx(-3.0))
    assert beginning(times[:3], values[:3]) == (
        pytest.approx(2.0, abs=1e-3),
        pytest.approx(-2.92, abs=0.01),
    )
    assert beginning(times[:1], values[:1]) == (2.0, 0.0)
    assert beginning(times, np.full(20, np.nan)) == (0.0, 0.0)
    late = np.where(times < 5.04, np.nan, values)
    assert beginning(times, late) == (pytest.approx(2.0), pytest.approx(-3.0)), (
        "of the first instant, not of the first sample"
    )


def test_guesses_are_near_stated_states_are_kept_and_hidden_axes_stay():
    made = recorded(
        Ball(observe=["x", "z"]),
        [0.7],
        [{"z": 3.0, "vx": 2.0, "vz": 1.0}] * 2,
        np.arange(50) / 100,
        0.001,
    )
    made = replace(made, runs=(made.runs[0], replace(made.runs[1], initial={"z": 2.5, "vx": 7.0})))
    there = world(made, candidates=[])
    assert there.states == ["x", "y", "z", "vx", "vy", "vz"]
    np.testing.assert_allclose(there.guess[0], [0, 0, 3, 2, 0, 1], atol=0.15)
    np.testing.assert_array_equal(there.known, [[0, 1, 0, 0, 1, 0], [0, 1, 1, 1, 1, 0]])
    assert (there.guess[1, 2], there.guess[1, 3]) == (2.5, 7.0)


def test_a_ball_whose_height_is_not_recorded_begins_too_high_for_an_impact():
    made = recorded(Ball(observe=["x"]), [0.7], [{"z": 3.0, "vx": 2.0}], np.arange(100) / 50, 0.001)
    there = world(made, candidates=[])
    z = there.states.index("z")
    assert there.guess[0, z] > 0.5 * 9.81 * 2.0**2 + 10
    assert (
        there.known[0, z]
        or there.simulate(there.nominal()[None], np.array([0]), there.guess)[0, -1, 0] > 3.5
    )


def test_a_later_clock_changes_nothing():
    made = recording(runs=1, seconds=1, rate=50, noise=["0.003"])
    later = replace(made, runs=(replace(made.runs[0], times=made.runs[0].times + 1e4),))
    one, two = (world(part, candidates=["drag.linear"]) for part in (made, later))
    np.testing.assert_allclose(one.guess, two.guess, atol=1e-6)
    seen = [there.simulate(there.nominal()[None], np.array([0]), one.guess) for there in (one, two)]
    np.testing.assert_allclose(*seen, atol=1e-4)


def test_effects_may_grow_beyond_what_is_plausible_but_not_change_their_meaning():
    there = world(
        recording(runs=1, seconds=0.5),
        candidates=["drag.linear", "spring.linear", "friction.stribeck"],
    )
    for name in there.library:
        plausible = [p.bounds for p in there.parameters[there.slots[name]]]
        for (low, high), (wide_low, wide_high) in zip(
            plausible, coefficient_bounds(there, name), strict=True
        ):
            beyond = DRY if name.startswith("friction") else BEYOND
            assert wide_high in (beyond * high, high)
            assert wide_low == (low if low >= 0 else BEYOND * low)
    assert coefficient_bounds(there, "drag.linear") == [(0.0, BEYOND * 0.1)]


@pytest.mark.parametrize(
    ("free", "message"),
    [
        (
            ["weight"],
            "unknown constant of system pendulum 'weight'; there are: gravity, length, mass",
        ),
        (
            ["gravity"],
            "--free gravity: expected a constant that is not zero and the same in every run",
        ),
    ],
)
def test_constants_that_cannot_be_free(free, message):
    made = recording(runs=1, seconds=0.5)
    made = replace(made, runs=(replace(made.runs[0], constants={"gravity": 1.6}),))
    with pytest.raises(InputError, match=message):
        world(made, free=free)


def test_constants_of_a_run_are_its_own():
    made = recording(runs=2, seconds=0.5, initial=["q=0.5"])
    made = replace(made, runs=(made.runs[0], replace(made.runs[1], constants={"gravity": 0.001})))
    there = world(made, candidates=[])
    seen = there.simulate(
        np.tile(there.nominal(), (2, 1)), np.arange(2), np.array([[0.5, 0.0]] * 2)
    )
    assert np.ptp(seen[0, :, 0]) > 0.9
    assert np.ptp(seen[1, :, 0]) < 1e-3


def test_missing_samples_at_the_beginning_and_first_samples():
    made = recording(runs=1, seconds=1, rate=100, initial=["q=1"], noise=["0.001"])
    run = changed(made.runs[0], q=lambda v: np.where(np.arange(v.size) < 4, np.nan, v))
    there = world(replace(made, runs=(run,)), candidates=[])
    assert there.guess[0, 0] == pytest.approx(1.0, abs=0.02)
    scenario = Scenario(np.arange(5.0), inputs={"u": np.arange(5.0)})
    cut = first_of(scenario, 3)
    np.testing.assert_array_equal(cut.times, [0, 1, 2])
    np.testing.assert_array_equal(cut.inputs["u"], [0, 1, 2])
    assert first_of(scenario, 9) is scenario
