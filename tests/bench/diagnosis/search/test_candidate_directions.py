from dataclasses import replace

import numpy as np
import pytest

from bench.diagnosis.evaluation.parameter_bounds import compute_coefficient_bounds
from bench.diagnosis.search.candidate_directions import (
    END_STOP_DEPTH_SHARES,
    EVENT_TIME_COUNT,
    MAX_FREQUENCIES,
    SHAPE_GRID_SIZE,
    compute_directions,
    simulate_with_effect,
)
from bench.diagnosis.search.fit_starts import END_STOP_DEPTH_SHARES as DEEPER
from bench.diagnosis.search.fit_starts import (
    END_STOP_STIFFNESS_FACTORS,
    MAX_EVENT_TIME_SUBDIVISIONS,
    REFIT_STIFFNESS_FACTORS,
    generate_event_times,
    generate_neighbouring_end_stops,
    generate_shifted_starts,
)
from bench.diagnosis.search.score_test import ScoreTest
from sims.core.simulator import Scenario
from sims.systems.pendulum import Pendulum
from tests.bench.diagnosis.explained_samples import evaluator, fit_model, recording, searched, white


def fitted(there):
    return fit_model(there, white(there, 0.003))


@pytest.fixture(scope="module")
def swing():
    there = evaluator(recording(runs=2, seconds=1, rate=60, noise=["q=0.003", "qd=0.02"], seed=1))
    return there, fitted(there)


def of(found, effect):
    """Return the columns of the directions of an effect."""
    return [i for i, probe in enumerate(found.candidates) if probe.effect == effect]


def probes_of(found, effect):
    """Return the candidates of an effect."""
    return [probe for probe in found.candidates if probe.effect == effect]


@pytest.fixture(scope="module")
def pushed_slider():
    """Return two runs of a slider under a constant force."""
    return evaluator(
        recording("slider", runs=2, seconds=1, rate=60, noise=["0.003"], inputs=["u=1"])
    )


@pytest.mark.parametrize(
    ("effect", "size"),
    [
        ("drag.linear", 1e-6),
        ("drag.quadratic", 1e-7),
        ("spring.linear", 1e-6),
        ("sensor.bias", 1e-4),
    ],
)
def test_a_direction_is_the_derivative_of_the_trajectory(swing, effect, size):
    there, fit = swing
    found = compute_directions(there, fit, [effect])
    (column,) = of(found, effect)
    for r, track in enumerate(there.prepared_runs):
        initial = dict(zip(there.state_names, fit.initial_states[r].tolist(), strict=True))
        scenario = Scenario(track.scenario.times, initial)
        with_it, without = (
            Pendulum(fixed={effect: c}, time_step=1e-3).simulate(fit.theta[None, :1], scenario)[0]
            for c in (size, 0.0)
        )
        expected = (with_it - without) / size
        np.testing.assert_allclose(
            found.responses[r, :, :, column], expected, atol=0.01 * np.abs(expected).max()
        )


def test_effects_that_change_nothing_here_have_no_direction(swing):
    there, fit = swing
    found = compute_directions(there, fit, there.library)
    acting = {probe.effect for probe in found.candidates}
    assert not acting & {
        "input.gain",
        "input.delay",
        "input.lag",
        "input.saturation",
        "input.deadband",
        "backlash",
    }
    assert {
        "drag.linear",
        "friction.coulomb",
        "gravity.scale",
        "sensor.delay",
        "clock.skew",
    } <= acting
    assert found.responses.shape == (*there.observed.shape, len(found.candidates))
    assert np.isfinite(found.responses).all()
    assert (np.abs(found.responses).max(axis=(0, 1, 2)) > 0).all()


