"""Tests of recordings of a leg whose knee is driven by a rod, with unmeasured joints.

The rod is in the plane of the leg with a hinge at its end, or next to it with a ball joint at each
end, as in legs with springs; nothing measures its pose.
"""

import mujoco
import numpy as np
import pytest

from bench.diagnosis.explain import explain
from tests.bench.diagnosis.simulated_logs import describe, follow, write_log

LEG = """<mujoco model="leg">
  <compiler angle="radian"/>
  <option timestep="0.001" integrator="implicitfast"/>
  <default><geom type="capsule" contype="0" conaffinity="0"/></default>
  <worldbody>
    <body name="thigh" pos="0 0 1">
      <joint name="hip" axis="0 1 0" damping="0.05" armature="0.02"/>
      <geom fromto="0 0 0 0 0 -0.4" size="0.02" mass="1.5"/>
      <body name="shin" pos="0 0 -0.4">
        <joint name="knee" axis="0 1 0" damping="0.05" armature="0.01"/>
        <geom fromto="0 0 0 0.1 0 -0.35" size="0.015" mass="0.7"/>
      </body>
      <body name="crank" pos="0.02 0 -0.05">
        <joint name="crank" axis="0 1 0" damping="0.01" armature="0.005"/>
        <geom fromto="0 0 0 -0.06 0 0" size="0.008" mass="0.1"/>
        <body name="rod" pos="-0.06 0 0">
          <joint name="rod" axis="0 1 0" damping="0.001"/>
          <geom fromto="0 0 0 0 0 -0.35" size="0.006" mass="0.15"/>
        </body>
      </body>
    </body>
  </worldbody>
  <equality><connect body1="rod" body2="shin" anchor="0 0 -0.35" solref="0.004 1"/></equality>
  <actuator>
    <position name="m_hip" joint="hip" kp="150" kv="6"/>
    <position name="m_crank" joint="crank" kp="60" kv="2"/>
  </actuator>
</mujoco>
"""
HINGE = """<joint name="rod" axis="0 1 0" damping="0.001"/>
          <geom fromto="0 0 0 0 0 -0.35" size="0.006" mass="0.15"/>"""
BALL = """<joint name="rod" type="ball" damping="0.001"/>
          <geom fromto="0 0 0 0 0.04 -0.35" size="0.006" mass="0.15"/>"""
assert HINGE in LEG
BALL_LEG = LEG.replace(HINGE, BALL).replace('anchor="0 0 -0.35"', 'anchor="0 0.04 -0.35"')
NOISE = 3e-4
"""Standard deviation of the encoders in rad."""


def write_leg_log(folder, planted_damping, leg):
    """Write three runs of 3 s by plain MuJoCo; the encoders are at hip and crank alone."""
    rng, runs, times = np.random.default_rng(5), [], np.arange(301) / 100
    model = mujoco.MjModel.from_xml_string(leg)
    model.dof_damping[model.joint("knee").dofadr[0]] += planted_damping
    encoders = [model.joint(joint).qposadr[0] for joint in ("hip", "crank")]
    for _ in range(3):
        frequencies = rng.uniform((0.3, 0.7, 1.3), (0.7, 1.3, 2.5), (2, 3))
        phases = rng.uniform(0.0, 6.0, (2, 3))
        waves = np.sin(2 * np.pi * frequencies[..., None] * times + phases[..., None])
        commands = 0.3 * np.einsum("k,ukt->tu", (0.5, 0.3, 0.2), waves)
        positions = follow(model, commands, 10, settle=2000)[:, encoders]
        runs.append((times, commands, positions + NOISE * rng.standard_normal(positions.shape)))
    units = dict.fromkeys(("u.m_hip", "u.m_crank", "q.hip", "q.crank"), "rad")
    description = describe(units, NOISE, "[runs.3]\nheld_out = true\n", "leg")
    return write_log(folder, description, ",".join(units), runs, leg=leg)


@pytest.mark.slow
@pytest.mark.parametrize("leg", [LEG, BALL_LEG], ids=["hinge", "ball"])
def test_a_leg_with_a_rod_is_adequate(tmp_path, leg):
    assert explain(write_leg_log(tmp_path, 0.0, leg), jobs=1).answer.verdict == "adequate"


@pytest.mark.slow
@pytest.mark.parametrize("leg", [LEG, BALL_LEG], ids=["hinge", "ball"])
def test_a_damping_in_the_loop_is_found(tmp_path, leg):
    answer = explain(write_leg_log(tmp_path, 0.5, leg), jobs=1).answer
    (cause,) = answer.causes
    assert "drag.linear@knee" in (cause.effect, *cause.alternatives)
    if cause.effect == "drag.linear@knee":
        assert cause.coefficients["coefficient"].value == pytest.approx(0.5, rel=0.02)
    assert answer.verdict in ("named", "ambiguous")
