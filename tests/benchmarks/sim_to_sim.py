"""Causes that `explain` names where simulator A and the model file of B differ in one number.

``python -m tests.benchmarks.sim_to_sim`` simulates A with plain MuJoCo and prints one line for each
difference, the table of docs/sim-to-sim.md.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import mujoco
import numpy as np

import simgap
from tests.bench.diagnosis.block_recordings import OPTIONS, write_block_recording

MODEL_B = """<mujoco model="b">
  <compiler angle="radian" autolimits="true"/>
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody>
    <body name="upper" pos="0 0 0.5">
      <joint name="shoulder" axis="0 1 0" damping="0.3" armature="0.02"/>
      <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.03" mass="1.2" contype="0"/>
      <body name="fore" pos="0.3 0 0">
        <joint name="elbow" axis="0 1 0" damping="0.2" armature="0.01"/>
        <geom type="capsule" fromto="0 0 0 0.25 0 0" size="0.02" mass="0.6" contype="0"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position name="m_shoulder" joint="shoulder" kp="60" kv="4"/>
    <position name="m_elbow" joint="elbow" kp="30" kv="2"/>
  </actuator>
</mujoco>
"""
DIFFERENCES = {
    "damping": ('damping="0.2"', 'damping="0.5"'),
    "armature": ('armature="0.01"', 'armature="0.03"'),
    "integrator": (
        'timestep="0.002" integrator="implicitfast"',
        'timestep="0.0002" integrator="RK4"',
    ),
}
"""Text of the model file of B, and of that of A, by name of the difference."""
BLOCK_DIFFERENCES = {
    "cone": {"options": 'cone="elliptic"'},
    "impratio": {"options": 'impratio="20"'},
    "noslip": {"options": 'noslip_iterations="5"'},
    "integrator of the block": {"change": (OPTIONS, 'integrator="Euler"')},
    "solver": {"options": 'solver="PGS" iterations="3"'},
    "friction": {"change": ('friction="0.6"', 'friction="0.7"')},
}
"""Differences of the block on a plane, as arguments of `write_block_recording`."""
RUNS, SAMPLES, RATE, NOISE = 4, 300, 100, 2e-4
AMPLITUDES = np.array([0.4, 0.5])


def write_recording(folder: Path, text_a: str) -> Path:
    """Write the model file of B, and a recording of simulator A with its commands.

    Args:
        folder: folder to write to.
        text_a: model file of A.
    """
    (folder / "b.xml").write_text(MODEL_B)
    model = mujoco.MjModel.from_xml_string(text_a)
    data, rng = mujoco.MjData(model), np.random.default_rng(5)
    steps = round(1.0 / (RATE * model.opt.timestep))
    rows = ["run,t,u.m_shoulder,u.m_elbow,q.shoulder,q.elbow"]
    for run in range(RUNS):
        mujoco.mj_resetData(model, data)
        phases = rng.uniform(0.0, 2.0 * np.pi, (2, 2))
        frequencies = rng.uniform(0.3, 1.5, (2, 2))
        for sample in range(SAMPLES):
            angles = 2.0 * np.pi * frequencies * sample / RATE + phases
            command = AMPLITUDES * np.sin(angles).sum(axis=1)
            if sample == 0:
                data.qpos[:] = command
            seen = data.qpos + NOISE * rng.normal(size=2)
            numbers = ",".join(f"{value:.7f}" for value in (*command, *seen))
            rows.append(f"r{run},{sample / RATE:.2f},{numbers}")
            data.ctrl[:] = command
            for _ in range(steps):
                mujoco.mj_step(model, data)
    path = folder / "log.csv"
    path.write_text("\n".join(rows) + "\n")
    joints = ("shoulder", "elbow")
    signals = [f'[inputs."u.m_{joint}"]\nunit = "rad"' for joint in joints]
    signals += [f'[channels."q.{joint}"]\nunit = "rad"\nnoise = {NOISE}' for joint in joints]
    path.with_suffix(".toml").write_text(
        "\n".join(['model = "b.xml"', *signals, f"[runs.r{RUNS - 1}]", "held_out = true", ""])
    )
    return path


def main() -> None:
    """Print the verdict and the causes of each difference."""
    for name, (text_b, text_a) in DIFFERENCES.items():
        assert MODEL_B.count(text_b) == 1
        with tempfile.TemporaryDirectory() as folder:
            print_causes(name, write_recording(Path(folder), MODEL_B.replace(text_b, text_a)))
    for name, arguments in BLOCK_DIFFERENCES.items():
        with tempfile.TemporaryDirectory() as folder:
            print_causes(name, write_block_recording(Path(folder), **arguments))


def print_causes(name: str, path: Path) -> None:
    """Print the verdict on a recording and its causes."""
    verdict = simgap.explain(path).answer
    for cause in verdict.causes:
        values = [f"{number.value:.4g}" for number in cause.coefficients.values()]
        print(name, verdict.verdict, cause.effect, *values, "or", *cause.alternatives)


if __name__ == "__main__":
    main()
