"""Sizes of hidden causes of a machine, to first order, and coefficients that give a size.

A size is the RMS of the change that a cause makes to the noise-free encoder readings, in units of
the noise, after the part is projected out that changes of parameters and initial states can
explain.
"""

from __future__ import annotations

import numpy as np

from bench.diagnosis_benchmark.case_generation.strength_search import (
    arrange_slopes,
    compute_orthonormal_basis,
    find_strength_for_size,
)
from bench.diagnosis_benchmark.machine_cases import machine_effect_coefficients
from bench.diagnosis_benchmark.machine_cases.machine_dynamics import MACHINES, Effects
from bench.diagnosis_benchmark.machine_cases.machine_effect_coefficients import EFFECTS_BY_MACHINE
from bench.diagnosis_benchmark.machine_cases.machine_recording_conditions import (
    MachineRecordingConditions,
)
from bench.diagnosis_benchmark.machine_cases.machine_simulation import (
    MachineRuns,
    read_encoders,
    simulate_machine,
)
from sims.core.root_mean_square import compute_rms
from sims.core.simulator import Array

_FINITE_DIFFERENCE_STEP = 1e-4
"""Finite-difference step: relative for a parameter, rad or rad/s for an initial state."""
_PROBE_STRENGTH = 0.1
"""Strength at which the directions of other causes are computed."""
_COARSE_STEP_FACTOR = 2.0
"""Factor of the step size when the directions of other causes are computed."""


def find_sized_coefficients(
    name: str,
    conditions: MachineRecordingConditions,
    target_size: float,
    rng: np.random.Generator,
) -> tuple[float, ...] | None:
    """Find coefficients at which a cause has the requested size, with a strength of at most 1.

    The shape of the cause is drawn; its strength is then varied until the size is right.

    Args:
        name: ``cause@place``, or ``cause`` alone.
        conditions: recording conditions.
        target_size: size in units of the noise.
        rng: random generator for the shape of the cause.

    Returns:
        The coefficients; None if the size is not reached.
    """
    compute_coefficients = machine_effect_coefficients.draw_effect_shape(name, conditions, rng)
    gauge = _ResidualGauge(conditions)

    def compute_size(strength: float) -> float:
        causes = {name: compute_coefficients(strength)}
        return gauge.compute_residual_size(conditions.simulate_readings(causes))

    strength_and_size = find_strength_for_size(compute_size, target_size, largest=1.0)
    if strength_and_size is None:
        return None
    strength, _ = strength_and_size
    return compute_coefficients(strength)


def compute_unexplained_size(
    kind: str,
    conditions: MachineRecordingConditions,
    effects: Effects,
    size: float,
    rng: np.random.Generator,
) -> float | None:
    """Compute the RMS residual that the best wrong answer leaves, to first order.

    It is in units of the noise. If it is small, the case would be unfair, since a wrong answer
    explains it. Each wrong answer changes the readings at a small strength in some direction; the
    part of the hidden causes' change along this direction is subtracted.

    Args:
        kind: single, double or foreign.
        conditions: recording conditions.
        effects: coefficients of the hidden causes by name.
        size: size of each in units of the noise.
        rng: random generator for the shapes of the wrong answers.

    Returns:
        The residual; None for a single effect that has no simpler form or is smaller than the
        noise.
    """
    wrong_answers = _list_wrong_answers(kind, conditions.system, effects)
    if not wrong_answers or (kind == "single" and size < 1.0):
        return None
    gauge = _ResidualGauge(conditions)
    change = conditions.simulate_readings(effects) - gauge.bare
    base_readings = conditions.simulate_readings({}, coarse=_COARSE_STEP_FACTOR)
    residual_sizes = []
    for name in wrong_answers:
        compute_coefficients = machine_effect_coefficients.draw_effect_shape(name, conditions, rng)
        # One of two hidden effects has known coefficients; of others, the shape is drawn.
        probe = {name: effects.get(name, compute_coefficients(_PROBE_STRENGTH))}
        direction = conditions.simulate_readings(probe, coarse=_COARSE_STEP_FACTOR) - base_readings
        residual_sizes.append(gauge.compute_projected_size(change, direction))
    return min(residual_sizes)


