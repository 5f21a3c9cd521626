"""Sampling of cases for servo and arm.

Sizes are computed to first order: the RMS of the change that a cause makes to the noise-free
motion, after the part is projected out that changes of parameters and initial states can explain.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path

import numpy as np

from bench.diagnosis_benchmark.case_generation.cause_sizes import (
    arrange_slopes,
    compute_orthonormal_basis,
    find_strength_for_size,
)
from bench.diagnosis_benchmark.case_generation.recording_conditions import (
    ANY_CONDITIONS,
    BenchmarkCase,
    RecordedCase,
    RequestedConditions,
    draw_size,
    make_case_rng,
    name_case,
)
from bench.diagnosis_benchmark.machine_cases import hidden_causes
from bench.diagnosis_benchmark.machine_cases.hidden_causes import EFFECTS_BY_MACHINE
from bench.diagnosis_benchmark.machine_cases.machine_dynamics import MACHINES, Effects
from bench.diagnosis_benchmark.machine_cases.machine_recording_conditions import (
    MachineRecordingConditions,
    draw_conditions,
)
from bench.diagnosis_benchmark.machine_cases.reference_motion import (
    MachineRuns,
    read_encoders,
    simulate_machine,
)
from sims.core.root_mean_square import compute_rms
from sims.core.simulator import Array, Channel
from sims.core.system import System
from sims.recording.recording import Recording, Run
from sims.recording.recording_description import ModelFileReference
from sims.systems.servo import Servo

MACHINE_NAMES = tuple(MACHINES)
"""Names of the machines."""
_FINITE_DIFFERENCE_STEP = 1e-4
"""Finite-difference step: relative for a parameter, rad or rad/s for an initial state."""
_PROBE_STRENGTH = 0.1
"""Strength at which the directions of other causes are computed."""
_COARSE_STEP_FACTOR = 2.0
"""Factor of the step size when the directions of other causes are computed."""


def draw_case(
    kind: str,
    system: str,
    seed: int,
    effect: str | None = None,
    size: float | None = None,
    requested: RequestedConditions = ANY_CONDITIONS,
) -> BenchmarkCase | None:
    """Draw a case; see `bench.diagnosis_benchmark.case_generation.case_sampling.draw_case`.

    The recording conditions are drawn first, then the cause is scaled to the requested size in
    units of the noise.

    Args:
        kind: clean, single, double or foreign.
        system: servo or arm2.
        seed: seed from which everything else follows.
        effect: hidden effect (the first one of a double case); None to draw it.
        size: size in units of the noise; None to draw it.
        requested: recording conditions that are not drawn.

    Returns:
        The case, or None if the encoders cannot show the cause, or if another answer explains it
        too well.
    """
    name = name_case(kind, system, effect or "any", size, requested, seed)
    conditions, rng = restore_conditions(name, system, requested), make_case_rng(name, "cause")
    case = BenchmarkCase(
        name=name,
        system=system,
        kind=kind,
        effects={},
        size=0.0,
        noise=conditions.noise.kind,
        stated=conditions.noise.stated,
        rate=conditions.rate,
        seconds=conditions.seconds,
        runs=len(conditions.runs.q),
        source="own equations",
        driven=True,
        channels=MACHINES[system].channels,
        seed=seed,
        parameters=conditions.free_parameters,
        asked=requested,
    )
    target_size = draw_size(kind, size, rng)
    hidden = _choose_hidden_causes(kind, system, effect, rng)
    if not hidden:
        return case if kind == "clean" else None
    return case.hide(
        hidden,
        target_size,
        lambda name: _find_sized_coefficients(name, conditions, target_size, rng),
        lambda effects: _compute_unexplained_size(kind, conditions, effects, target_size, rng),
    )


@lru_cache(maxsize=4)
def restore_conditions(
    name: str, system: str, requested: RequestedConditions = ANY_CONDITIONS
) -> MachineRecordingConditions:
    """Draw the recording conditions of a case again; they follow from its name.

    Args:
        name: name of the case.
        system: servo or arm2.
        requested: conditions that were not drawn.
    """
    return draw_conditions(system, make_case_rng(name, "setting"), requested)


def _choose_hidden_causes(
    kind: str, system: str, effect: str | None, rng: np.random.Generator
) -> tuple[str, ...]:
    """Choose the causes that a case hides, with their places: joints, bodies, motors or channels.

    Args:
        kind: clean, single, double or foreign.
        system: servo or arm2.
        effect: name of the first cause; None to draw it.
        rng: random generator.

    Returns:
        ``cause@place`` or ``cause`` of each; none for a clean case, and none if the two effects of
        a double case would be equivalent.
    """
    if kind == "clean":
        return ()
    is_foreign = kind == "foreign"
    causes = hidden_causes.UNMODELLED_CAUSES if is_foreign else EFFECTS_BY_MACHINE[system]
    first_places = hidden_causes.list_effect_places(system, effect or str(rng.choice(causes)))
    first = str(rng.choice(first_places))
    if kind != "double":
        return (first,)
    places = hidden_causes.list_effect_places(system, str(rng.choice(causes)))
    places = tuple(name for name in places if name != first)
    second = str(rng.choice(places)) if places else first
    return () if second in find_equivalent_causes(system, first) else (first, second)


def _find_sized_coefficients(
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
    compute_coefficients = hidden_causes.draw_effect_shape(name, conditions, rng)
    gauge = _ResidualGauge(conditions)

    def compute_size(strength: float) -> float:
        causes = {name: compute_coefficients(strength)}
        return gauge.compute_residual_size(conditions.simulate_readings(causes))

    found = find_strength_for_size(compute_size, target_size, 1.0)
    return None if found is None else compute_coefficients(found[0])


def _compute_unexplained_size(
    kind: str,
    conditions: MachineRecordingConditions,
    effects: Effects,
    size: float,
    rng: np.random.Generator,
) -> float | None:
    """Compute the RMS residual that the best wrong answer leaves, to first order.

    It is in units of the noise. If it is small, the case would be unfair, since a wrong answer
    explains it. The direction of each wrong answer is its change of the readings at a small
    strength; the part of the hidden causes' change along it is subtracted.

    Args:
        kind: single, double or foreign.
        conditions: recording conditions.
        effects: coefficients of the hidden causes by name.
        size: size of each in units of the noise.
        rng: random generator for the shapes of the wrong answers.

    Returns:
        The residual; None if the effect has no simpler form, or less than the size of the noise.
    """
    wrong_answers = _list_wrong_answers(kind, conditions.system, effects)
    if not wrong_answers or (kind == "single" and size < 1.0):
        return None
    gauge = _ResidualGauge(conditions)
    change = conditions.simulate_readings(effects) - gauge.bare
    base_readings = conditions.simulate_readings({}, coarse=_COARSE_STEP_FACTOR)
    residual_sizes = []
    for name in wrong_answers:
        compute_coefficients = hidden_causes.draw_effect_shape(name, conditions, rng)
        probe = {name: effects.get(name, compute_coefficients(_PROBE_STRENGTH))}
        direction = conditions.simulate_readings(probe, coarse=_COARSE_STEP_FACTOR) - base_readings
        residual_sizes.append(gauge.compute_projected_size(change, direction))
    return min(residual_sizes)


def _list_wrong_answers(kind: str, system: str, effects: Effects) -> list[str]:
    """List causes that may explain a case though they are not its hidden causes.

    They are Coulomb friction and drag instead of Stribeck friction, one of two effects, or any
    effect of the library instead of an unmodelled cause.

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
            for name in hidden_causes.list_effect_places(system, effect)
        ]
    effect, at, place = next(iter(effects)).partition("@")
    if effect != "friction.stribeck":
        return []
    return [f"friction.coulomb{at}{place}", f"drag.linear{at}{place}" if at else "drag.quadratic"]


