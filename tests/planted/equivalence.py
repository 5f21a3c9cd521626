"""Whether another cause follows the held-out run as well as the planted one.

The cause is put into plain MuJoCo, its coefficients are fitted to the runs for fitting (with the
true initial states), and its error on the held-out run is compared with the error of the planted
cause. A cause that plain MuJoCo cannot express has no result.
"""

from __future__ import annotations

import mujoco
import numpy as np

from tests.planted.items import rms
from tests.planted.motion import HELD_OUT, RATE, RUNS, SAMPLES, Change, Run, Simulator

MAX_STEPS = 12  # Gauss-Newton steps
STEP = 1e-3  # finite difference, in units of the scaled coefficient
CONVERGED = 1e-4  # scaled step that ends the fit


def held_out_ratios(item, names):
    """Held-out error of causes as a multiple of the planted cause's; None where not expressible.

    Args:
        item: with the planted cause.
        names: of causes, effect@place or effect@*.
    """
    comparison = _Comparison(item)
    return {name: comparison.ratio(name) for name in names}


class _Comparison:
    def __init__(self, item):
        self.experiment = item.experiment
        self.runs, states = item.truth
        self.measured = item.measured()
        truth = self.experiment.channels(states[HELD_OUT])
        self.truth_error = rms((self.measured[HELD_OUT] - truth) / self.experiment.sigma)

    def ratio(self, name):
        effect, _, place = name.partition("@")
        if effect not in EQUAL_FORMS:
            return None
        places = self._places(effect, place)
        if not places:
            return None
        return (
            min(self._held_out_error(form, places) for form in EQUAL_FORMS[effect])
            / self.truth_error
        )

    def _places(self, effect, place):
        model = self.experiment.model
        every = {
            "joint": self.experiment.joints,
            "body": [model.body(b).name for b in self.experiment.bodies],
            "actuator": [model.actuator(i).name for i in range(model.nu)],
            "channel": [f"q.{joint}" for joint in self.experiment.joints],
            "world": [""],
        }[PLACES[effect]]
        return every if place == "*" else [p for p in every if p == place]

    def _held_out_error(self, form, places):
        """Fit the coefficients, one a place, and return the error on the held-out run."""
        scales = np.array([form.scale(self.experiment, place) for place in places])
        numbers = np.zeros(len(places))
        fitted = [name for name in RUNS if name != HELD_OUT]
        damping, error = 1e-3, None

        def residual(numbers, names=fitted):
            coefficients = dict(zip(places, numbers * scales, strict=True))
            return np.concatenate(
                [
                    ((self.measured[n] - form.simulate(self.experiment, coefficients, self.runs[n]))
                     / self.experiment.sigma).ravel()
                    for n in names
                ]
            )  # fmt: skip

        now = residual(numbers)
        error = now @ now
        for _ in range(MAX_STEPS):
            columns = []
            for index in range(len(places)):
                moved = numbers.copy()
                moved[index] += STEP
                columns.append((residual(moved) - now) / STEP)
            jacobian = np.stack(columns, axis=1)
            normal, gradient = jacobian.T @ jacobian, jacobian.T @ now
            for _ in range(8):  # Levenberg-Marquardt
                step = -np.linalg.solve(
                    normal + damping * np.diag(np.diag(normal) + 1e-12), gradient
                )
                trial = np.maximum(numbers + step, form.lowest(self.experiment, places) / scales)
                trial_residual = residual(trial)
                trial_error = trial_residual @ trial_residual
                if np.isfinite(trial_error) and trial_error <= error:
                    damping /= 5
                    break
                damping *= 8
            else:
                break
            moved = np.abs(trial - numbers).max()
            numbers, now, error = trial, trial_residual, trial_error
            if moved < CONVERGED:
                break
        return rms(residual(numbers, [HELD_OUT]))


