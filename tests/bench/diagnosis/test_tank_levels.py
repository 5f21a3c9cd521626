"""Tests of the example of two tanks.

Its script makes the recording and agrees with its simulator. Explain finds the hidden rim, and
no rim in a recording without one.
"""

import numpy as np
import pytest

from bench.core.plugin_registries import load_plugins, simulators
from bench.diagnosis.explain import explain
from sims.core.simulator import Scenario
from tests.conftest import PLUGINS
from tests.example_logs import overflowing_tanks

EXAMPLES = PLUGINS.parents[1] / "examples"
RECORDING = EXAMPLES / "tanks" / "overflow.csv"

pytestmark = pytest.mark.usefixtures("fresh_registries")


@pytest.fixture
def log_script():
    """Return the script that makes the recording, and register the example's simulator."""
    load_plugins([EXAMPLES / "tanks.py"])
    return overflowing_tanks


def test_the_recording_is_what_the_script_makes(log_script, tmp_path):
    log_script.write(tmp_path / "again.csv")
    again, shipped = (
        np.loadtxt(path, delimiter=",", skiprows=1) for path in (tmp_path / "again.csv", RECORDING)
    )
    np.testing.assert_allclose(again, shipped, atol=2e-6)
    assert (tmp_path / "again.toml").read_text() == RECORDING.with_suffix(".toml").read_text()


@pytest.mark.parametrize("rim", [0.2, 1.0])
def test_the_simulator_follows_the_solver_to_a_third_of_the_noise(log_script, rim):
    volts, start = log_script.RUNS[0], log_script.STARTS[0]
    exact = log_script.solved(volts, start, rim)
    tanks = simulators.get("tanks")(fixed={"state.overflow@upper": rim})
    inputs = {"volts": np.repeat(volts, log_script.HOLD)}
    initial = dict(zip(("upper", "lower"), start, strict=True))
    scenario = Scenario(log_script.STEP * np.arange(log_script.SAMPLES), initial, inputs)
    seen = tanks.simulate(
        np.array([[log_script.PUMP, log_script.UPPER, log_script.LOWER]]), scenario
    )[0]
    assert np.abs(seen - exact).max() < log_script.NOISE / 3
    assert (exact[:, 0].max() == rim) == (rim == log_script.RIM)


@pytest.mark.long
def test_the_rim_is_named_with_its_height(log_script):
    answer = explain(RECORDING).answer
    (cause,) = answer.causes
    assert (answer.verdict, cause.effect) == ("named", "state.overflow@upper")
    height = cause.coefficients["coefficient"]
    assert height.low < log_script.RIM < height.high
    assert height.high - height.low < 1e-3
    pump = answer.parameters["pump"]
    assert pump.low < log_script.PUMP < pump.high
    assert answer.heldout.gap_closed > 0.95


def test_tanks_that_do_not_spill_over_lack_nothing(log_script, tmp_path):
    log_script.write(tmp_path / "clean.csv", rim=1.0)
    answer = explain(tmp_path / "clean.csv").answer
    assert (answer.verdict, answer.causes) == ("adequate", ())
