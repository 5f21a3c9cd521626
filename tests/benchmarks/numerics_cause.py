"""Measure the errors of MuJoCo's step, integrator and dry friction: tables for docs/engines.md.

Run: `OMP_NUM_THREADS=1 python -m tests.benchmarks.numerics_cause`. Models: the arm of
examples/robot, with its motors or with position servos, and the KUKA iiwa of pybullet_data with
position servos of natural frequency w: kp = w² M, kv = 2 w M with M the joint's own inertia at the
pose. Commands are sines of 0.2 to 1.5 Hz, held for 10 ms. Errors are root mean squares over
samples, joints and runs of 4 s, in mrad. The reference is RK4 at 0.2 ms. For dry friction, the
reference is the example's own integrator, and the error of the model without friction is
subtracted.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from time import process_time

import mujoco
import numpy as np
import pybullet_data
from mujoco import rollout

from sims.robot.parsing.read_model_file import read_robot
from tests.example_logs import robot_arm

ROOT = Path(__file__).resolve().parents[2]
ARM = ROOT / "examples" / "robot" / "arm2.xml"
IIWA = Path(pybullet_data.getDataPath()) / "kuka_iiwa" / "model.urdf"
POSE = np.array([0, 0.5, 0, -1.2, 0, 0.8, 0])
RATE, SECONDS, RUNS = 100, 4, 3
REFERENCE = ("RK4", 0.0002)
INTEGRATORS = {
    "Euler": mujoco.mjtIntegrator.mjINT_EULER,
    "implicitfast": mujoco.mjtIntegrator.mjINT_IMPLICITFAST,
    "RK4": mujoco.mjtIntegrator.mjINT_RK4,
}
STEPS = (0.002, 0.001, 0.0005, 0.0002)
SOLVED = (0.9999, 0.9999, 0.001, 0.5, 2.0)
FRICTIONS = {
    "default": lambda step: ((0.02, 1), (0.9, 0.95, 0.001, 0.5, 2)),
    "0.002 s, 0.99": lambda step: ((0.002, 1), (0.99, 0.99, 0.001, 0.5, 2)),
    "two steps, 0.9999": lambda step: ((2 * step, 1), SOLVED),
    "rate of 2.5 a step, 0.9999": lambda step: ((-1e-9, -2.5 / step), SOLVED),
    "rate of 4 a step, 0.9999": lambda step: ((-1e-9, -4 / step), SOLVED),
}
"""Functions from the step to solreffriction and solimpfriction."""


def served(path, pose, frequency):
    """Return a model whose joints are driven by critically damped position servos."""
    spec = read_robot(path).spec.copy()
    for actuator in list(spec.actuators):
        spec.delete(actuator)
    model = spec.compile()
    data = mujoco.MjData(model)
    data.qpos[:] = pose
    mujoco.mj_forward(model, data)
    inertias = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, inertias)
    for i, inertia in enumerate(np.diag(inertias)):
        servo = spec.add_actuator(target=model.joint(i).name)
        servo.trntype = mujoco.mjtTrn.mjTRN_JOINT
        servo.biastype = mujoco.mjtBias.mjBIAS_AFFINE
        servo.gainprm[0] = frequency**2 * inertia
        servo.biasprm[1:3] = -(frequency**2) * inertia, -2 * frequency * inertia
    return spec.compile()


def commands(count, run, amplitude):
    """Return sums of four sines, (T, count)."""
    rng = np.random.default_rng([18, run])
    time = np.arange(RATE * SECONDS) / RATE
    phases = rng.uniform(0.2, 1.5, (count, 4, 1)) * time + rng.uniform(size=(count, 4, 1))
    return amplitude / 2 * np.sin(2 * np.pi * phases).sum(axis=1).T


def moved(model, integrator, step, initial, controls):
    """Return positions at the samples (T, nq), and ms of processor time per simulated second."""
    model.opt.integrator, model.opt.timestep = INTEGRATORS[integrator], step
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    data = mujoco.MjData(model)
    data.qpos[:] = initial
    kind = mujoco.mjtState.mjSTATE_FULLPHYSICS
    state = np.zeros((1, mujoco.mj_stateSize(model, kind)))
    mujoco.mj_getState(model, data, state[0], kind)
    each = round(1 / RATE / step)
    begun = process_time()
    states, _ = rollout.rollout(model, data, state, np.repeat(controls[:-1], each, axis=0)[None])
    spent = process_time() - begun
    positions = np.vstack([initial, states[0, each - 1 :: each, 1 : 1 + model.nq]])
    return positions, 1e3 * spent / (len(controls) - 1) * RATE


def rms(differences):
    """Return the root mean square in mrad."""
    return 1e3 * float(np.sqrt(np.mean(np.square(differences))))


def shift(errors, fine):
    """Return the time shift of a motion, and the share of the squared error that it explains."""
    error, rate = np.stack(errors), np.gradient(np.stack(fine), 1 / RATE, axis=1)
    seconds = np.sum(error * rate) / np.sum(rate**2)
    share = 1 - np.sum((error - seconds * rate) ** 2) / np.sum(error**2)
    return f"{1e3 * seconds:+.2f} ms ({100 * share:.0f} %)"


def smooth_cases():
    """Yield by name a model and its runs: initial positions and commands."""
    motors = read_robot(ARM).spec.compile()
    arm = [(np.zeros(2), robot_arm.torques_of(run)) for run in robot_arm.RUNS[:RUNS]]
    yield "arm2, motors", motors, arm
    for frequency in (20, 60):
        held = [commands(2, run, 0.6) for run in range(RUNS)]
        model = served(ARM, np.zeros(2), frequency)
        yield f"arm2, servos of {frequency} rad/s", model, [(u[0], u) for u in held]
    for frequency in (20, 60, 150):
        held = [POSE + commands(7, run, 0.4) for run in range(RUNS)]
        model = served(IIWA, POSE, frequency)
        yield f"iiwa, servos of {frequency} rad/s", model, [(u[0], u) for u in held]


def smooth():
    """Print the table of steps and integrators, with the extrapolation from two steps."""
    head = [f"{name} {1e3 * step:g}" for name in INTEGRATORS for step in STEPS]
    print("| model | " + " | ".join(head[:-1]) + " | implicitfast 2 and 1 extrapolated |")
    print("|---|" + "---|" * len(head))
    cost, early = [], []
    for name, model, runs in smooth_cases():
        fine = [moved(model, *REFERENCE, *run)[0] for run in runs]
        cells, kept = [], {}
        for integrator in INTEGRATORS:
            for step in STEPS:
                if (integrator, step) == REFERENCE:
                    continue
                done = [moved(model, integrator, step, *run) for run in runs]
                kept[integrator, step] = [positions for positions, _ in done]
                errors = [p - f for p, f in zip(kept[integrator, step], fine, strict=True)]
                cells.append(f"{rms(errors):.2g}")
                if step == STEPS[0]:
                    milliseconds = np.median([spent for _, spent in done])
                    cost.append(f"{name}: {integrator} {milliseconds:.1f}")
                    early.append(f"{name}: {integrator} {shift(errors, fine)}")
        pairs = zip(kept["implicitfast", 0.001], kept["implicitfast", 0.002], fine, strict=True)
        cells.append(f"{rms([2 * half - whole - f for half, whole, f in pairs]):.2g}")
        print(f"| {name} | " + " | ".join(cells) + " |", flush=True)
    print("ms of processor time a simulated second at 2 ms: " + ", ".join(cost))
    print("as a shift in time at 2 ms: " + ", ".join(early))


def friction():
    """Print the table of MuJoCo's dry friction at the arm's elbow."""
    model = read_robot(ARM).spec.compile()
    default = model.dof_solref[1].copy(), model.dof_solimp[1].copy()
    columns = [(name, step) for name in ("Euler", "RK4") for step in (0.002, 0.0005)]
    print("\n| friction, N m | setting | " + " | ".join(f"{n} {1e3 * s:g}" for n, s in columns))
    print("|---|---|" + "---|" * len(columns))
    runs = [(np.zeros(2), robot_arm.torques_of(run)) for run in robot_arm.RUNS[:RUNS]]
    clean = [robot_arm.Arm().simulate(np.zeros(4), torques) for _, torques in runs]
    for limit in (0.03, 0.15, 0.5):
        arm = replace(robot_arm.Arm(), friction=limit)
        true = [arm.simulate(np.zeros(4), torques) for _, torques in runs]
        still = np.mean([np.abs(np.diff(positions[:, 1])) < 1e-9 for positions in true])
        for name, setting in FRICTIONS.items():
            cells = []
            for integrator, step in columns:
                effects = []
                for run, with_it, without in zip(runs, true, clean, strict=True):
                    model.dof_frictionloss[1] = 0.0
                    model.dof_solref[1], model.dof_solimp[1] = default
                    plain = moved(model, integrator, step, *run)[0]
                    model.dof_frictionloss[1] = limit
                    model.dof_solref[1], model.dof_solimp[1] = setting(step)
                    rubbed = moved(model, integrator, step, *run)[0]
                    effects.append(rubbed - plain - (with_it - without))
                cells.append(f"{rms(effects):.2g}")
            says = f"{limit} (stands {100 * still:.0f} %) | {name}"
            print(f"| {says} | " + " | ".join(cells) + " |", flush=True)


CREEPER = """<mujoco><option timestep="0.002" gravity="0 0 0"/><worldbody><body>
<inertial pos="0 0 0" mass="1" diaginertia="0.02 0.02 0.02"/>
<joint name="joint" type="hinge" axis="0 1 0" frictionloss="0.5"/></body></worldbody>
<actuator><motor joint="joint"/></actuator></mujoco>"""


def creep():
    """Print the drift in 4 s of a joint that should stick, pushed with 80 % of its friction."""
    for name, setting in FRICTIONS.items():
        model = mujoco.MjModel.from_xml_string(CREEPER)
        model.dof_solref[0], model.dof_solimp[0] = setting(model.opt.timestep)
        moves = moved(model, "Euler", 0.002, np.zeros(1), np.full((RATE * SECONDS, 1), 0.4))[0]
        print(f"creep, {name}: {1e3 * moves[-1, 0]:.2g} mrad")


if __name__ == "__main__":
    smooth()
    friction()
    sys.exit(creep())
