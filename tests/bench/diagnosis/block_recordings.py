"""Recordings of a block that is pushed over a plane, made with plain MuJoCo."""

import mujoco
import numpy as np

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
    rng = np.random.default_rng(0)
    rows = ["run,t,u.push_x,u.push_y,u.press,q.x,q.y,q.lift"]
    tables = []
    for run in range(RUNS):
        data = mujoco.MjData(model)
        mujoco.mj_step(model, data, nstep=SETTLE_STEPS)
        start = np.concatenate([data.qpos, data.qvel])
        # The warm start of the solver is no part of the state that a log states.
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:] = start[:3], start[3:]
        names = [*(f"q.{joint}" for joint in JOINTS), *(f"qd.{joint}" for joint in JOINTS)]
        tables.append(f"[runs.r{run}.initial]")
        tables += [
            f'"{name}" = {value!r}' for name, value in zip(names, start.tolist(), strict=True)
        ]
        phases, frequencies = rng.uniform(0, 2 * np.pi, (2, 3)), rng.uniform(0.3, 1.2, (2, 3))
        amplitudes = rng.uniform(0.03, 0.08, (2, 3))
        for sample in range(samples):
            time = sample / RATE
            push = (amplitudes * np.sin(2 * np.pi * frequencies * time + phases)).sum(axis=1)
            command = [*push, -8.0 + 5.0 * np.sin(4.4 * time + phases[0, 0])]
            command = [float(f"{value:.7g}") for value in command]
            seen = data.qpos + NOISE * rng.standard_normal(3)
            numbers = ",".join([*map(repr, command), *(f"{value:.8f}" for value in seen)])
            rows.append(f"r{run},{time:.2f},{numbers}")
            data.ctrl[:] = command
            mujoco.mj_step(model, data, nstep=round(1 / (RATE * model.opt.timestep)))
    (folder / "block.xml").write_text(BLOCK)
    path = folder / "log.csv"
    path.write_text("\n".join(rows) + "\n")
    units = {"push_x": "m", "push_y": "m", "press": "N"}
    signals = [f'[inputs."u.{name}"]\nunit = "{unit}"' for name, unit in units.items()]
    signals += [f'[channels."q.{joint}"]\nunit = "m"\nnoise = {NOISE}' for joint in JOINTS]
    held_out = [f"[runs.r{RUNS - 1}]", "held_out = true"]
    path.with_suffix(".toml").write_text(
        "\n".join(['model = "block.xml"', *signals, *held_out, *tables, ""])
    )
    return path
