"""Test that a cause is found in a log of a servo in which rows are lost.

Plain MuJoCo makes the motion. A command that is held over a lost row acts an interval late.
"""

import mujoco
import numpy as np
import pytest

from bench.diagnosis.explain import explain
from tests.exams.robot_files import write_robot_recording

NOISE = 3e-4
PLANTED = 2.0


def link(damping):
    """Return the MJCF text of a link with a stiff position servo."""
    return (
        '<mujoco model="link"><option timestep="0.002" integrator="implicitfast"/><worldbody>'
        f'<body name="link"><joint name="hinge" axis="0 1 0" damping="{damping}" armature="0.05"/>'
        '<inertial pos="0 0 -0.2" mass="2" diaginertia="0.03 0.03 0.003"/></body></worldbody>'
        '<actuator><position name="servo" joint="hinge" kp="400" kv="20"/></actuator></mujoco>'
    )


def explain_lossy_log(folder, damping, is_held=False):
    """Explain a log of three runs with lost rows; return the explanation and the messages.

    Args:
        folder: folder of the log.
        damping: planted damping in N m s/rad.
        is_held: whether the controller sent no command where a row is lost.
    """
    model, rng = mujoco.MjModel.from_xml_string(link(damping)), np.random.default_rng(2)
    times, runs, lines = 0.01 * np.arange(301), {}, []
    for run in ("1", "2", "3"):
        data = mujoco.MjData(model)
        phases, rates = rng.uniform(0, 6.3, 4), rng.uniform(2, 15, 4)
        signal = np.sin(np.outer(times, rates) + phases) - np.sin(phases)
        commands, readings = 0.3 * signal.sum(1)[:, None], np.zeros((301, 1))
        kept = (rng.random(times.size) > 0.08) | (times == 0)
        for k in range(times.size):
            if is_held and not kept[k]:
                commands[k] = commands[k - 1]
            readings[k] = data.qpos + NOISE * rng.standard_normal()
            data.ctrl[:] = commands[k] = float(f"{commands[k, 0]:.9g}")
            mujoco.mj_step(model, data, 5)
        runs[run] = (run == "3", times[kept], commands[kept], readings[kept])
    log = write_robot_recording(
        folder, "log", {"u.servo": "rad"}, {"q.hinge": ("rad", NOISE)}, runs,
        ("link.xml", link(0.0)),
    )  # fmt: skip
    return explain(log, say=lines.append), lines


@pytest.mark.parametrize("is_held", [False, True])
def test_lost_rows_are_no_cause(tmp_path, is_held):
    found, lines = explain_lossy_log(tmp_path, 0.0, is_held)
    assert any("are lost are interpolated" in line for line in lines) != is_held
    assert found.verdict == "adequate"


def test_lost_rows_hide_no_cause(tmp_path):
    found, _ = explain_lossy_log(tmp_path, PLANTED)
    # The damping of the servo is the same force.
    (cause,) = found.causes
    assert {cause.effect, *cause.alternatives} == {"drag.linear@hinge", "actuator.damping@servo"}
    (number,) = cause.coefficients.values()
    expected = PLANTED / (20.0 if cause.effect == "actuator.damping@servo" else 1.0)
    assert number.value == pytest.approx(expected, rel=0.02)
