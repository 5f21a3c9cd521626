"""Tests that time ranges follow the recording and that parameters at a bound are reported."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from bench.core.plugin_registries import load_plugins
from bench.diagnosis.evaluation import parameter_bounds
from bench.diagnosis.evaluation.parameter_bounds import bound_of, compute_coefficient_bounds
from bench.diagnosis.evaluation.time_scaled_ranges import adapt_to_time_scale
from bench.diagnosis.explain import explain
from bench.diagnosis.extended_robot_files import select_written_causes
from bench.diagnosis.report.report_data import ParameterChange
from bench.diagnosis.report.summary_text import (
    format_headline,
    format_shift,
    format_summary,
    has_absorbed_gap,
)
from bench.diagnosis.search.verdict_rules import verdict_of_numbers
from sims.core.simulator import Parameter
from sims.extended_simulator import FittedValue
from tests.bench.diagnosis.explained_samples import evaluator, recording
from tests.bench.diagnosis.sample_report_data import DRAG, make_report, summary_text
from tests.bench.diagnosis.simulated_logs import write_log
from tests.command_output import run_command
from tests.conftest import PLUGINS

TANKS = PLUGINS.parents[1] / "examples" / "tanks.py"
LAG, STEP, HOLD, NOISE = 5.0, 4.0, 15, 1e-3
AREA, PUMP, UPPER, LOWER = 2.8e-3, 3.4e-6, 7.4e-6, 7.8e-6
RUNS = (
    ((5.0, 2.0, 3.5, 5.5, 3.0, 4.5, 1.5, 4.0), (0.05, 0.04)),
    ((4.0, 5.2, 2.5, 3.0, 5.0, 3.5, 2.0, 4.5), (0.1, 0.12)),
    ((3.0, 4.8, 5.5, 2.0, 4.0, 1.5, 5.0, 2.5), (0.03, 0.06)),
)


def lagged_tanks(path):
    """Write a recording of two tanks whose level sensors lag by `LAG`, integrated with LSODA."""

    def rates(_, h, volts):
        through, away = (a * np.sqrt(2 * 9.81 * x) for a, x in ((UPPER, h[0]), (LOWER, h[1])))
        filled = (PUMP * volts - through) / AREA
        return [filled, (through - away) / AREA, (h[0] - h[2]) / LAG, (h[1] - h[3]) / LAG]

    rng, runs, times = np.random.default_rng(3), [], STEP * np.arange(HOLD + 1)
    for volts, start in RUNS:
        state, levels = np.array([*start, *start]), []
        for u in volts:
            exact = {"t_eval": times, "method": "LSODA", "rtol": 1e-10, "atol": 1e-12}
            part = solve_ivp(rates, (0.0, times[-1]), state, args=(u,), **exact)
            levels.append(part.y[2:, :-1].T)
            state = part.y[:, -1]
        seen = np.concatenate(levels) + NOISE * rng.normal(size=(len(volts) * HOLD, 2))
        runs.append((STEP * np.arange(len(seen)), np.repeat(volts, HOLD), seen))
    channels = "".join(f'[channels.{n}]\nunit = "m"\nnoise = {NOISE}\n' for n in ("upper", "lower"))
    about = f'system = "tanks"\n{channels}[inputs.volts]\nunit = "V"\n'
    return write_log(path.parent, about, "volts,upper,lower", runs, path.stem)


@pytest.mark.slow
@pytest.mark.usefixtures("fresh_registries")
def test_a_lag_of_seconds_in_a_system_of_minutes_is_named(tmp_path):
    load_plugins([TANKS])
    answer = explain(lagged_tanks(tmp_path / "slow.csv")).answer
    (cause,) = answer.causes
    lag = cause.coefficients["coefficient"]
    assert (answer.verdict, cause.effect, cause.alternatives) == ("named", "sensor.lag", ())
    assert lag.low < LAG < lag.high
    assert lag.high - lag.low < 0.5
    assert lag.at_bound is None


@pytest.mark.parametrize(
    ("name", "unit", "stated", "longest", "spacing", "expected"),
    [
        ("sensor.lag", "s", (0.0, 0.2), 4.0, 0.01, (0.0, 0.2)),
        ("sensor.lag", "s", (0.0, 0.2), 480.0, 4.0, (0.0, 24.0)),
        ("input.delay", "s", (-0.05, 0.2), 480.0, 4.0, (-6.0, 24.0)),
        ("friction.warming.time", "s", (0.5, 500.0), 4.0, 0.01, (0.5, 500.0)),
        ("friction.warming.time", "s", (0.5, 500.0), 480.0, 4.0, (0.5, 1440.0)),
        ("force.periodic.frequency", "Hz", (0.1, 10.0), 4.0, 0.01, (0.1, 10.0)),
        ("force.periodic.frequency", "Hz", (0.1, 10.0), 480.0, 4.0, (0.00125, 0.125)),
        ("sensor.slip.instant", "s", (0.01, 10.0), 480.0, 4.0, (0.01, 10.0)),
        ("drag.linear", "1/s", (0.0, 0.5), 480.0, 4.0, (0.0, 0.5)),
    ],
)
def test_ranges_of_times_follow_the_duration_and_the_sampling(
    name, unit, stated, longest, spacing, expected
):
    scaled = adapt_to_time_scale(Parameter(name, unit, stated[1], stated), longest, spacing)
    assert scaled.bounds == pytest.approx(expected)


@pytest.mark.parametrize("seconds", [1.0, 4.0, 40.0])
def test_a_fit_may_move_a_delay_up_to_the_longest_run(seconds):
    there = evaluator(
        recording(runs=2, seconds=seconds, rate=20),
        candidates=["sensor.lag", "input.delay", "input.lag"],
    )
    longest = there.longest_duration
    for name in there.library:
        ((low, high),) = compute_coefficient_bounds(there, name)
        assert high == pytest.approx(longest)
        assert low in (0.0, pytest.approx(-min(max(longest / 4.0, 1.0), longest)))


def test_only_the_dry_part_of_warming_friction_is_limited_to_what_slides(example_arm):
    """A viscous part of five times its plausible range was left to a second cause."""
    name = "friction.warming@elbow"
    dry, viscous, _ = example_arm.parameters[example_arm.coefficient_slices[name]]
    dry_bounds, viscous_bounds, _ = compute_coefficient_bounds(example_arm, name)
    assert dry_bounds == pytest.approx((0.0, 4.0 * dry.bounds[1]))
    assert viscous_bounds == pytest.approx((0.0, 20.0 * viscous.bounds[1]))


@pytest.mark.parametrize(
    ("value", "low", "expected"),
    [
        (0.0, 0.0, "low"),
        # A small drag is not at the bound.
        (1e-9, 0.0, None),
        (1e-3 + 1e-9, 1e-3, "low"),
        (0.5, 0.0, None),
        (1.0, 0.0, "high"),
        (1.2, 0.0, "high"),
    ],
)
def test_which_bound_a_number_lies_at(value, low, expected):
    assert bound_of(value, low, 1.0) == expected


@pytest.mark.parametrize(
    ("number", "result"),
    [
        (FittedValue(1.0, "s", 0.9, 1.1), True),
        (FittedValue(1.0, "s", None, None), False),
        (FittedValue(4.0, "s", None, None, "high"), False),
        (FittedValue(-0.99, "1", None, None, "low"), False),
        # Zero friction is a result: it is the smallest possible value.
        (FittedValue(0.0, "N", None, None, "low"), True),
    ],
)
def test_a_number_at_a_bound_or_without_interval_is_not_a_result(number, result):
    assert number.is_result is result
    assert verdict_of_numbers("named", number.is_result) == ("named" if result else "partial")
    assert verdict_of_numbers("adequate", number.is_result) == "adequate"


@pytest.fixture(scope="module")
def bounded(tmp_path_factory):
    """Explain a pendulum with a drag above the limited range of the fit.

    Joint friction that warms without end can take the place of the drag.
    """
    folder = tmp_path_factory.mktemp("bounded")
    path = folder / "swing.csv"
    words = ["--noise", "q=0.002", "--observe", "q", "--initial", "q=0.4:1.2", "--seconds", "2"]
    effect = ["--effect", "drag.linear=0.004"]
    run_command("simulate", "pendulum", "--out", path, *words, *effect)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(parameter_bounds, "MAX_RANGE_FACTOR", 0.02)
        # The viscous part of friction has the range of dry friction.
        patch.setattr(parameter_bounds, "VISCOUS_UNITS", ())
        found = explain(path)
        printed = format_summary(found.story)
        found.write(folder / "out")
    return SimpleNamespace(found=found, printed=printed, folder=folder / "out")


def test_a_cause_whose_number_lies_at_its_bound_is_not_named(bounded):
    answer = bounded.found.answer
    (cause,) = answer.causes
    time = cause.coefficients["time"]
    assert (answer.verdict, cause.effect) == ("partial", "friction.warming")
    assert (time.value, time.at_bound, time.low, time.high) == (500.0, "high", None, None)
    assert cause.coefficients["viscous"].is_result


def test_the_bound_is_said_wherever_the_number_is(bounded):
    document = json.loads((bounded.folder / "verdict.json").read_text())
    numbers = document["causes"][0]["coefficients"]
    assert numbers["time"]["at_bound"] == "high"
    assert numbers["time"]["low"] is numbers["time"]["high"] is None
    assert "at_bound" not in numbers["viscous"]
    printed = " ".join(" ".join(bounded.printed).split())
    assert "upper bound of its range" in printed
    assert "friction.warming, time: 500 s is the upper bound of its range" in printed
    assert "A value at a bound is not a result and has no interval" in printed
    page = (bounded.folder / "report.html").read_text()
    assert "(upper bound of its range)" in page


def test_a_partial_verdict_for_a_bound_says_which():
    number = {"value": 4.0, "unit": "s", "low": None, "high": None, "at_bound": "high"}
    lag = {**DRAG, "effect": "sensor.lag", "coefficients": {"coefficient": number}}
    report = make_report("partial", causes=[lag])
    assert format_headline(report) == (
        "The simulation lacks a sensor lag, but the fit ends at the upper bound of its range, 4 s."
    )
    said = summary_text(report)
    assert "sensor.lag, coefficient: 4 s is the upper bound of its range" in said
    assert "record longer runs" in said
    assert "coefficient 4 s (upper bound of its range)" in said


def format_parameter_text(*changes):
    """Return the paragraph on the parameters in the summary of one cause."""
    report = replace(make_report("named", causes=[DRAG]), parameters=list(changes))
    paragraphs = "\n".join(format_summary(report)).split("\n\n")
    (paragraph,) = [text for text in paragraphs if text.startswith("Parameters: ")]
    return " ".join(paragraph.split()).removeprefix("Parameters: ")


def test_a_parameter_at_its_bound_is_said_to_be_there():
    p = ParameterChange("mass", "kg", (1.0, 0.9, 1.1), (10.0, np.nan, np.nan), True, (None, "high"))
    assert "10 kg (upper bound of its range) after" in format_parameter_text(p)


def test_many_parameters_are_listed_without_intervals():
    in_file = ", in the model file 20 → 21 N·m/rad"
    stiff = ParameterChange(
        "kp", "1", (-0.3, -0.4, -0.2), (0.05, 0.04, 0.06), True, in_file=in_file
    )
    still = ParameterChange("kv", "1", (0.1, 0.0, 0.2), (0.1, 0.0, 0.2), True)
    mass = ParameterChange(
        "mass", "kg", (1.0, 0.9, 1.1), (9.0, np.nan, np.nan), True, (None, "high")
    )
    assert format_parameter_text(stiff, still, mass).count("before") == 3
    four = format_parameter_text(stiff, still, still, mass)
    assert four == (
        "2 of 4 had absorbed part of the gap (before → after): kp −0.3 → 0.05, in the model file "
        "20 → 21 N·m/rad; kv 0.1 → 0.1; kv 0.1 → 0.1; mass 1 → 9 kg (upper bound of its range)."
    )


def test_nothing_of_a_number_at_a_bound_is_written_into_a_model_file():
    good, bad = FittedValue(0.3, "N*m", 0.2, 0.4), FittedValue(2.0, "N*m", None, None, "high")
    kept, left_out = select_written_causes(
        {
            "friction.coulomb@*": {"coefficient@a": good, "coefficient@b": bad},
            "mass.scale@arm": {"coefficient": FittedValue(-0.99, "1", None, None, "low")},
            "numerics.step": {"step": FittedValue(0.001, "s", None, None)},
        }
    )
    assert kept == {
        "friction.coulomb@*": {"coefficient@a": good},
        "numerics.step": {"step": FittedValue(0.001, "s", None, None)},
    }
    first, second = left_out
    assert "friction.coulomb@b is not written" in first
    assert "upper bound" in first
    assert "mass.scale@arm is not written" in second


@pytest.mark.parametrize(
    ("before", "after", "absorbed"),
    [
        # The change is below 0.1 %, although it is far outside both intervals.
        ((3.3e-3, 3.29999e-3, 3.30001e-3), (3.3005e-3, 3.30049e-3, 3.30051e-3), False),
        # The change is within the two intervals.
        ((1.0, 0.9, 1.1), (1.08, 1.07, 1.09), False),
        ((1.0, 0.99, 1.01), (1.08, 1.07, 1.09), True),
    ],
)
def test_a_parameter_absorbs_what_is_significant(before, after, absorbed):
    p = ParameterChange("inertia", "kg*m^2", before, after, True)
    said = format_parameter_text(p)
    assert has_absorbed_gap(p) is absorbed
    assert ("absorbed part of the gap" in said) is absorbed
    assert "(0.0 %)" not in said


@pytest.mark.parametrize(
    ("before", "after", "text"),
    [
        (1.0, 1.0, "unchanged"),
        (1.0, 1.0001, "changes by less than 0.1 %"),
        (1.0, 1.05, "+5.0 %"),
        (1.0, 0.9, "−10 %"),
        (0.0, 0.5, "+0.5 N"),
    ],
)
def test_a_shift_is_relative_unless_it_begins_at_zero(before, after, text):
    intervals = [(value, value - 0.05, value + 0.05) for value in (before, after)]
    assert format_shift(ParameterChange("b", "N", *intervals, True)) == text