class _Form:
    """A cause in plain MuJoCo.

    Args:
        edit: (model, place, coefficient), changes the compiled model.
        force: (coefficient, position, velocity), generalised force at a joint.
        command: (coefficient, commands (SAMPLES,)), changes what an actuator receives.
        reading: (coefficient, positions (SAMPLES,)), changes what a sensor shows.
        unit: name of the scale, see `scale`.
        is_stiff: whether frictionloss of the place is as stiff as simgap writes it.
    """

    def __init__(self, unit, edit=None, force=None, command=None, reading=None, at_least=None):
        self.unit, self.edit, self.force = unit, edit, force
        self.command, self.reading, self.at_least = command, reading, at_least

    def scale(self, experiment, place):
        """A plausible size of the coefficient, which the fit begins with."""
        if self.unit == "ratio":
            return 0.1
        if self.unit == "time":
            return 1.0 / RATE
        if self.unit == "angle":
            return 0.01
        model = experiment.model
        torque = max(float(experiment.nominal_peaks.max()) * 0.05, 1e-6)
        if self.unit == "torque":
            return torque
        if self.unit == "viscous":
            return torque / 1.0
        dof = model.joint(place).dofadr[0]
        return max(float(experiment.nominal_inertia[dof]) * 0.3, 1e-9)  # inertia

    def lowest(self, experiment, places):
        """Lowest coefficients that are physical."""
        if self.at_least is None:
            return np.full(len(places), -np.inf)
        return np.array([self.at_least(experiment.model, place) for place in places])

    def simulate(self, experiment, coefficients, run):
        """Channels (SAMPLES, C) with the cause."""
        model = experiment.robot.compile(experiment.force_limits)
        commands = run.commands.copy()
        for place, value in coefficients.items():
            if self.edit is not None:
                self.edit(model, place, value)
            if self.command is not None:
                index = model.actuator(place).id
                commands[:, index] = self.command(value, commands[:, index])
        if self.edit is not None:
            mujoco.mj_setConst(model, mujoco.MjData(model))
        if self.force is not None:
            states = self._forced(model, experiment, coefficients, commands, run)
        else:
            simulator = Simulator(model, experiment.bodies)
            states = simulator.simulate(Run(commands, run.positions, run.velocities))
        channels = experiment.channels(states).copy()
        if self.reading is not None:
            for place, value in coefficients.items():
                column = experiment.joints.index(place.partition(".")[2])
                channels[:, column] = self.reading(value, channels[:, column])
        return channels

    def _forced(self, model, experiment, coefficients, commands, run):
        """Simulate with an additional generalised force that is evaluated at each step."""
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:] = run.positions, run.velocities
        joints = [(model.joint(p).qposadr[0], model.joint(p).dofadr[0]) for p in coefficients]
        steps = round(1 / RATE / model.opt.timestep)
        states = np.empty((SAMPLES, model.nq + model.nv))
        for sample in range(SAMPLES):
            states[sample] = np.concatenate([data.qpos, data.qvel])
            data.ctrl[:] = commands[sample]
            for _ in range(steps):
                for value, (position, dof) in zip(coefficients.values(), joints, strict=True):
                    data.qfrc_applied[dof] = self.force(value, data.qpos[position], data.qvel[dof])
                mujoco.mj_step(model, data)
        return states


def _planted(kind, unit, at_least=None):
    return _Form(unit, edit=lambda m, p, c: Change(kind, p, c).apply(m), at_least=at_least)


def _stiff_friction(model, place, value):
    """Dry friction with the solver settings of stiff friction (solreffriction, solimpfriction)."""
    dof = model.joint(place).dofadr[0]
    model.dof_frictionloss[dof] += value
    model.dof_solref[dof] = [-1e-9, -1250]
    model.dof_solimp[dof] = [0.9999, 0.9999, 0.001, 0.5, 2]


def _servo_damping(model, place, value):
    model.actuator_biasprm[model.actuator(place).id, 2] *= 1 + value


def _joint_spring(model, place, value):
    model.jnt_stiffness[model.joint(place).id] += value


