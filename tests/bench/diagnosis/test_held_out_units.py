"""Tests of the unit in which the error on held-out runs is stated."""

from types import SimpleNamespace

import numpy as np
import pytest

from bench.diagnosis.pipeline.held_out_gap_closed import HeldOutGainCalculator

CHANNELS = {"q.base.x": "m", "q.base.qw": "1", "q.wheel": "rad", "tau.wheel": "N m"}
SIGMA = np.array([0.01, 0.01, 0.002, 0.1])


def make_gains(errors):
    """Return the gains of a causes' model that leaves noise, for base errors in units of noise."""
    rng = np.random.default_rng(4)
    observed = np.zeros((3, 400, 4))
    noise = SIGMA * rng.normal(size=(2, *observed.shape))
    before = noise[0] + SIGMA * np.sqrt(np.square(errors) - 1.0) * rng.normal(size=observed.shape)
    simulator = SimpleNamespace(
        channels=[SimpleNamespace(name=name, unit=unit) for name, unit in CHANNELS.items()],
        system=SimpleNamespace(reading=lambda channels: channels[0]),
    )
    runs = SimpleNamespace(
        observed=observed, simulator=simulator, channels=list(CHANNELS), lengths=np.full(3, 400),
        prepared_runs=[None] * 3,
    )  # fmt: skip
    lack_of_fit = SimpleNamespace(has_structure=False)
    model = SimpleNamespace(effects=("a",), likelihood=SimpleNamespace(sigma=SIGMA))
    fits = {(): SimpleNamespace(simulated=before), ("a",): SimpleNamespace(simulated=noise[1])}
    finding = SimpleNamespace(model=model, lack_of_fit=lack_of_fit, held_out_fits=fits)
    floor = SimpleNamespace(sigma=SIGMA, is_stated=np.ones(4, dtype=bool))
    simulated_runs = SimpleNamespace(
        floor=floor, fitting=runs, predicted=runs, before=None, is_cross_validated=False
    )
    return HeldOutGainCalculator(
        SimpleNamespace(runs=simulated_runs, finding=finding, rng=np.random.default_rng(0))
    )


@pytest.mark.parametrize(
    ("errors", "unit", "base"),
    [
        # The pose of the base shows the discrepancy: its unit counts, whatever the wheel shows.
        ([3.0, 1.0, 9.0, 1.0], "m", 0.03),
        ([1.2, 1.0, 9.0, 1.0], "m", 0.012),
        # Only the wheel shows it.
        ([1.0, 1.0, 9.0, 1.0], "rad", 0.018),
        # A quaternion or a force is not an error of motion.
        ([1.0, 9.0, 1.0, 9.0], "m", 0.01),
    ],
)
def test_the_error_is_stated_where_the_base_model_leaves_more_than_noise(errors, unit, base):
    gain = make_gains(np.array(errors)).measure()
    assert gain.unit == unit
    assert gain.rmse_base == pytest.approx(base, rel=0.06)
    if base > 0.011:
        assert gain.gap_closed == pytest.approx(1.0, abs=0.25)
