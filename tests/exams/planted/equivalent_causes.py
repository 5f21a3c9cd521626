"""Compare the held-out error of other causes with the error of the planted one.

The cause is put into plain MuJoCo, its coefficients are fitted to the runs for fitting, and its
error on the held-out run is compared with the error of the planted cause. Initial states are
estimated in every run, to first order. A cause that plain MuJoCo cannot express has no result.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import mujoco
import numpy as np

from sims.core.root_mean_square import compute_rms
from tests.exams.coefficient_fit import fit_coefficients
from tests.exams.planted.planted_motion import (
    HELD_OUT,
    RATE,
    RUNS,
    Change,
    Run,
    add_point_mass,
    turn_axis,
)

STEPS = 12  # Maximum number of steps of a fit.


def held_out_ratios(item, names):
    """Return the held-out errors of causes, divided by the error of the planted cause.

    The result is None for a cause that plain MuJoCo cannot express.

    Args:
        item: case with the planted cause.
        names: causes, effect@place or effect@* for all places.
    """
    comparison = _Comparison(item)
    return {name: comparison.ratio(name) for name in names}


class _Comparison:
    def __init__(self, item):
        self.experiment = item.experiment
        self.runs, states = item.performance
        self.measured = item.measured()
        truth = {name: self.experiment.channels(states[name]) for name in RUNS}
        self.true_parameter_error = compute_rms(self._residual(HELD_OUT, truth[HELD_OUT]))

    def ratio(self, name):
        effect, _, place = name.partition("@")
        if effect not in FORMS:
            return None
        places = self._places(effect, place)
        if not places:
            return None
        return (
            min(self._held_out_error(form, places) for form in FORMS[effect])
            / self.true_parameter_error
        )

    def _places(self, effect, place):
        model = self.experiment.model
        every = {
            "joint": self.experiment.places,
            "body": [model.body(b).name for b in self.experiment.bodies],
            "actuator": [model.actuator(i).name for i in range(model.nu)],
            "channel": self.experiment.channel_names,
            "contact": [place] if place != "*" else [],
            "world": [""],
        }[_place_kind(effect)]
        return every if place == "*" else [p for p in every if p == place]

    def _residual(self, name, simulated):
        """Return the residual of a run in units of the noise, with initial states projected out."""
        flat = ((self.measured[name] - simulated) / self.experiment.sigma).ravel()
        basis = self.experiment.state_bases[name]
        return flat - basis @ (basis.T @ flat)

    def _held_out_error(self, form, places):
        """Fit the coefficients of all places and return the error on the held-out run."""
        scales = np.array([form.scale(self.experiment, place) for place in places])
        lowest = np.array(
            [
                np.broadcast_to(form.at_least(self.experiment.model, p), scales.shape[1])
                for p in places
            ]
        )
        fitted = [name for name in RUNS if name != HELD_OUT]

        def residual(numbers, names=fitted):
            rows = np.reshape(numbers, scales.shape) * scales
            coefficients = dict(zip(places, rows, strict=True))
            return np.concatenate(
                [
                    self._residual(n, form.simulate(self.experiment, coefficients, self.runs[n]))
                    for n in names
                ]
            )

        begin = np.tile(form.begin, (len(places), 1)).ravel()
        bounds = (lowest / scales).ravel(), np.inf
        return compute_rms(residual(fit_coefficients(residual, begin, *bounds, STEPS), [HELD_OUT]))


@dataclass(frozen=True)
class _Form:
    """A cause in plain MuJoCo. Coefficients of a place are an array c.

    Attributes:
        units: scale of each coefficient, see `scale`.
        edit: (model, place, c) changes the compiled model.
        step: (model, data, joint, c) is called before each step of the engine.
        command: (c, commands (SAMPLES,)) returns the input of an actuator.
        reading: (c, positions (SAMPLES,)) returns the reading of a sensor.
        at_least: (model, place) returns the lowest physical coefficients.
        begin: scaled coefficients at which the fit begins.
    """

    units: tuple[str, ...]
    edit: Callable | None = None
    step: Callable | None = None
    command: Callable | None = None
    reading: Callable | None = None
    at_least: Callable = lambda model, place: -np.inf
    begin: tuple[float, ...] = (0.0,)

    def scale(self, experiment, place):
        """Return plausible sizes of the coefficients."""
        torque = max(0.05 * float(experiment.nominal_peaks.max()), 1e-6)
        sizes = {"ratio": 0.1, "time": 1.0 / RATE, "angle": 0.01, "speed": 0.1, "torque": torque}
        if "inertia" in self.units:
            dof = experiment.model.joint(place).dofadr[0]
            sizes["inertia"] = max(0.3 * float(experiment.nominal_inertia[dof]), 1e-9)
        if "mass" in self.units:
            sizes["mass"] = 0.3 * float(experiment.model.body(place).mass[0])
        return np.array([sizes[unit] for unit in self.units])

    def simulate(self, experiment, coefficients, run):
        """Return the channels (SAMPLES, C) with the cause."""
        simulator = experiment.simulator()
        model, commands = simulator.model, run.commands.copy()
        for place, c in coefficients.items():
            if self.edit is not None:
                self.edit(model, place, c)
            if self.command is not None:
                index = model.actuator(place).id
                commands[:, index] = self.command(c, commands[:, index])
        if self.edit is not None:
            mujoco.mj_setConst(model, mujoco.MjData(model))
        if self.step is not None:
            joints = [(_Joint(model, place), c) for place, c in coefficients.items()]
            simulator.before_step = lambda: [self.step(model, simulator.data, *j) for j in joints]
        states = simulator.simulate(Run(commands, run.positions, run.velocities))
        channels = experiment.channels(states).copy()
        if self.reading is not None:
            for place, c in coefficients.items():
                column = experiment.channel_names.index(place)
                channels[:, column] = self.reading(c, channels[:, column])
        return channels


class _Joint:
    """Addresses of a joint, and the dry friction that its file specifies."""

    def __init__(self, model, name):
        self.position, self.dof = model.joint(name).qposadr[0], model.joint(name).dofadr[0]
        self.friction = float(model.dof_frictionloss[self.dof])


def _force(law):
    """Return a step function with the generalised force law(c, q, v) at a joint."""

    def step(model, data, joint, c):
        data.qfrc_applied[joint.dof] = law(c, data.qpos[joint.position], data.qvel[joint.dof])

    return step


def _stribeck(model, data, joint, c):
    falling = c[1] * np.exp(-((data.qvel[joint.dof] / max(c[2], 1e-6)) ** 2))
    model.dof_frictionloss[joint.dof] = max(joint.friction + c[0] + falling, 0.0)


def _planted(kind, unit, at_least):
    return _Form((unit,), edit=lambda m, p, c: Change(kind, p, c[0]).apply(m), at_least=at_least)


def _stiff_friction(model, place, c):
    """Add dry friction with a stiff solver reference, as simgap writes it into a file."""
    dof = model.joint(place).dofadr[0]
    model.dof_frictionloss[dof] += c[0]
    model.dof_solref[dof] = [-1e-9, -1250]
    model.dof_solimp[dof] = [0.9999, 0.9999, 0.001, 0.5, 2]


def _servo_damping(model, place, c):
    model.actuator_biasprm[model.actuator(place).id, 2] *= 1 + c[0]


def _joint_spring(model, place, c):
    model.jnt_stiffness[model.joint(place).id] += c[0]


def _inertia_scale(model, place, c):
    model.body_inertia[model.body(place).id] *= 1 + c[0]


def _mass_offset(model, place, c):
    model.body_ipos[model.body(place).id] += c


def _payload(model, place, c):
    body = model.body(place).id
    add_point_mass(model, body, c[0], model.body_ipos[body] + c[1:])


def _link_length(model, place, c):
    model.body_pos[model.body(place).id] *= 1 + c[0]


def _gravity_scale(model, _, c):
    model.opt.gravity[:] *= 1 + c[0]


def _gravity_tilt(model, _, c):
    model.opt.gravity[:2] += 9.81 * c


def _delayed(c, column):
    """Delay a signal by c[0] seconds, with linear interpolation between samples."""
    times = np.arange(column.size) / RATE
    return np.interp(times - c[0], times, column)


def _lagged(c, column):
    """Apply a first-order lag with time constant c[0], at least 0.001 s."""
    blend = 1 - np.exp(-1 / RATE / max(c[0], 1e-3))
    result, state = np.empty_like(column), column[0]
    for index, wanted in enumerate(column):
        state += blend * (wanted - state)
        result[index] = state
    return result


def _stated(field):
    """Return the lower bound of a change of a joint's number: minus the value in the file."""
    return lambda model, place: -float(getattr(model, field)[model.joint(place).dofadr[0]])