class _ResidualGauge:
    """Sizes of changes, in units of the noise, with parameters and initial states projected out.

    Attributes:
        bare: readings without hidden causes, (R, T, N).
    """

    def __init__(self, conditions: MachineRecordingConditions) -> None:
        """Simulate the runs with each parameter and initial state changed, for their directions.

        All simulations are one batch of R runs times 1 + P + 2 N variants: unchanged, each of P
        parameters, each of N angles and each of N velocities. A parameter changes all runs, an
        initial state only its own run.

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
        for k, name in enumerate(parameters):
            values[name][:, 1 + k] *= 1 + _FINITE_DIFFERENCE_STEP
        q, v = (part.reshape(runs, variants, joints).copy() for part in (fitted.q, fitted.v))
        for joint in range(joints):
            q[:, 1 + len(parameters) + joint, joint] += _FINITE_DIFFERENCE_STEP
            v[:, 1 + len(parameters) + joints + joint, joint] += _FINITE_DIFFERENCE_STEP
        plant = MACHINES[conditions.system]({n: a.ravel() for n, a in values.items()}, {})
        start_runs = fitted._replace(q=q.reshape(-1, joints), v=v.reshape(-1, joints))
        readings = read_encoders(simulate_machine(plant, start_runs), plant, conditions.runs.times)
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


EQUIVALENT_CAUSES: dict[str, tuple[frozenset[str], ...]] = {
    # A motor that never reaches its limit converts an offset of the goal into a torque.
    "servo": (frozenset({"force.bias", "input.bias"}),),
    "arm2": tuple(
        frozenset(names)
        for joint, body in (("shoulder", "upper_arm"), ("elbow", "forearm"))
        for names in (
            {f"force.bias@{joint}", f"input.bias@m_{joint}"},
            *([{f"inertia.armature@{joint}", f"inertia.scale@{body}"}] * (joint == "shoulder")),
        )
    ),
}
"""Causes that give exactly the same motion, by machine."""


def find_equivalent_causes(system: str, name: str) -> frozenset[str]:
    """Return a cause and all causes that are equivalent to it.

    Args:
        system: servo or arm2.
        name: ``effect@place`` or ``effect``.
    """
    return frozenset({name}).union(*(names for names in EQUIVALENT_CAUSES[system] if name in names))


MODEL_FILE_NAME = "robot.xml"
"""Name of the model file, in the folder of the recording."""


def render_arm_mjcf(numbers: Mapping[str, float]) -> str:
    """Render the MJCF text of an arm.

    Args:
        numbers: parameters; see `machine_dynamics.ArmDynamics`.
    """
    links = [
        (body, joint, {k.removesuffix(end): v for k, v in numbers.items() if k.endswith(end)})
        for body, joint, end in (("upper_arm", "shoulder", "1"), ("forearm", "elbow", "2"))
    ]
    inner_link, outer_link = (_render_link(*link) for link in links)
    return f"""<mujoco model="arm2">
  <compiler angle="radian" autolimits="true"/>
  <option timestep="0.002" integrator="RK4" gravity="0 0 -9.81">
    <flag contact="disable"/>
  </option>
  <worldbody>
    <body name="upper_arm">
      {inner_link}
      <body name="forearm" pos="0 0 {-numbers["length"]!r}">
        {outer_link}
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor name="m_shoulder" joint="shoulder" gear="1"/>
    <motor name="m_elbow" joint="elbow" gear="1"/>
  </actuator>
