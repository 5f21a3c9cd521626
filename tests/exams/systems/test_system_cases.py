"""Tests of the exam's cases: of the wanted size, reproducible, and readable as recordings."""

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares

from bench.diagnosis_benchmark.case_generation import (
    effect_coefficients,
    reference_simulation,
    refitted_residuals,
)
from bench.diagnosis_benchmark.case_generation.benchmark_case import (
    MIN_DISTINCT_SIZE,
    BenchmarkCase,
)
from bench.diagnosis_benchmark.case_generation.case_sampling import draw_case, restore_conditions
from bench.diagnosis_benchmark.case_generation.effect_coefficients import find_coefficients
from bench.diagnosis_benchmark.case_generation.equivalent_effects import EQUIVALENT_EFFECTS
from bench.diagnosis_benchmark.case_generation.input_and_sensor_effects import TrueSystem
from bench.diagnosis_benchmark.case_generation.recording_conditions import (
    SIMULATORS,
    RequestedConditions,
    SensorNoise,
    draw_conditions,
    get_constants,
)
from bench.diagnosis_benchmark.case_generation.reference_simulation import (
    count_held_out_runs,
    simulate_with_mujoco,
    simulate_with_scipy,
)
from bench.diagnosis_benchmark.case_set import write_case
from sims.core.simulator import Scenario
from sims.recording.recording import read_recording
from tests.exams.exam import UndrawableError
from tests.exams.systems.system_cases import SystemQuestion, questions, quick


def refitted(item):
    """Return the discrepancy computed with SciPy's solvers and SciPy's least squares."""
    drawn = restore_conditions(item)
    drawn = replace(drawn, scenarios=drawn.scenarios[: item.runs - count_held_out_runs(item)])
    hidden = drawn.make_true_system(item.effects)
    observed = np.array([simulate_with_scipy(hidden, s, drawn.channels) for s in drawn.scenarios])
    names = list(drawn.parameters)
    states = ["z", "vz"] if drawn.channels == ("z",) else list(drawn.scenarios[0].initial)

    def rest(z):
        own = TrueSystem(
            item.system,
            dict(zip(names, np.exp(z[: len(names)]), strict=True)),
            get_constants(item.system),
        )
        starts = z[len(names) :].reshape(len(drawn.scenarios), -1)
        runs = [
            Scenario(s.times, {**s.initial, **dict(zip(states, start, strict=True))}, s.inputs)
            for s, start in zip(drawn.scenarios, starts, strict=True)
        ]
        return (
            (observed - [simulate_with_scipy(own, run, drawn.channels) for run in runs])
            / drawn.noise_sigmas
        ).ravel()

    starts = [[s.initial[name] for name in states] for s in drawn.scenarios]
    guess = np.concatenate([np.log(list(drawn.parameters.values())), np.ravel(starts)])
    found = least_squares(rest, guess, x_scale="jac", diff_step=1e-5, max_nfev=5)
    return np.sqrt(np.mean(found.fun**2))


@pytest.mark.parametrize(
    ("system", "seed", "effect", "size"),
    [
        ("slider", 0, "drag.linear", 2.0),
        ("ball", 20, "sensor.gain", 3.0),
        ("pendulum", 9, "force.bias", 2.0),
    ],
)
def test_the_gap_has_the_requested_size(system, seed, effect, size):
    item = draw_case("single", system, seed, effect, size)
    assert item.size == size
    assert refitted(item) == pytest.approx(size, rel=0.05)


@pytest.mark.parametrize(
    ("system", "effect"),
    [
        ("ball", "wind"),
        ("ball", "sensor.lag"),
        ("slider", "friction.stribeck"),
        ("pendulum", "input.lag"),
    ],
)
def test_the_hidden_effect_leaves_only_noise(system, effect):
    """Solver and engine differ by less than one sigma of evidence."""
    item = SystemQuestion("marks", "single", system, effect, 0, 4.0).draw().item
    drawn = restore_conditions(item)
    for see in (simulate_with_scipy, simulate_with_mujoco):
        observed = np.array(
            [see(drawn.make_true_system(item.effects), s, drawn.channels) for s in drawn.scenarios]
        )
        left = refitted_residuals.compute_refitted_residual(
            drawn, observed, effect, item.effects[effect]
        )
        assert left * observed.size**0.5 < 1.0  # Sigmas of evidence against the true cause.


def test_a_cause_without_a_visible_draw_is_refused():
    with pytest.raises(UndrawableError, match="absorb the cause"):
        SystemQuestion("marks", "single", "slider", "input.gain", 0, 3.0).draw()


def test_cases_that_the_sensors_cannot_show_are_refused():
    assert draw_case("single", "slider", 0, "input.gain") is None  # The estimated mass explains it.
    # The initial position explains it.
    assert draw_case("single", "slider", 0, "sensor.bias") is None


def test_neither_of_two_effects_explains_both():
    item = draw_case("double", "ball", 1)
    observed = reference_simulation.simulate_observations(restore_conditions(item), item.effects)
    left = [
        refitted_residuals.compute_refitted_residual(restore_conditions(item), observed, name, c)
        for name, c in item.effects.items()
    ]
    assert len(left) == 2
    assert min(left) >= MIN_DISTINCT_SIZE


