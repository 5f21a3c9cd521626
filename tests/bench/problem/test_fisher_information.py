import dataclasses
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from bench.benchmark.comparison_report import write_report
from bench.benchmark.comparison_study import Comparison
from bench.benchmark.problem.experiment_config import load_experiment, parse_experiment
from bench.benchmark.problem.fisher_information import (
    STIFF_SIGMA_THRESHOLD,
    InformationSpectrum,
    compute_spectrum,
    compute_spectrum_from_jacobian,
    compute_target_spectrum,
)
from bench.benchmark.problem.targets import draw_targets
from bench.benchmark.problem.tuning_problem import TuningProblem
from bench.benchmark.runner.study_base import prepare_study
from bench.benchmark.statistics.error_curves import select_primary_metric
from bench.benchmark.storage.result_folder import read_comparison
from sims.core.simulator import InputError, Parameter
from sims.core.toml_validation import tomllib
from tests.conftest import PLUGINS
from tests.sample_experiments import spring_experiment

PLUGIN_FILES = [str(PLUGINS / "spring.py")]
pytestmark = pytest.mark.usefixtures("spring")

LINE = (
    Parameter("offset", "m", 0.0, (-4.0, 4.0), (-1.0, 1.0)),
    Parameter("slope", "m/s", 0.0, (-9.0, 9.0), (-4.0, 4.0)),
)


def line(theta, times=np.arange(20) / 10):  # noqa: B008
    return (theta[:, :1] + theta[:, 1:] * times)[:, :, None]


def test_fisher_information_of_a_line_is_that_of_regression():
    times, sigma, widths = np.arange(20) / 10, 0.3, np.diag([2.0, 8.0])
    design = np.stack([np.ones(20), times], axis=1)
    information = widths @ design.T @ design @ widths / sigma**2
    found = compute_spectrum(line, np.array([0.2, -1.0]), LINE, np.array([sigma]))
    np.testing.assert_allclose(
        found.vectors @ np.diag(found.values) @ found.vectors.T, information, rtol=1e-9
    )
    np.testing.assert_allclose(found.vectors.T @ found.vectors, np.eye(2), atol=1e-12)
    # Linear regression attains the bound: its covariance, projected on the directions.
    covariance = (
        np.linalg.inv(widths) @ np.linalg.inv(design.T @ design / sigma**2) @ np.linalg.inv(widths)
    )
    np.testing.assert_allclose(
        found.sigmas**2, np.diagonal(found.vectors.T @ covariance @ found.vectors), rtol=1e-9
    )


def test_least_squares_estimates_scatter_as_the_bound_says():
    times, sigma, rng = np.arange(20) / 10, 0.3, np.random.default_rng(1)
    design = np.stack([np.ones(20), times], axis=1)
    noisy = line(np.array([[0.2, -1.0]]))[0, :, 0] + sigma * rng.standard_normal((4000, 20))
    estimates = np.linalg.lstsq(design, noisy.T, rcond=None)[0].T
    found = compute_spectrum(line, np.array([0.2, -1.0]), LINE, np.array([sigma]))
    components = (estimates - [0.2, -1.0]) / [2.0, 8.0] @ found.vectors
    np.testing.assert_allclose(components.std(axis=0), found.sigmas, rtol=0.05)


def test_a_direction_is_stiff_that_is_known_to_a_tenth_of_its_range():
    found = InformationSpectrum(np.array([101.0, 99.0, 25.0]), np.eye(3))
    assert found.is_stiff.tolist() == [True, False, False]
    stiff, sloppy = found.compute_directional_errors(np.array([[0.1, 0.3, 0.4], [0.0, 0.0, 0.0]]))
    np.testing.assert_allclose(stiff, [0.1, 0.0])
    np.testing.assert_allclose(sloppy, [np.sqrt((0.09 + 0.16) / 2), 0.0])