def _ratio(model, place):
    """Return the lower bound of the relative change of a positive number."""
    return -0.95


def _point_mass(model, place):
    """Return the lower bounds of a payload's mass and position."""
    return np.array([1e-6, -np.inf, -np.inf, -np.inf])


def _positive(model, place):
    return 0.0


FORMS = {
    "drag.linear": [_planted("damping", "torque", _stated("dof_damping"))],
    "friction.coulomb": [
        _planted("frictionloss", "torque", _stated("dof_frictionloss")),
        _Form(("torque",), edit=_stiff_friction, at_least=_stated("dof_frictionloss")),
    ],
    "friction.stribeck": [
        _Form(("torque", "torque", "speed"), step=_stribeck, at_least=_positive, begin=(0.1, 0, 1))
    ],
    "friction.direction": [
        _Form(
            ("torque", "torque"),
            step=_force(lambda c, q, v: -(c[0] if v > 0 else c[1]) * v),
            begin=(0, 0),
        )
    ],
    "inertia.armature": [_planted("armature", "inertia", _stated("dof_armature"))],
    "mass.scale": [_planted("mass", "ratio", _ratio)],
    "mass.offset": [_Form(("angle",) * 3, edit=_mass_offset, begin=(0, 0, 0))],
    "payload": [
        _Form(("mass", *("angle",) * 3), edit=_payload, at_least=_point_mass, begin=(1, 0, 0, 0))
    ],
    "joint.zero": [_planted("zero", "angle", lambda model, place: -np.inf)],
    "link.length": [_Form(("ratio",), edit=_link_length)],
    "joint.axis": [_Form(("angle",) * 3, edit=turn_axis, begin=(0, 0, 0))],
    "gravity.compensation": [_planted("gravcomp", "ratio", _positive)],
    "geom.radius": [_planted("radius", "ratio", _ratio)],
    "contact.friction": [_planted("friction", "ratio", _ratio)],
    "inertia.scale": [_Form(("ratio",), edit=_inertia_scale, at_least=_ratio)],
    "actuator.stiffness": [_planted("kp", "ratio", _ratio)],
    "actuator.damping": [_Form(("ratio",), edit=_servo_damping, at_least=_ratio)],
    "spring.linear": [_Form(("torque",), edit=_joint_spring)],
    "spring.cubic": [_Form(("torque",), step=_force(lambda c, q, v: -c[0] * q**3))],
    "gravity.scale": [_Form(("ratio",), edit=_gravity_scale)],
    "gravity.tilt": [_Form(("ratio",) * 2, edit=_gravity_tilt, begin=(0, 0))],
    "drag.quadratic": [_Form(("torque",), step=_force(lambda c, q, v: -c[0] * abs(v) * v))],
    "force.bias": [_Form(("torque",), step=_force(lambda c, q, v: c[0]))],
    "input.gain": [_Form(("ratio",), command=lambda c, u: (1 + c[0]) * u)],
    "input.bias": [_Form(("angle",), command=lambda c, u: u + c[0])],
    "input.delay": [_Form(("time",), command=_delayed)],
    "input.lag": [_Form(("time",), command=_lagged, begin=(0.3,))],
    "sensor.gain": [_Form(("ratio",), reading=lambda c, q: (1 + c[0]) * q)],
    "sensor.bias": [_Form(("angle",), reading=lambda c, q: q + c[0])],
    "sensor.delay": [_Form(("time",), reading=_delayed)],
    "sensor.lag": [_Form(("time",), reading=_lagged, begin=(0.3,))],
}
"""Forms of each cause that plain MuJoCo can express; the best one counts."""


def _place_kind(effect):
    """Return the kind of place at which an effect acts."""
    kinds = {"actuator": "actuator", "input": "actuator", "sensor": "channel", "gravity": "world"}
    kinds |= {"contact": "contact", "geom": "contact", "payload": "body", "link": "body"}
    is_body = effect.startswith("mass.") or effect in ("inertia.scale", "gravity.compensation")
    return "body" if is_body else kinds.get(effect.partition(".")[0], "joint")