def test_no_effect_of_the_library_explains_a_foreign_cause():
    item = draw_case("foreign", "ball", 0, "layer")
    assert item.source == "scipy"
    assert list(item.effects) == ["layer"]
    assert MIN_DISTINCT_SIZE <= item.beyond <= item.size


@pytest.mark.parametrize("system", ["ball", "slider"])
def test_every_run_contains_the_gust(system):
    drawn = draw_conditions(system, np.random.default_rng(0), ("gust",))
    numbers = effect_coefficients.draw_effect_shape(
        "gust", replace(drawn, scenarios=drawn.scenarios[:2]), np.random.default_rng(0)
    )(0.5)
    world = drawn.make_true_system({"gust": numbers})
    for number, run in enumerate(drawn.scenarios):
        change = simulate_with_scipy(world, run, drawn.channels, number) - simulate_with_scipy(
            drawn.make_true_system({}), run, drawn.channels
        )
        assert np.abs(change).max() > 0.01


@pytest.mark.parametrize(
    ("system", "driven", "names"), [c for c in EQUIVALENT_EFFECTS if c.system in SIMULATORS]
)
def test_equivalent_effects_explain_each_other(system, driven, names):
    hidden = ("input.gain",) if driven else ("gravity.tilt",)
    three_runs = RequestedConditions(runs=3)
    drawings = (
        draw_conditions(system, np.random.default_rng(seed), hidden, requested=three_runs)
        for seed in range(3, 10)
    )
    drawn = next(conditions for conditions in drawings if conditions.is_driven is driven)
    first = min(names)
    observed = reference_simulation.simulate_observations(
        drawn, {first: find_coefficients(first, drawn, 3.0, np.random.default_rng(0))}
    )
    for other in names - {first}:
        assert refitted_residuals.compute_refitted_residual(drawn, observed, other) < 0.03


def test_the_same_seed_gives_the_same_files(tmp_path):
    for kind, system in (("single", "ball"), ("clean", "slider")):
        item = draw_case(kind, system, 5)
        assert item == draw_case(kind, system, 5)
        assert item.parameters != draw_case(kind, system, 6).parameters
        paths = [
            write_case(item, tmp_path / place)
            for place in ("a", "b")
            if (tmp_path / place).mkdir(exist_ok=True) is None
        ]
        assert paths[0].read_bytes() == paths[1].read_bytes()
        assert (
            BenchmarkCase.from_document(json.loads(paths[0].with_suffix(".truth.json").read_text()))
            == item
        )


@pytest.mark.parametrize(
    ("kind", "system"), [("clean", "ball"), ("clean", "pendulum"), ("single", "slider")]
)
def test_written_files_load_as_recordings(tmp_path, kind, system):
    # A case whose effect these sensors cannot show is not drawn.
    item = next(filter(None, (draw_case(kind, system, index) for index in range(2, 9))))
    recording = read_recording(write_case(item, tmp_path), SIMULATORS[system].system())
    assert recording.system == system
    assert len(recording.runs) == item.runs
    assert [run.held_out for run in recording.runs] == [
        k >= item.runs - count_held_out_runs(item) for k in range(item.runs)
    ]
    assert bool(recording.noise) is item.stated
    assert all(run.times.size == round(item.rate * item.seconds) for run in recording.runs)
    drawn = restore_conditions(item)
    clean = np.concatenate(
        [
            simulate_with_scipy(drawn.make_true_system(item.effects), s, drawn.channels)
            for s in drawn.scenarios
        ]
    )
    seen = np.concatenate(
        [np.column_stack([run.channels[c] for c in drawn.channels]) for run in recording.runs]
    )
    np.testing.assert_allclose((seen - clean).std(axis=0), drawn.noise_sigmas, rtol=0.15)


@pytest.mark.parametrize("kind", ["white", "ar1", "quantised"])
def test_noise_has_the_stated_colour_or_step(kind):
    noise = SensorNoise({"q": 0.01}, kind, 0.6, 0.4, True)
    values = np.linspace(0, 1, 20000)[:, None]
    error = (noise.add_to(values, np.random.default_rng(0)) - values)[:, 0]
    assert error.std() == pytest.approx(0.01, rel=0.05)
    assert np.corrcoef(error[1:], error[:-1])[0, 1] == pytest.approx(
        0.6 if kind == "ar1" else 0.0, abs=0.03
    )
    distinct = np.unique((error + values[:, 0]).round(12)).size
    assert distinct < 100 if kind == "quantised" else distinct > 19000


def test_the_exam_covers_all_effects_sizes_and_conditions():
    sheet = questions()
    marks = [q for q in sheet if q.part == "marks"]
    assert len(marks) >= 600
    for system in SIMULATORS:
        assert sum(q.kind == "clean" and q.system == system for q in marks) >= 100
    sizes = [q.size for q in marks if q.kind == "single"]
    assert min(sizes) >= 1.0
    assert max(sizes) <= 10.0
    assert {q.size for q in sheet if q.part == "power"} == {0.1, 0.2, 0.3, 0.5}
    assert 12 <= len(quick()) <= 16
    assert {q.kind for q in quick()} == {"clean", "single", "double", "foreign"}


def test_a_case_is_redrawn_until_its_effect_is_visible():
    # The effect is visible only in the velocity channel, which few cases record.
    item = SystemQuestion("marks", "single", "slider", "sensor.gain", 0, 2.5).draw().item
    assert item.seed > 0
    assert restore_conditions(item).channels == ("x", "v")