def _list_wrong_answers(kind: str, system: str, effects: Effects) -> list[str]:
    """List causes that may explain a case though they are not its hidden causes.

    * double: one of the two effects,
    * foreign: any effect of the library instead of the unmodelled cause,
    * single: Coulomb friction and drag instead of Stribeck friction, none for other effects.

    Args:
        kind: single, double or foreign.
        system: servo or arm2.
        effects: hidden causes.
    """
    if kind == "double":
        return list(effects)
    if kind == "foreign":
        return [
            name
            for effect in EFFECTS_BY_MACHINE[system]
            for name in machine_effect_coefficients.list_effect_places(system, effect)
        ]
    (hidden_effect,) = effects
    effect, at, place = hidden_effect.partition("@")
    if effect != "friction.stribeck":
        return []
    # Effects of a servo have no place, and its parameters absorb linear drag.
    drag = f"drag.linear{at}{place}" if at else "drag.quadratic"
    return [f"friction.coulomb{at}{place}", drag]


class _ResidualGauge:
    """Sizes of changes, in units of the noise, with parameters and initial states projected out.

    Attributes:
        bare: readings without hidden causes, (R, T, N).
    """

    def __init__(self, conditions: MachineRecordingConditions) -> None:
        """Simulate the runs with each parameter and initial state changed, for their directions.

        All simulations are one batch of R runs times 1 + P + 2 N variants: unchanged, each of P
        parameters, each of N angles and each of N velocities. A parameter changes all runs, an
        initial state only its own run. `bare` are the unchanged readings, and `_basis` is an
        orthonormal basis of the changes.

        Args:
            conditions: recording conditions; only the runs for fitting are used.
        """
        self.conditions = conditions
        runs, joints = conditions.fitted_runs.q.shape
        parameters = list(conditions.free_parameters)
        variants = 1 + len(parameters) + 2 * joints
        # Each run once as it is, and once for each fitted parameter and initial state.
        fitted = MachineRuns(
            conditions.fitted_runs.times,
            np.repeat(conditions.fitted_runs.commands, variants, axis=0),
            np.repeat(conditions.fitted_runs.q, variants, axis=0),
            np.repeat(conditions.fitted_runs.v, variants, axis=0),
        )
        values = {
            name: np.full((runs, variants), value) for name, value in conditions.numbers.items()
        }
        # Variant 0 is unchanged.
        for index, name in enumerate(parameters):
            values[name][:, 1 + index] *= 1 + _FINITE_DIFFERENCE_STEP
        q, v = (part.reshape(runs, variants, joints).copy() for part in (fitted.q, fitted.v))
        for joint in range(joints):
            q[:, 1 + len(parameters) + joint, joint] += _FINITE_DIFFERENCE_STEP
            v[:, 1 + len(parameters) + joints + joint, joint] += _FINITE_DIFFERENCE_STEP
        plant = MACHINES[conditions.system](
            {name: array.ravel() for name, array in values.items()}, {}
        )
        changed_runs = fitted._replace(q=q.reshape(-1, joints), v=v.reshape(-1, joints))
        readings = read_encoders(
            simulate_machine(plant, changed_runs), plant, conditions.runs.times
        )
        readings = readings.reshape(runs, variants, -1)
        slopes = (readings[:, 1:] - readings[:, :1]) / _FINITE_DIFFERENCE_STEP
        self.bare = readings[:, 0].reshape(runs, len(conditions.runs.times), joints)
        self._basis = compute_orthonormal_basis(arrange_slopes(slopes, len(parameters)))

    def compute_residual_size(self, readings: Array) -> float:
        """Compute the size of the change in readings by a hidden cause; infinite if they diverge.

        Args:
            readings: readings with the hidden cause, (R, T, N).
        """
        return self._compute_size((readings - self.bare).ravel())

    def compute_projected_size(self, change: Array, direction: Array) -> float:
        """Compute the size of a change after a further direction is projected out.

        Shapes: R runs, T samples, N joints.

        Args:
            change: change of the readings, (R, T, N).
            direction: direction of another cause, (R, T, N).
        """
        residual, projected_direction = (
            self._project_out_parameters(part.ravel()) for part in (change, direction)
        )
        if projected_direction @ projected_direction > 0:
            residual = residual - projected_direction * (projected_direction @ residual) / (
                projected_direction @ projected_direction
            )
        return compute_rms(residual) / self.conditions.noise_sigmas

    def _compute_size(self, change: Array) -> float:
        """Return the RMS of a flattened change in units of the noise, parameters projected out."""
        if not np.isfinite(change).all():
            return float("inf")
        return compute_rms(self._project_out_parameters(change)) / self.conditions.noise_sigmas

    def _project_out_parameters(self, change: Array) -> Array:
        """Subtract from a change (RTN,) the part that parameters and initial states explain."""
        residual: Array = change - self._basis @ (self._basis.T @ change)
        return residual