def test_driven_runs_try_limits_of_the_input():
    made = recording("slider", runs=2, seconds=1, rate=50, inputs=["u=sine:2:1"], noise=["0.003"])
    there = evaluator(made, candidates=["input.gain", "input.saturation", "input.deadband"])
    found = compute_directions(there, fitted(there), there.library)
    probes = probes_of(found, "input.saturation")
    limits = sorted(probe.coefficients[0] for probe in probes if probe.is_single_size)
    np.testing.assert_allclose(limits, [0.3, 0.7, 1.2, 1.7, 1.9, 1.98], rtol=2e-3)
    (gain,) = of(found, "input.gain")
    assert found.candidates[gain].can_be_negative
    x = found.responses[0, :, there.channels.index("x"), gain]
    expected = there.prepared_runs[0].observed[:, there.channels.index("x")]
    np.testing.assert_allclose(
        x, expected, atol=0.02
    )  # equals the response of a slider at rest to the input


def test_shapes_are_laid_on_a_grid_and_those_of_one_shape_act_together(swing):
    there, fit = swing
    found = compute_directions(there, fit, ["friction.stribeck", "force.periodic"])
    groups = {}
    for probe in probes_of(found, "friction.stribeck"):
        groups.setdefault(probe.grid_point, []).append(probe)
    assert len(groups) == SHAPE_GRID_SIZE
    for members in groups.values():
        assert {p.coefficient_index for p in members} == {0, 1}, (
            "coulomb and extra, at one Stribeck speed"
        )
        assert len({p.coefficients[2] for p in members}) == 1
        assert not any(p.can_be_negative for p in members)
    speeds = sorted({members[0].coefficients[2] for members in groups.values()})
    np.testing.assert_allclose([speeds[0], speeds[-1]], [0.02, 2.0], rtol=1e-12)
    frequencies = {probe.grid_point for probe in probes_of(found, "force.periodic")}
    assert 4 <= len(frequencies) <= MAX_FREQUENCIES


def test_what_dies_away_is_tried_at_times_that_the_runs_can_show(swing):
    there, fit = swing
    found = compute_directions(there, fit, ["friction.warming"])
    times = sorted({float(p.coefficients[2]) for p in probes_of(found, "friction.warming")})
    longest = 3.0 * max(
        track.scenario.times[-1] - track.scenario.times[0] for track in there.prepared_runs
    )
    np.testing.assert_allclose([times[0], times[-1]], [0.5, longest], rtol=1e-12)
    assert (np.diff(np.log2(times)) <= 1.0).all()
    assert len(times) == 4


def test_what_modifies_an_effect_is_tried_with_it():
    search, model = searched(
        recording(
            "ball", runs=1, seconds=0.8, rate=50, noise=["0.005"], initial=["z=4", "vx=1", "vy=0.5"]
        ),
        0.005,
    )
    found = compute_directions(search.evaluator, model.fit, ["wind"])
    probes = probes_of(found, "wind")
    winds = [tuple(probe.coefficients[1:]) for probe in probes]
    assert (0.0, 0.0) in winds, "drag in still air"
    assert len(set(winds)) == 25
    assert {probe.coefficient_index for probe in probes} == {0}
    along = of(found, "wind")[winds.index((7.0, 0.0))]
    x = search.evaluator.channels.index("x")
    assert found.responses[0, -1, x, along] > 0, "it blows the ball along x"


def test_a_diverging_change_counts_as_zero_and_multiplies_without_a_warning(swing, monkeypatch):
    there, fit = swing

    def exploding(evaluator, at, added):
        changed = simulate_with_effect(evaluator, at, added)
        # These values are finite, but their products overflow.
        changed[0, 0, 10:] = -1e200 * np.arange(1.0, changed.shape[2] - 9)[:, None]
        changed[0, 1, 10:] = np.nan
        return changed

    monkeypatch.setattr(
        "bench.diagnosis.search.candidate_directions.simulate_with_effect", exploding
    )
    names = ["drag.linear", "sensor.bias"]
    found = compute_directions(there, fit, names)
    first, second = (of(found, name)[0] for name in names)
    assert np.abs(found.responses[..., first]).max() < 1e6
    assert not found.responses[:, 10:, :, first].any()
    seen = np.isfinite(there.observed)
    left = np.where(seen, there.observed - fit.simulated, 0.0)
    scores = ScoreTest(fit, found, seen, white(there, 0.003)).compute_scores(left, None)
    assert np.isfinite(scores.score).all()
    np.testing.assert_allclose(found.responses[..., 0, second][seen[..., 0]], 1.0, atol=1e-4)


