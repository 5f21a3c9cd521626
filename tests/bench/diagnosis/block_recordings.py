"""Recordings of a block that is pushed over a plane, made with plain MuJoCo."""

import mujoco
import numpy as np

from tests.bench.diagnosis.simulated_logs import describe, follow, write_log

BLOCK = """<mujoco model="block">
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody>
    <geom name="ground" type="plane" size="5 5 0.1"/>
    <body name="block" pos="0 0 0.05">
      <joint name="x" type="slide" axis="1 0 0" damping="0.5"/>
      <joint name="y" type="slide" axis="0 1 0" damping="0.5"/>
      <joint name="lift" type="slide" axis="0 0 1"/>
      <geom name="foot" type="box" size="0.08 0.06 0.05" mass="1.5" friction="0.6" priority="1"/>
    </body>
  </worldbody>
  <actuator>
    <position name="push_x" joint="x" kp="150" kv="10"/>
    <position name="push_y" joint="y" kp="150" kv="10"/>
    <motor name="press" joint="lift"/>
  </actuator>
</mujoco>
"""
OPTIONS = 'integrator="implicitfast"'
JOINTS = ("x", "y", "lift")
RATE, RUNS, NOISE = 100, 3, 1e-4
SETTLE_STEPS = 500


def write_block_recording(folder, options="", change=("", ""), samples=200):
    """Write the model file and a recording of the block with other options of the solver.

    Args:
        folder: folder to write to.
        options: options that the recorded simulator has in addition, such as ``cone="elliptic"``.
        change: text of the model file and of that of the recorded simulator.
        samples: number of samples of each run.

    Returns:
        Path of the recording. The initial states are stated; the last run is held out.
    """
    text = BLOCK.replace(OPTIONS, f"{OPTIONS} {options}")
    model = mujoco.MjModel.from_xml_string(text.replace(*change) if change[0] else text)
    rng, times, runs, tables = np.random.default_rng(0), np.arange(samples) / RATE, [], []
    for run in range(1, RUNS + 1):
        data = mujoco.MjData(model)
        mujoco.mj_step(model, data, nstep=SETTLE_STEPS)
        state = {f"q.{joint}": q for joint, q in zip(JOINTS, data.qpos.tolist(), strict=True)}
        state |= {f"qd.{joint}": v for joint, v in zip(JOINTS, data.qvel.tolist(), strict=True)}
        tables += [f"[runs.{run}.initial]", *(f'"{name}" = {x!r}' for name, x in state.items())]
        phases, frequencies = rng.uniform(0, 2 * np.pi, (2, 3)), rng.uniform(0.3, 1.2, (2, 3))
        amplitudes = rng.uniform(0.03, 0.08, (2, 3))
        waves = np.sin(2 * np.pi * frequencies * times[:, None, None] + phases)
        press = -8.0 + 5.0 * np.sin(4.4 * times + phases[0, 0])
        commands = np.column_stack([(amplitudes * waves).sum(axis=2), press])
        # The warm start of the solver is no part of the state that a log states.
        steps = round(1 / (RATE * model.opt.timestep))
        readings = follow(model, commands, steps, data.qpos, start_rates=data.qvel)
        runs.append((times, commands, readings + NOISE * rng.standard_normal(readings.shape)))
    units = {
        "u.push_x": "m",
        "u.push_y": "m",
        "u.press": "N",
        "q.x": "m",
        "q.y": "m",
        "q.lift": "m",
    }
    more = "\n".join([f"[runs.{RUNS}]", "held_out = true", *tables, ""])
    description = describe(units, NOISE, more, "block")
    return write_log(folder, description, ",".join(units), runs, block=BLOCK)
