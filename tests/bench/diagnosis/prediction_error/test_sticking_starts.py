"""Test that explain finds dry friction where runs begin with a joint that sticks.

Plain MuJoCo makes the motion. The first reading of the joint is wrong by several standard
deviations, and the joint keeps the position from which it is simulated, so that this error stays in
the residual until the joint moves.
"""

import mujoco
import numpy as np

from bench.diagnosis.explain import explain

NOISE, TORQUE_NOISE, PLANTED, STEP = 5e-4, 0.05, 1.5, 0.002
STIFF = 'solreffriction="0.004 1" solimpfriction="0.9999 0.9999 0.001"'
"""Parameters of the stiff form for 2 ms steps of `implicitfast`."""
ARM = """
<mujoco model="arm">
  <compiler angle="radian" autolimits="true"/>
  <option timestep="0.002" integrator="implicitfast"/>
  <default><geom contype="0" conaffinity="0"/></default>
  <worldbody>
    <body name="upper" pos="0 0 1">
      <inertial pos="0.12 0 0" mass="0.9" diaginertia="0.002 0.006 0.006"/>
      <joint name="shoulder" axis="0 1 0" damping="0.2" armature="0.02" range="-2 2" {friction}/>
      <body name="hand" pos="0.25 0 0">
        <inertial pos="0.02 0 0" mass="0.1" diaginertia="0.0001 0.0002 0.0002"/>
        <joint name="wrist" axis="0 1 0" damping="0.01" armature="0.001" range="-2 2"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position name="s1" joint="shoulder" kp="400" kv="12"/>
    <position name="s2" joint="wrist" kp="3" kv="0.3"/>
  </actuator>
</mujoco>
"""
LOG = "".join(
    ['model = "arm.xml"\n']
    + [f'[channels."q.{j}"]\nunit = "rad"\nnoise = {NOISE}\n' for j in ("shoulder", "wrist")]
    + [f'[channels."tau.shoulder"]\nunit = "N*m"\nnoise = {TORQUE_NOISE}\n']
    + [f'[inputs."u.{m}"]\nunit = "rad"\n' for m in ("s1", "s2")]
    + ["[runs.4]\nheld_out = true\n"]
)


def write_recording(folder):
    """Write a log of four runs of 2 s that begin with 0.5 s of rest; return its path."""
    rng = np.random.default_rng(5)
    loss = f'frictionloss="{PLANTED}" {STIFF}'
    model = mujoco.MjModel.from_xml_string(ARM.format(friction=loss))
    times = STEP * np.arange(1001)
    rows = ["run,t,u.s1,u.s2,q.shoulder,q.wrist,tau.shoulder"]
    for run in (1, 2, 3, 4):
        moving = np.maximum(times - 0.5, 0.0)[:, None]
        rates = rng.uniform(3, 7, 2)
        commands = 0.2 + np.array([0.15, 0.4]) * np.sin(moving * rates)
        # Each command is held for five steps, until the next row.
        commands = np.repeat(commands[::5], 5, axis=0)[: times.size]
        data = mujoco.MjData(model)
        data.qpos[:] = commands[0]
        states = np.empty((times.size, 3))
        for i, command in enumerate(commands):
            states[i, :2] = data.qpos
            data.ctrl[:] = command
            mujoco.mj_step(model, data)
            # MuJoCo computes this force at the beginning of the step.
            states[i, 2] = data.actuator_force[0]
        sigma = np.array([NOISE, NOISE, TORQUE_NOISE])
        readings = states + sigma * rng.standard_normal(states.shape)
        readings[0, 0] = states[0, 0] + 3.5 * NOISE * (-1) ** run
        for t, u, q in list(zip(times, commands, readings, strict=True))[::5]:
            rows.append(f"{run},{t:.3f},{u[0]:.9f},{u[1]:.9f},{q[0]:.7f},{q[1]:.7f},{q[2]:.5f}")
    (folder / "arm.xml").write_text(ARM.format(friction=""))
    (folder / "log.csv").write_text("\n".join(rows) + "\n")
    (folder / "log.toml").write_text(LOG)
    return folder / "log.csv"


def test_friction_is_found_although_first_readings_of_a_sticking_joint_are_wrong(tmp_path):
    result = explain(write_recording(tmp_path))
    assert result.verdict == "named"
    (cause,) = result.causes
    assert cause.effect == "friction.coulomb@shoulder"
    assert abs(cause.coefficients["coefficient"].value / PLANTED - 1) < 0.02
