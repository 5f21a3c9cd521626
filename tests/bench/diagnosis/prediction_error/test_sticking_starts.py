"""Test that explain finds dry friction where runs begin with a joint that sticks.

Plain MuJoCo makes the motion. The first reading of the joint is wrong by several standard
deviations, and the joint keeps the position from which it is simulated, so that this error stays in
the residual until the joint moves.
"""

import mujoco
import numpy as np

from bench.diagnosis.explain import explain
from tests.bench.diagnosis.prediction_error.test_late_commands import ARM as SOFT_SERVO_ARM
from tests.bench.diagnosis.simulated_logs import describe, follow, write_log

PLANTED, STEP, KP, KV = 1.5, 0.002, 400.0, 12.0
ARM = SOFT_SERVO_ARM.replace('kp="60" kv="4"', f'kp="{KP}" kv="{KV}"')
UNITS = dict.fromkeys(("u.s1", "u.s2", "q.shoulder", "q.wrist"), "rad") | {"tau.shoulder": "N*m"}
NOISE = {"q.shoulder": 5e-4, "q.wrist": 5e-4, "tau.shoulder": 0.05}


def write_recording(folder):
    """Write a log of four runs of 2 s that begin with 0.5 s of rest; return its path."""
    rng, runs = np.random.default_rng(5), []
    model = mujoco.MjModel.from_xml_string(ARM)
    model.dof_frictionloss[0] = PLANTED
    # The stiff form for 2 ms steps of `implicitfast`.
    model.dof_solref[0], model.dof_solimp[0, :3] = (0.004, 1.0), (0.9999, 0.9999, 0.001)
    times = STEP * np.arange(1001)
    sigma = np.array(list(NOISE.values()))
    for sign in (-1.0, 1.0, -1.0, 1.0):
        moving = np.maximum(times - 0.5, 0.0)[:, None]
        commands = 0.2 + np.array([0.15, 0.4]) * np.sin(moving * rng.uniform(3, 7, 2))
        # Each command is held for five steps, until the next row.
        commands = np.repeat(commands[::5], 5, axis=0)[: times.size]
        velocities = []
        q = follow(
            model,
            commands,
            1,
            start=commands[0],
            act=lambda data, read=velocities: read.append(data.qvel[0]),
        )
        torque = KP * (commands[:, 0] - q[:, 0]) - KV * np.array(velocities)
        readings = np.column_stack([q, torque]) + sigma * rng.standard_normal((times.size, 3))
        readings[0, 0] = q[0, 0] + 3.5 * sigma[0] * sign
        runs.append((times[::5], commands[::5], readings[::5]))
    description = describe(UNITS, NOISE, "[runs.4]\nheld_out = true\n")
    return write_log(folder, description, ",".join(UNITS), runs, arm=ARM)


def test_friction_is_found_although_first_readings_of_a_sticking_joint_are_wrong(tmp_path):
    result = explain(write_recording(tmp_path))
    assert result.verdict == "named"
    (cause,) = result.causes
    assert cause.effect == "friction.coulomb@shoulder"
    assert abs(cause.coefficients["coefficient"].value / PLANTED - 1) < 0.02
