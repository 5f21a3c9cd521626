"""Make one fit with mujoco.sysid: `mujoco_sysid_fit.py MODEL.xml LOG.csv FREED...`.

Runs in a Python that has mujoco.sysid and prints the estimates as JSON. The recording is one of
examples/robot: runs 1 to 4 are fitted, 5 and 6 are held out, each begins with the arm hanging at
rest.
"""

import csv
import json
import sys
from pathlib import Path

import mujoco
import numpy as np
from absl import logging
from mujoco import sysid

HELD_OUT = ("5", "6")
JOINTS = ("shoulder", "elbow")
BODIES = ("upper_arm", "forearm")
START = {"damping": (1e-3, 2.0), "armature": (1e-4, 0.1), "frictionloss": (0.0, 0.5)}
"""Bounds of the free parameters of a joint, in SI units."""


def runs_of(path):
    """Return by run: times (T,), torques (T, 2), positions (T, 2)."""
    with path.open() as lines:
        rows = list(csv.reader(lines))[1:]
    names = dict.fromkeys(row[0] for row in rows)
    tables = {n: np.array([row[1:] for row in rows if row[0] == n], dtype=float) for n in names}
    return {n: (table[:, 0], table[:, 1:3], table[:, 3:5]) for n, table in tables.items()}


def freed(spec, what):
    """Return the free parameters, with initial values from the model file."""
    parameters = sysid.ParameterDict()
    for body in BODIES if "mass" in what else ():
        mass, inertia = float(spec.body(body).mass), np.array(spec.body(body).inertia)

        def set_mass(spec, parameter, body=body, per_mass=inertia / mass):
            spec.body(body).mass = parameter.value[0]
            spec.body(body).inertia = per_mass * parameter.value[0]

        bounds = (0.3 * mass, 3 * mass)
        parameters.add(sysid.Parameter(f"{body}_mass", mass, *bounds, modifier=set_mass))
    for field in (f for f in START if f in what):
        for joint in JOINTS:

            def set_field(spec, parameter, joint=joint, field=field):
                value = parameter.value[0] if field != "damping" else [parameter.value[0], 0, 0]
                setattr(spec.joint(joint), field, value)

            stated = float(np.ravel(getattr(spec.joint(joint), field))[0])
            parameters.add(
                sysid.Parameter(f"{joint}_{field}", stated, *START[field], modifier=set_field)
            )
    return parameters


def sequences(spec, model, runs):
    """Return the runs in the format of the toolbox; torques are held to the next sample."""
    every = round(0.01 / model.opt.timestep)
    controls, measured = [], []
    for times, torques, positions in runs.values():
        fine = times[0] + np.arange((len(times) - 1) * every + 1) * model.opt.timestep
        held = np.repeat(torques, every, axis=0)[: len(fine)]
        controls.append(sysid.TimeSeries.from_control_names(fine, held, model))
        names = [(f"{joint}_qpos", sysid.SignalType.MjStateQPos) for joint in JOINTS]
        measured.append(sysid.TimeSeries.from_names(times, positions, model, names=names))
    start = sysid.create_initial_state(model, np.zeros(2), np.zeros(2))
    return sysid.ModelSequences(
        "arm",
        spec,
        list(runs),
        [start] * len(runs),
        controls,
        measured,
        allow_missing_sensors=True,
    )


def errors(model, runs):
    """Return the RMS error of each joint over some runs, rad."""
    squares = []
    for _, torques, positions in runs.values():
        data = mujoco.MjData(model)
        simulated = [data.qpos.copy()]
        for torque in torques[:-1]:
            data.ctrl[:] = torque
            mujoco.mj_step(model, data, round(0.01 / model.opt.timestep))
            simulated.append(data.qpos.copy())
        squares.append((np.array(simulated) - positions) ** 2)
    return dict(zip(JOINTS, np.sqrt(np.mean(np.concatenate(squares), axis=0)), strict=True))


def main():
    logging.set_verbosity(logging.ERROR)
    path, log, *what = sys.argv[1:]
    spec = mujoco.MjSpec.from_file(path)
    model = spec.compile()
    runs = runs_of(Path(log))
    fitted = {name: run for name, run in runs.items() if name not in HELD_OUT}
    held_out = {name: run for name, run in runs.items() if name in HELD_OUT}
    parameters = freed(spec, what)
    parameters.move_off_bounds()
    residual = sysid.build_residual_fn(models_sequences=[sequences(spec, model, fitted)])
    best, result = sysid.optimize(parameters, residual, optimizer="mujoco", verbose=False)
    left, _, _ = residual(result.x, best, return_pred_all=True)
    _, widths = sysid.calculate_intervals(left, result.jac)
    tuned = sysid.apply_param_modifiers(best, spec)
    names = best.get_non_frozen_parameter_names()
    found = {
        name: {"value": float(value), "low": float(value - width), "high": float(value + width)}
        for name, value, width in zip(names, best.as_vector(), widths, strict=True)
    }
    print(
        json.dumps(
            {
                "found": found,
                "fitted_rmse": errors(tuned, fitted),
                "heldout_rmse": errors(tuned, held_out),
                "heldout_rmse_before": errors(model, held_out),
            }
        )
    )


if __name__ == "__main__":
    main()