def test_only_the_product_of_two_factors_is_stiff():
    def product(theta):
        return (theta[:, :1] * theta[:, 1:] * np.arange(1, 30))[:, :, None]

    factors = (
        Parameter("a", "1", 1.0, (0.0, 8.0), (0.0, 4.0)),
        Parameter("b", "1", 1.0, (0.0, 2.0), (0.0, 1.0)),
    )
    found = compute_spectrum(product, np.array([3.0, 0.5]), factors, np.array([0.01]))
    assert found.is_stiff.tolist() == [True, False]
    np.testing.assert_allclose(found.values[1], 0.0, atol=1e-9 * found.values[0])
    # d(ab) = 0 gives da / a = -db / b; in units of the training ranges, da = 4 x and db = y.
    expected = np.array([3.0 / 4, -0.5]) / np.hypot(3.0 / 4, 0.5)
    np.testing.assert_allclose(found.vectors[:, 1], expected, atol=1e-6)
    stiff, sloppy = found.compute_directional_errors(
        np.stack([0.3 * found.vectors[:, 1], 0.2 * found.vectors[:, 0], [0.5, 0.5]])
    )
    np.testing.assert_allclose(stiff[:2], [0.0, 0.2], atol=1e-12)
    np.testing.assert_allclose(sloppy[:2], [0.3, 0.0], atol=1e-12)
    assert stiff[2] ** 2 + sloppy[2] ** 2 == pytest.approx(0.5)


def test_small_eigenvalues_do_not_drown_in_rounding():
    found = compute_spectrum_from_jacobian(np.diag([1.0, 1e-7, 1e-12]))
    np.testing.assert_allclose(found.sigmas, [1.0, 1e7, 1e12], rtol=1e-9)
    assert compute_spectrum_from_jacobian(np.ones((1, 3))).values.tolist() == pytest.approx(
        [3.0, 0.0, 0.0]
    )


def test_differences_stay_within_the_bounds():
    found = compute_spectrum(_refusing_beyond, np.array([4.0, -9.0]), LINE, np.array([0.3]))
    inside = compute_spectrum(line, np.zeros(2), LINE, np.array([0.3]))
    np.testing.assert_allclose(found.values, inside.values, rtol=1e-8)


def _refusing_beyond(theta):
    assert (np.abs(theta) <= [4.0, 9.0]).all()
    return line(theta)


def test_spring_against_its_derivatives():
    problem = TuningProblem(spring_experiment(noise={"x": 0.05}))
    target = draw_targets(problem)[0]
    rate, decay = target.truth
    scenario = target.blinded.fitting.scenarios[0]
    t, x0 = scenario.times, scenario.initial["x"]
    by_rate = -x0 * t * np.exp(-decay * t) * np.sin(rate * t)
    by_decay = -x0 * t * np.exp(-decay * t) * np.cos(rate * t)
    expected = compute_spectrum_from_jacobian(
        np.stack([by_rate * 2.0, by_decay * 0.4], axis=1) / 0.05
    )  # training widths 2 and 0.4
    found = compute_target_spectrum(problem, target)
    np.testing.assert_allclose(found.values, expected.values, rtol=1e-6)
    np.testing.assert_allclose(found.vectors, expected.vectors, atol=1e-6)


def test_servo_that_is_always_driven_cannot_tell_resistance_from_drag():
    """The torque is kt V / R duty - (kt^2 / R + c) q': two combinations of three parameters."""
    problem = TuningProblem(load_experiment("servo-friction").chosen(targets=1))
    target = draw_targets(problem)[0]
    found = compute_target_spectrum(problem, target)
    assert found.is_stiff.tolist() == [True] * 4 + [False]
    slope = target.truth[0] / target.truth[1]
    null = np.array([slope, 1.0, 0.0, -(slope**2), 0.0]) / problem.cube.compute_training_widths()
    assert abs(found.vectors[:, -1] @ null) / np.linalg.norm(null) == pytest.approx(1.0, abs=1e-5)
    problem.close()


