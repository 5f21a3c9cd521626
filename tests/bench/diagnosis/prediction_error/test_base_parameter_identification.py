"""Tests of free parameters of a robot that are identified together with a missing effect."""

import mujoco
import numpy as np
import pytest

from bench.diagnosis.explain import explain
from tests.bench.diagnosis.simulated_logs import describe, follow, write_log

LOAD, LOAD_POSITION = 0.5, (0.12, 0.0, 0.02)
"""Mass in kg of a load that the model file lacks, and its position in the last body in m."""
CENTRE = (0.075, 0.0, 0.0)
"""Centre of mass of the last body in m, from which positions of payloads are counted."""
NOISE = 5e-4
"""Standard deviation of the encoders' noise in rad."""
RUNS, SECONDS, RATE = 4, 3.0, 50
"""Number of runs, and duration in seconds and samples per second of each."""


def arm(load=""):
    """Return the MJCF of an arm with three servos.

    Args:
        load: a body in the last link; empty for none.
    """
    links = "".join(
        f'<body name="l{i}" pos="{0.15 if i else 0.0} 0 {0.0 if i else 0.1}">'
        f'<joint name="j{i}" axis="{"0 1 0" if i else "0 0 1"}" armature="0.02" damping="0.05"/>'
        '<geom type="capsule" size="0.015" fromto="0 0 0 0.15 0 0" mass="0.3"/>'
        for i in range(3)
    )
    servos = "".join(f'<position name="m{i}" joint="j{i}" kp="20" kv="1"/>' for i in range(3))
    return (
        '<mujoco><option timestep="0.002" integrator="implicitfast"/><default><geom contype="0"'
        f' conaffinity="0"/></default><worldbody>{links}{load}{"</body>" * 3}</worldbody>'
        f"<actuator>{servos}</actuator></mujoco>"
    )


def record(model, rng):
    """Return one run, with commands that move to another angle about once a second."""
    times = np.arange(0.0, SECONDS, 1.0 / RATE)
    angles = rng.uniform(-0.6, 0.6, (8, 3))
    steps = angles[np.searchsorted(np.cumsum(rng.uniform(0.5, 1.0, 7)), times, side="right")]
    padded = np.vstack([np.repeat(steps[:1], 9, axis=0), steps])
    commands = np.stack([np.convolve(c, np.ones(10) / 10, "valid") for c in padded.T], axis=1)
    readings = follow(model, commands, 10, start=commands[0], settle=2000)
    return times, readings + rng.normal(0.0, NOISE, readings.shape), commands


@pytest.mark.slow(seconds=12)
def test_a_payload_is_found_although_the_gains_of_all_servos_are_free(tmp_path):
    """Smaller gains alone would explain much of the sag and of the slower motion."""
    position = " ".join(map(str, LOAD_POSITION))
    load = f'<body pos="{position}"><geom type="sphere" size="0.02" mass="{LOAD}"/></body>'
    model, rng = mujoco.MjModel.from_xml_string(arm(load)), np.random.default_rng(3)
    units = dict.fromkeys([f"{name}{i}" for name in ("q.j", "u.m") for i in range(3)], "rad")
    free = 'free = ["actuator.stiffness@*", "actuator.damping@*"]\n'
    description = free + describe(units, NOISE, f"[runs.{RUNS}]\nheld_out = true\n")
    runs = [record(model, rng) for _ in range(RUNS)]
    path = write_log(tmp_path, description, ",".join(units), runs, arm=arm())
    answer = explain(path).answer
    (cause,) = answer.causes
    assert cause.effect == "payload@l2"
    assert cause.coefficients["mass"].value == pytest.approx(LOAD, rel=0.03)
    found = np.array([cause.coefficients[axis].value for axis in "xyz"])
    np.testing.assert_allclose(found + CENTRE, LOAD_POSITION, atol=0.004)
    for i in range(3):
        for gain in ("stiffness", "damping"):
            assert abs(answer.parameters[f"actuator.{gain}@m{i}"].value) < 0.02
    assert answer.heldout.rmse_extended < 1.1 * NOISE