def _inertia_scale(model, place, value):
    model.body_inertia[model.body(place).id] *= 1 + value


def _gravity_scale(model, _, value):
    model.opt.gravity[:] *= 1 + value


def _mass_offset(axis):
    def edit(model, place, value):
        model.body_ipos[model.body(place).id, axis] += value

    return edit


def _delayed(value, column):
    """A signal that is late by a time, linear between samples."""
    times = np.arange(column.size) / RATE
    return np.interp(times - value, times, column)


def _held_delayed(value, column):
    """A held command that is late by a time: the blend of two samples approximates it."""
    return _delayed(value, column)


def _lagged(value, column):
    """First-order lag with a time constant (at least a thousandth of a second)."""
    blend = 1 - np.exp(-1 / RATE / max(value, 1e-3))
    result, state = np.empty_like(column), column[0]
    for index, wanted in enumerate(column):
        state += blend * (wanted - state)
        result[index] = state
    return result


def _stated(field):
    """The lowest difference of a number of a joint: what makes it zero."""
    return lambda model, place: -float(getattr(model, field)[model.joint(place).dofadr[0]])


def _above_minus_one(model, place):
    return -0.95


EQUAL_FORMS = {
    "drag.linear": [_planted("damping", "viscous", _stated("dof_damping"))],
    "friction.coulomb": [
        _planted("frictionloss", "torque", _stated("dof_frictionloss")),
        _Form("torque", edit=_stiff_friction, at_least=_stated("dof_frictionloss")),
    ],
    "inertia.armature": [_planted("armature", "inertia", _stated("dof_armature"))],
    "mass.scale": [_planted("mass", "ratio", _above_minus_one)],
    "actuator.stiffness": [_planted("kp", "ratio", _above_minus_one)],
    "actuator.damping": [_Form("ratio", edit=_servo_damping, at_least=_above_minus_one)],
    "inertia.scale": [_Form("ratio", edit=_inertia_scale, at_least=_above_minus_one)],
    "mass.offset": [_Form("angle", edit=_mass_offset(axis)) for axis in range(3)],
    "spring.linear": [_Form("torque", edit=_joint_spring)],
    "gravity.scale": [_Form("ratio", edit=_gravity_scale)],
    "drag.quadratic": [_Form("viscous", force=lambda c, q, v: -c * abs(v) * v)],
    "spring.cubic": [_Form("torque", force=lambda c, q, v: -c * q**3)],
    "force.bias": [_Form("torque", force=lambda c, q, v: c)],
    "input.gain": [_Form("ratio", command=lambda c, u: (1 + c) * u)],
    "input.bias": [_Form("angle", command=lambda c, u: u + c)],
    "input.delay": [_Form("time", command=_held_delayed)],
    "input.lag": [_Form("time", command=_lagged)],
    "sensor.gain": [_Form("ratio", reading=lambda c, q: (1 + c) * q)],
    "sensor.bias": [_Form("angle", reading=lambda c, q: q + c)],
    "sensor.delay": [_Form("time", reading=_delayed)],
    "sensor.lag": [_Form("time", reading=_lagged)],
}
"""Forms of each cause that plain MuJoCo can express; the best one counts."""

PLACES = {
    "drag.linear": "joint", "friction.coulomb": "joint", "inertia.armature": "joint",
    "mass.scale": "body", "inertia.scale": "body", "mass.offset": "body",
    "actuator.stiffness": "actuator", "actuator.damping": "actuator",
    "spring.linear": "joint", "gravity.scale": "world", "drag.quadratic": "joint",
    "spring.cubic": "joint", "force.bias": "joint", "input.gain": "actuator",
    "input.bias": "actuator", "input.delay": "actuator", "input.lag": "actuator",
    "sensor.gain": "channel", "sensor.bias": "channel", "sensor.delay": "channel",
    "sensor.lag": "channel",
}  # fmt: skip