def test_a_phase_with_the_motor_off_tells_them_apart():
    experiment = load_experiment("servo-friction")
    inputs = {**experiment.inputs, "torque_enable": "square:1:0.25"}  # off where it is -1
    problem = TuningProblem(dataclasses.replace(experiment, inputs=inputs, targets=1))
    assert compute_target_spectrum(problem, draw_targets(problem)[0]).is_stiff.all()
    problem.close()


def test_pendulum_tells_no_common_factor_of_all_that_acts_on_it():
    experiment = load_experiment("pendulum-driven")
    settings = {"engine": "pybullet", "effects": [*experiment.settings["effects"], "gravity.scale"]}
    problem = TuningProblem(dataclasses.replace(experiment, settings=settings, targets=1))
    target = draw_targets(problem)[0]
    found = compute_target_spectrum(problem, target)
    inertia, drag, friction, gain, gravity = target.truth
    factor = (
        np.array([inertia, drag, friction, 1 + gain, 1 + gravity])
        / problem.cube.compute_training_widths()
    )
    assert found.values[-1] < 1e-9 * found.values[0]
    assert abs(found.vectors[:, -1] @ factor) / np.linalg.norm(factor) == pytest.approx(
        1.0, abs=1e-4
    )
    problem.close()


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    changes = {"held_out": {"scenarios": 2, "initial": {"x": 3.0}}, "noise": {"x": 0.05}}
    experiment = spring_experiment(
        targets=2, budget=6, tuners={"random": {}, "nelder_mead": {}}, **changes
    )
    folder = tmp_path_factory.mktemp("found") / "run"
    comparison = Comparison.begin(prepare_study(experiment, PLUGIN_FILES, folder))
    assert comparison.run().is_complete
    return folder, comparison.results


