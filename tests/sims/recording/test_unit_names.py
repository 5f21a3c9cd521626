"""Tests of units in column names, as spreadsheets and loggers write them."""

import pytest

from sims.recording.log_formats.unit_names import read_unit, split_unit
from sims.recording.unit_conversion import compute_unit_scale

WITH_UNIT = {
    "q1 [deg]": ("q1", "deg"), "q1_deg": ("q1", "deg"), "pos (rad)": ("pos", "rad"),
    "Zeit [ms]": ("Zeit", "ms"), "t[s]": ("t", "s"), "elbow_soll [°]": ("elbow_soll", "deg"),
    "time_us": ("time", "us"), "v_rad_s": ("v", "rad/s"), "v_deg_per_s": ("v", "deg/s"),
    "qd1 [rad s^-1]": ("qd1", "rad/s"), "speed (U/min)": ("speed", "rpm"),
    "tau_Nm": ("tau", "N*m"), "tau1 / N*m": ("tau1", "N*m"), "Moment [N m]": ("Moment", "N*m"),
    "hip in deg": ("hip", "deg"), "hip, mrad": ("hip", "mrad"), "hipDeg": ("hip", "deg"),
    "slide {mm}": ("slide", "mm"), "i <mA>": ("i", "mA"), "acc [rad/s²]": ("acc", "rad/s^2"),
}  # fmt: skip
WITHOUT_UNIT = [
    "q[1]", "joint_m", "q_s", "motor_a", "elbow (left)", "%time", "field.position0", "deg", "_deg",
    "observation.state.elbow.pos", "/joint_states/position/base", "hip_ref", "q [17]",
]  # fmt: skip


@pytest.mark.parametrize("name", WITH_UNIT)
def test_a_unit_behind_a_name_is_split_off(name):
    split = split_unit(name)
    assert (split.name, split.unit) == WITH_UNIT[name]


@pytest.mark.parametrize("name", WITHOUT_UNIT)
def test_what_is_no_unit_stays_in_the_name(name):
    assert split_unit(name) == (name, "", None)


def test_every_unit_of_a_joint_converts():
    si = {"angle": "rad", "length": "m", "angular velocity": "rad/s", "velocity": "m/s",
          "torque": "N*m", "force": "N", "time": "s"}  # fmt: skip
    for text in ("deg", "turn", "mrad", "cm", "rpm", "rev/s", "mm/s", "Ncm", "kg*cm", "N", "us"):
        unit, quantity = read_unit(text)
        assert compute_unit_scale(unit, si[quantity]).gain > 0
