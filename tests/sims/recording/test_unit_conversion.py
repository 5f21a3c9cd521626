import math
import time

import pytest

from sims.core.simulator import InputError
from sims.recording.unit_conversion import IDENTITY_SCALE, compute_unit_scale


@pytest.mark.parametrize(
    ("unit", "target", "gain"),
    [
        ("deg", "rad", math.pi / 180),
        ("°", "rad", math.pi / 180),
        ("turn", "rad", 2 * math.pi),
        ("rpm", "rad/s", math.pi / 30),
        ("deg/s", "rad/s", math.pi / 180),
        ("1/deg", "1/rad", 180 / math.pi),
        ("cm", "m", 0.01),
        ("ft", "m", 0.3048),
        ("cm/s^2", "m/s^2", 0.01),
        ("g_0", "m/s^2", 9.80665),
        ("g", "kg", 1e-3),
        ("mN*m", "N*m", 1e-3),
        ("mNm", "N*m", 1e-3),
        ("kgf cm", "N*m", 0.0980665),
        ("kohm", "ohm", 1e3),
        ("%", "1", 0.01),
    ],
)
def test_gains(unit, target, gain):
    assert compute_unit_scale(unit, target).gain == pytest.approx(gain, rel=1e-12)
    assert compute_unit_scale(unit, target).offset == 0


@pytest.mark.parametrize(
    ("unit", "target"),
    [
        ("m/s²", "m/s^2"),
        ("m s**-2", "m/s^2"),
        ("N·m", "N*m"),
        ("Nm", "N*m"),
        ("kg m²/s²", "N*m"),
        ("Ω", "ohm"),
        ("(m)", "m"),
    ],
)
def test_other_ways_to_write_the_same(unit, target):
    assert compute_unit_scale(unit, target) is IDENTITY_SCALE


def test_an_offset_is_kept():
    assert compute_unit_scale("degC", "K") == (1.0, 273.15)


@pytest.mark.parametrize(
    ("unit", "target", "message"),
    [
        ("1", "rad", "expected a unit that converts to rad, found '1'"),
        ("rad", "1", "expected a unit that converts to 1, found 'rad'"),
        ("Hz", "rad/s", "expected a unit that converts to rad/s, found 'Hz'"),
        ("deg", "1", "expected a unit that converts to 1, found 'deg'"),
        ("g", "m/s^2", "found 'g'; standard gravity is g_0"),
        ("degC", "m", "expected a unit that converts to m"),
        ("dB", "1", "expected a unit that converts to 1 in proportion, found 'dB'"),
        ("furlongs_per", "m", "unknown unit 'furlongs_per'; expected one that converts to m"),
        ("", "1", "found ''"),
        ("2*m", "m", r"found '2\*m'"),
        ("9**9**9**9", "m", "expected a unit"),
        ("m**9**9**9**9", "m", "expected a unit"),
        ("m**999", "m", "expected a unit"),
        ("**2", "m", "expected a unit"),
        ("m *", "m", "expected a unit"),
        ("(" * 55, "m", "unknown unit"),
        ("m)(", "m", "unknown unit"),
        ("m " * 400, "m", "expected a unit"),
        ("__import__('os')", "m", "expected a unit"),
    ],
)
def test_what_is_no_unit_is_said_at_once(unit, target, message):
    compute_unit_scale("cm", "m")
    started = time.perf_counter()
    with pytest.raises(InputError, match=message):
        compute_unit_scale(unit, target)
    assert time.perf_counter() - started < 0.5


def test_si_units_need_no_library(monkeypatch):
    monkeypatch.setattr("sims.recording.unit_conversion._get_unit_registry", None)
    assert compute_unit_scale("N*m*s/rad^2", "N*m*s/rad^2") is IDENTITY_SCALE