def test_errors_along_directions_and_of_prediction_are_recorded(folder):
    folder, results = folder
    runs, problem = read_comparison(folder).runs, results.problem
    targets = {job.target.blinded.name: job.target for job in results.plan}
    for row in runs.iloc[:: max(len(runs) // 12, 1)].to_dict("records"):
        target, found = targets[row["target"]], results.spectra[row["target"]]
        delivered = np.array([row["recommendation_rate"], row["recommendation_decay"]])
        away = (delivered - target.truth) / [2.0, 0.4]
        for metric, mask in (("stiff_error", found.is_stiff), ("sloppy_error", ~found.is_stiff)):
            expected = (
                np.sqrt(np.mean((found.vectors[:, mask].T @ away) ** 2)) if mask.any() else np.nan
            )
            assert row[metric] == pytest.approx(expected, nan_ok=True, rel=1e-9)
        t = np.arange(60) / 20

        def swing(theta, t=t):
            return 3.0 * np.exp(-theta[1] * t) * np.cos(theta[0] * t)

        error = np.sqrt(np.mean((swing(delivered) - swing(target.truth)) ** 2))
        assert row["heldout_error"] == pytest.approx(error, rel=1e-9, abs=1e-12)
    assert problem.has_several_parameters


def test_folder_has_the_spectra_and_the_table_the_metrics(folder):
    folder, _ = folder
    said = []
    write_report(folder, said.append)
    spectra = pd.read_csv(folder / "identifiability.csv")
    assert len(spectra) == 2 * 2 * 2
    assert {"rate", "decay", "eigenvalue", "sigma", "stiff"} <= set(spectra.columns)
    np.testing.assert_allclose(spectra["rate"] ** 2 + spectra["decay"] ** 2, 1.0)
    assert (spectra["stiff"] == (spectra["sigma"] < STIFF_SIGMA_THRESHOLD)).all()
    metrics = set(pd.read_csv(folder / "table.csv")["metric"])
    assert {"param_error", "stiff_error", "obs_error", "heldout_error"} <= metrics
    for name in ("identifiability", "stiff-sloppy-prediction"):
        assert (folder / "figures" / f"{name}.png").stat().st_size > 10_000
    assert any("unseen scenarios" in line for line in said)


def test_held_out_scenarios_change_nothing_else():
    plain = draw_targets(TuningProblem(spring_experiment(noise={"x": 0.05})))
    more = draw_targets(TuningProblem(spring_experiment(noise={"x": 0.05}, held_out={})))
    for a, b in zip(plain, more, strict=True):
        np.testing.assert_array_equal(a.truth, b.truth)
        np.testing.assert_array_equal(a.blinded.start, b.blinded.start)
        np.testing.assert_array_equal(a.blinded.fitting.observed, b.blinded.fitting.observed)
        starts = [
            s.initial["x"] for s in (*b.blinded.fitting.scenarios, *b.blinded.held_out.scenarios)
        ]
        assert len(set(starts)) == 4
        assert all(0.8 <= x <= 1.2 for x in starts)
        assert b.blinded.held_out.observed.shape == (180, 1)
        first = (
            starts[1]
            * np.exp(-b.truth[1] * np.arange(60) / 20)
            * np.cos(b.truth[0] * np.arange(60) / 20)
        )
        np.testing.assert_allclose(
            b.blinded.held_out.observed[:60, 0], first, atol=1e-12
        )  # without noise


def test_the_page_s_own_example_is_an_experiment():
    page = (Path(__file__).parents[3] / "docs" / "problems.md").read_text()
    document = tomllib.loads(page.split("```toml")[1].split("```")[0])
    problem = TuningProblem(parse_experiment("mine", document, Path("mine.toml")).chosen(targets=1))
    assert [p.name for p in problem.cube.parameters] == [
        "inertia",
        "drag.linear",
        "friction.coulomb",
        "input.gain",
    ]
    held_out = draw_targets(problem)[0].blinded.held_out.scenarios
    np.testing.assert_allclose(
        held_out[2].inputs["u"], 0.1 * np.sin(2 * np.pi * 0.7 * held_out[2].times)
    )
    problem.close()


def test_it_can_be_switched_off():
    problem = TuningProblem(spring_experiment(identifiability=False))
    assert compute_target_spectrum(problem, draw_targets(problem)[0]) is None


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"held_out": {"scenarios": 0}}, "scenarios of at least 1"),
        (
            {"held_out": {"runs": 3}},
            r"unknown entry of \[held_out\].*'runs'; there are: initial, inputs, scenarios",
        ),
        (
            {"held_out": {"initial": {"x": [2, 1]}}},
            r"held_out.initial.x: expected low < high, found \[2, 1\]",
        ),
        ({"held_out": {"inputs": {"u": 3}}}, "held_out.inputs.u: expected text, found 3"),
        ({"identifiability": 1}, "identifiability: expected a bool, found 1"),
    ],
)
def test_faults_are_one_line(change, message):
    with pytest.raises(InputError, match=message):
        spring_experiment(**change)


def test_an_unknown_state_of_held_out_scenarios_is_refused():
    with pytest.raises(InputError, match="unknown initial state"):
        draw_targets(TuningProblem(spring_experiment(held_out={"initial": {"y": 1.0}})))


def test_what_nobody_could_know_decides_nothing():
    runs = pd.DataFrame(
        {"run": ["a", "a", "b"], "param_error": [0.3, 0.2, 0.4], "stiff_error": [0.1, 0.05, np.nan]}
    )
    assert select_primary_metric(runs.assign(sloppy_error=np.nan)).metric == "param_error"
    decisive = select_primary_metric(runs.assign(sloppy_error=[0.5, 0.6, 0.7]))
    assert decisive.metric == "stiff_error"
    assert decisive.in_widths
    assert decisive.runs["run"].tolist() == ["a", "a"]
    assert select_primary_metric(runs.drop(columns="stiff_error")).metric == "param_error"
