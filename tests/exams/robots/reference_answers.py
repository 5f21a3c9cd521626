"""The machine in plain MuJoCo, to test the reference world and to measure MuJoCo's numerics."""

from __future__ import annotations

import numpy as np


def compiled(machine, step=None, integrator=None):
    """Compile a MuJoCo model of the machine with its actuators."""
    import mujoco

    spec = mujoco.MjSpec.from_string(machine.urdf)
    spec.option.timestep = step or machine.step
    name = f"mjINT_{(integrator or machine.integrator).upper()}"
    spec.option.integrator = getattr(mujoco.mjtIntegrator, name)
    for drive in machine.drives:
        actuator = spec.add_actuator(name=drive.name, target=drive.joint)
        actuator.trntype = mujoco.mjtTrn.mjTRN_JOINT
        if drive.kind == "position":
            actuator.set_to_position(kp=drive.kp, kv=drive.kv)
        else:
            actuator.set_to_motor()
        actuator.forcerange = [-drive.force, drive.force]
        actuator.forcelimited = True
    return spec.compile()


def moved(machine, run, step=None, integrator=None):
    """Return positions and velocities (T, N) at the run's time stamps, multiples of the step."""
    import mujoco

    model = compiled(machine, step, integrator)
    data = mujoco.MjData(model)
    places = [model.joint(name).qposadr[0] for name in machine.joints]
    rates = [model.joint(name).dofadr[0] for name in machine.joints]
    data.qpos[places], data.qvel[rates] = run.q, run.v
    commands = np.array([run.commands[model.actuator(i).name] for i in range(model.nu)])
    rows, number = [], 0
    for k, t in enumerate(run.times.tolist()):
        while number < round(t / model.opt.timestep):
            mujoco.mj_step(model, data)
            number += 1
        rows.append((data.qpos[places].copy(), data.qvel[rates].copy()))
        data.ctrl[:] = commands[:, k]
    q, v = (np.array(part) for part in zip(*rows, strict=True))
    return q, v