</mujoco>
"""


def _render_link(body: str, joint: str, n: Mapping[str, float]) -> str:
    """Render the inertia and joint of a link; it is slender along its own axis.

    The moment of inertia about that axis is a tenth of the others. It does not matter, because the
    link never turns about it.

    Args:
        body: name of the link.
        joint: name of its joint.
        n: mass, centre, inertia, damping and armature of the link.
    """
    moments = f"{n['inertia']!r} {n['inertia']!r} {0.1 * n['inertia']!r}"
    return (
        f'<inertial pos="0 0 {-n["centre"]!r}" mass="{n["mass"]!r}" diaginertia="{moments}"/>\n'
        f'      <joint name="{joint}" type="hinge" axis="0 1 0" damping="{n["damping"]!r}" '
        f'armature="{n["armature"]!r}"/>'
    )


class _ArmSignals(System):
    """Signals of the arm, for the units in the description of its recording."""

    channels = tuple(Channel(name, "rad") for name in MACHINES["arm2"].channels)
    inputs = tuple(Channel(f"u.{name}", "N*m") for name in MACHINES["arm2"].motors)


def record_case(case: BenchmarkCase) -> RecordedCase:
    """Simulate the recording of a case, with sensor noise; that of an arm has a model file.

    It states what a user knows: units, constants or the model file, held-out runs and sometimes the
    noise, but neither the hidden causes nor the true parameters.
    """
    conditions = restore_conditions(case.name, case.system, case.asked)
    plant, times = conditions.make_machine(case.effects), conditions.runs.times
    readings = read_encoders(simulate_machine(plant, conditions.runs), plant, times)
    rng = make_case_rng(case.name, "noise")
    is_arm = case.system == "arm2"
    declared = _ArmSignals if is_arm else Servo.system
    runs = []
    for number, run in enumerate(readings):
        recorded = conditions.noise.add_to(run, rng)
        commands = [*conditions.runs.commands[number].T, *([] if is_arm else [np.ones_like(times)])]
        inputs = dict(zip((c.name for c in declared.inputs), commands, strict=True))
        channels = dict(zip(case.channels, recorded.T, strict=True))
        held_out = number >= case.runs - conditions.held_out
        runs.append(Run(str(number), times, channels, inputs, {}, {}, held_out))
    noise = conditions.noise.sigma if case.stated else {}
    if is_arm:
        model = ModelFileReference(Path(MODEL_FILE_NAME), {}, {})
        recording = Recording(Path(), case.system, "", {}, noise, tuple(runs), model=model)
        model_text = render_arm_mjcf(conditions.numbers)
        return RecordedCase(recording, declared, {MODEL_FILE_NAME: model_text})
    stated_constants = {
        name: v for name, v in conditions.numbers.items() if name not in conditions.free_parameters
    }
    recording = Recording(Path(), case.system, "", stated_constants, noise, tuple(runs))
    return RecordedCase(recording, declared)