def test_what_happens_once_is_looked_for_on_the_clock_of_the_stamps():
    made = recording(runs=2, seconds=1, rate=60, noise=["q=0.003", "qd=0.02"])
    first, second = made.runs
    later = replace(second, times=second.times + 5.0)
    there = evaluator(replace(made, runs=(first, later)))
    end = float(later.times[-1])
    found = compute_directions(there, fitted(there), ["sensor.slip"])
    instants = sorted(probe.coefficients[1] for probe in probes_of(found, "sensor.slip"))
    spaced = np.linspace(0.0, end, EVENT_TIME_COUNT + 2)[1:-1]
    np.testing.assert_allclose(instants, spaced, rtol=1e-12)
    q = there.channels.index("q")
    for i in of(found, "sensor.slip"):
        instant = found.candidates[i].coefficients[1]
        for r, track in enumerate(there.prepared_runs):
            stamps = track.scenario.times
            whole = np.abs(stamps - instant) > 0.6 / 60
            slipped = found.responses[r, whole, q, i]
            np.testing.assert_allclose(slipped, stamps[whole] > instant, atol=1e-6)
    c = np.array([0.01, 5.5])
    around = [moved[1] for moved in generate_event_times(there, "sensor.slip", c)]
    assert 2 < len(around) <= MAX_EVENT_TIME_SUBDIVISIONS
    assert max(abs(t - 5.5) for t in around) <= end / (EVENT_TIME_COUNT + 1)
    np.testing.assert_allclose(np.array(around) % (1 / 60), 0.5 / 60, atol=1e-9)
    assert not list(generate_event_times(there, "sensor.bias", np.array([0.01])))
    bounds = compute_coefficient_bounds(there, "sensor.slip")
    assert bounds[1] == (0.0, end)


def test_stops_are_tried_at_both_ends_of_where_it_has_been(pushed_slider):
    there = pushed_slider
    x = there.observed[..., there.channels.index("x")]
    low, high = float(np.nanmin(x)), float(np.nanmax(x))
    assert there.get_coordinate_range("state.limit") == (low, high)
    found = compute_directions(there, fitted(there), ["state.limit"])
    tried = [probe.coefficients for probe in probes_of(found, "state.limit")]
    assert {np.sign(c[0]) for c in tried} == {-1.0, 1.0}
    for stiffness, place, loss in tried:
        beyond = (high - place if stiffness > 0 else place - low) / (high - low)
        assert min(abs(beyond - share) for share in END_STOP_DEPTH_SHARES) < 1e-9
        assert loss == 0.0
    above = np.array([40.0, 0.5 * high, 0.1])
    around = list(generate_neighbouring_end_stops(there, "state.limit", above))
    assert len(around) == len(END_STOP_STIFFNESS_FACTORS) * len(DEEPER)
    assert all(c[0] > 0 and low < c[1] < high for c in around)
    assert not list(generate_neighbouring_end_stops(there, "spring.linear", np.array([1.0])))


def test_a_harder_stop_that_turns_back_at_the_same_place_is_met_later(pushed_slider):
    there = pushed_slider
    fit = fitted(there)
    _, high = there.get_coordinate_range("state.limit")
    theta = fit.theta.copy()
    theta[there.coefficient_slices["state.limit"]] = [40.0, 0.5 * high, 0.1]
    starts = list(
        generate_shifted_starts(there, replace(fit, effects=("state.limit",), theta=theta))
    )
    stops = np.array([s.theta[there.coefficient_slices["state.limit"]] for s in starts])
    np.testing.assert_allclose(stops[:, 0] / 40.0, REFIT_STIFFNESS_FACTORS)
    # All stops need the same work k d^(5/2) up to the end of the travel.
    np.testing.assert_allclose(stops[:, 0] * (high - stops[:, 1]) ** 2.5, 40 * (high / 2) ** 2.5)
