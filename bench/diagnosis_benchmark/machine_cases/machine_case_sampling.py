"""Sampling of cases for servo and arm.

Sizes are computed to first order: the RMS of the change that a cause makes to the noise-free
motion, after the part is projected out that changes of parameters and initial states can explain.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import lru_cache
from pathlib import Path

import numpy as np

from bench.diagnosis_benchmark.case_generation.cause_sizes import (
    compute_orthonormal_basis,
    compute_rms,
    find_strength_for_size,
)
from bench.diagnosis_benchmark.case_generation.recording_conditions import (
    ANY_CONDITIONS,
    MIN_DISTINCT_SIZE,
    MIN_SIMPLER_RESIDUAL,
    BenchmarkCase,
    RequestedConditions,
    make_case_rng,
)
from bench.diagnosis_benchmark.machine_cases import hidden_causes
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
from sims.core.simulator import Array

MACHINE_NAMES = tuple(MACHINES)
"""Names of the machines."""
SIMPLER_EFFECTS = {"friction.stribeck": "friction.coulomb"}
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
    words = [kind, system, effect or "any", *([f"{size:g}"] if size else [])]
    words += [str(part) for part in requested if part is not None]
    name = "-".join([*words, str(seed)])
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
    if kind == "clean":
        return case
    # Sizes are log-uniform up to 10 noises; several or foreign causes must be clearly visible.
    low = 3.0 if kind in ("double", "foreign") else 1.0
    target_size = size or float(np.exp(rng.uniform(np.log(low), np.log(10.0))))
    hidden = {
        "single": _hide_one_effect,
        "double": _hide_two_effects,
        "foreign": _hide_unmodelled_cause,
    }[kind]
    return hidden(case, conditions, effect, target_size, rng)


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


def _draw_place(
    case: BenchmarkCase, effect: str | None, rng: np.random.Generator, excluded_place: str = ""
) -> str:
    """Draw the effect, if it is not given, and its place: a joint, body, motor or sensor channel.

    Args:
        case: the case; its system determines the effects and places.
        effect: name of the effect; None to draw it.
        rng: random generator.
        excluded_place: effect with place that must not be drawn, because the case already hides it.

    Returns:
        ``effect@place`` or ``effect``; empty if the only place is excluded by `excluded_place`.
    """
    chosen_effect = effect or str(rng.choice(hidden_causes.EFFECTS_BY_MACHINE[case.system]))
    places = [
        name
        for name in hidden_causes.list_effect_places(case.system, chosen_effect)
        if name != excluded_place
    ]
    return str(rng.choice(places)) if places else ""


def _hide_one_effect(
    case: BenchmarkCase,
    conditions: MachineRecordingConditions,
    effect: str | None,
    target_size: float,
    rng: np.random.Generator,
) -> BenchmarkCase | None:
    """Hide one effect of the library, with coefficients that give the requested size.

    Stribeck friction of at least one noise is rejected if Coulomb friction or drag explains it too
    well: the residual that the better of them leaves (`unexplained`) must be at least
    `MIN_SIMPLER_RESIDUAL`.

    Args:
        case: the case without its hidden cause.
        conditions: recording conditions.
        effect: name of the effect; None to draw it.
        target_size: size in units of the noise.
        rng: random generator.

    Returns:
        The case; None if it is rejected or no coefficients give this size.
    """
    name = _draw_place(case, effect, rng)
    coefficients = _find_sized_coefficients(name, conditions, target_size, rng)
    if coefficients is None:
        return None
    effect, _, place = name.partition("@")
    unexplained = None
    if effect in SIMPLER_EFFECTS and target_size >= 1.0:
        simpler_effect = f"{SIMPLER_EFFECTS[effect]}@{place}" if place else SIMPLER_EFFECTS[effect]
        other_effects = [simpler_effect, f"drag.linear@{place}" if place else "drag.quadratic"]
        unexplained = _compute_unexplained_size(
            conditions, {name: coefficients}, {}, other_effects, rng
        )
    return case.hide({name: coefficients}, target_size, unexplained, MIN_SIMPLER_RESIDUAL)


def _find_sized_coefficients(
    name: str,
    conditions: MachineRecordingConditions,
    target_size: float,
    rng: np.random.Generator,
    is_modelled: bool = True,
) -> tuple[float, ...] | None:
    """Find coefficients at which a cause has the requested size, with a strength of at most 1.

    The shape of the cause is drawn; its strength is then varied until the size is right.

    Args:
        name: ``cause@place``, or ``cause`` alone.
        conditions: recording conditions.
        target_size: size in units of the noise.
        rng: random generator for the shape of the cause.
        is_modelled: whether the cause is an effect of the library.

    Returns:
        The coefficients; None if the size is not reached.
    """
    draw = hidden_causes.draw_effect_shape if is_modelled else hidden_causes.draw_unmodelled_cause
    compute_coefficients = draw(name, conditions, rng)
    gauge = _ResidualGauge(conditions)

    def compute_size(strength: float) -> float:
        causes = {name: compute_coefficients(strength)}
        effects, foreign = (causes, {}) if is_modelled else ({}, causes)
        return gauge.compute_residual_size(conditions.simulate_readings(effects, foreign))

    found = find_strength_for_size(compute_size, target_size, 1.0)
    return None if found is None else compute_coefficients(found[0])


def _hide_two_effects(
    case: BenchmarkCase,
    conditions: MachineRecordingConditions,
    effect: str | None,
    target_size: float,
    rng: np.random.Generator,
) -> BenchmarkCase | None:
    """Hide two effects, each of the requested size alone; reject the case if one explains both.

    Args:
        case: the case without its hidden causes.
        conditions: recording conditions.
        effect: name of the first effect; None to draw it.
        target_size: size of each effect alone, in units of the noise.
        rng: random generator.

    Returns:
        The case; None if it is rejected, the effects are equivalent, or no coefficients give this
        size.
    """
    first = _draw_place(case, effect, rng)
    second = _draw_place(case, None, rng, excluded_place=first)
    if not second or second in find_equivalent_causes(case.system, first):
        return None
    coefficients_by_effect = {
        name: _find_sized_coefficients(name, conditions, target_size, rng)
        for name in (first, second)
    }
    effects = {name: c for name, c in coefficients_by_effect.items() if c is not None}
    if len(effects) < 2:
        return None
    unexplained = min(
        _compute_unexplained_size(conditions, effects, {}, [name], rng) for name in effects
    )
    return case.hide(effects, target_size, unexplained, MIN_DISTINCT_SIZE)


def _hide_unmodelled_cause(
    case: BenchmarkCase,
    conditions: MachineRecordingConditions,
    cause: str | None,
    target_size: float,
    rng: np.random.Generator,
) -> BenchmarkCase | None:
    """Hide an unmodelled cause, which the library explains only in part.

    The case is rejected if one effect of the library leaves a residual (`unexplained`) below
    `MIN_DISTINCT_SIZE`.

    Args:
        case: the case without its hidden cause.
        conditions: recording conditions.
        cause: name of the cause; None to draw it.
        target_size: size in units of the noise.
        rng: random generator.

    Returns:
        The case; None if it is rejected or no strength gives this size.
    """
    chosen_cause = cause or str(rng.choice(hidden_causes.UNMODELLED_CAUSES))
    joint = str(rng.choice(MACHINES[case.system].joints))
    name = f"{chosen_cause}@{joint}" if joint else chosen_cause
    coefficients = _find_sized_coefficients(name, conditions, target_size, rng, is_modelled=False)
    if coefficients is None:
        return None
    hidden = {name: coefficients}
    library_effects = [
        n
        for e in hidden_causes.EFFECTS_BY_MACHINE[case.system]
        for n in hidden_causes.list_effect_places(case.system, e)
    ]
    unexplained = _compute_unexplained_size(conditions, {}, hidden, library_effects, rng)
    return case.hide(hidden, target_size, unexplained, MIN_DISTINCT_SIZE)


def _compute_unexplained_size(
    conditions: MachineRecordingConditions,
    effects: Effects,
    foreign: Effects,
    other_causes: Sequence[str],
    rng: np.random.Generator,
) -> float:
    """Compute the RMS residual that the best of other causes leaves, to first order.

    It is in units of the noise. If it is small, the case would be unfair, since a wrong answer
    explains it. The direction of each other cause is its change of the readings at a small
    strength; the part of the hidden causes' change along it is subtracted.

    Args:
        conditions: recording conditions.
        effects: hidden effects of the library.
        foreign: hidden unmodelled causes.
        other_causes: the other causes, each of which may be a wrong answer.
        rng: random generator for the shapes of the other causes.
    """
    gauge = _ResidualGauge(conditions)
    change = conditions.simulate_readings(effects, foreign) - gauge.bare
    base_readings = conditions.simulate_readings(coarse=_COARSE_STEP_FACTOR)
    residual_sizes = []
    for name in other_causes:
        compute_coefficients = hidden_causes.draw_effect_shape(name, conditions, rng)
        probe = (
            {name: effects[name]}
            if name in effects
            else {name: compute_coefficients(_PROBE_STRENGTH)}
        )
        direction = conditions.simulate_readings(probe, coarse=_COARSE_STEP_FACTOR) - base_readings
        residual_sizes.append(gauge.compute_projected_size(change, direction))
    return min(residual_sizes)


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
        plant = MACHINES[conditions.system]({n: a.ravel() for n, a in values.items()}, {}, {})
        start_runs = fitted._replace(q=q.reshape(-1, joints), v=v.reshape(-1, joints))
        readings = read_encoders(simulate_machine(plant, start_runs), plant, conditions.runs.times)
        readings = readings.reshape(runs, variants, -1)
        slopes = (readings[:, 1:] - readings[:, :1]) / _FINITE_DIFFERENCE_STEP
        # Rows are the samples of all runs one after another.
        parameter_columns = np.concatenate(slopes[:, : len(parameters)], axis=1).T
        state_columns = np.zeros((runs, slopes.shape[2], runs, 2 * joints))
        for run_index in range(runs):
            state_columns[run_index, :, run_index] = slopes[run_index, len(parameters) :].T
        columns = np.column_stack(
            [parameter_columns, state_columns.reshape(runs * slopes.shape[2], -1)]
        )
        self.bare = readings[:, 0].reshape(runs, len(conditions.runs.times), joints)
        self._basis = compute_orthonormal_basis(columns)

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


def record_case(case: BenchmarkCase) -> tuple[MachineRecordingConditions, Array]:
    """Simulate the recording of a case with all its runs, and add the sensor noise.

    Shapes: R runs, T samples, N joints.

    Args:
        case: case of the benchmark: its recording conditions and hidden causes.

    Returns:
        The recording conditions and the noisy encoder readings, (R, T, N).
    """
    conditions = restore_conditions(case.name, case.system, case.asked)
    hidden = case.effects
    foreign = case.kind == "foreign"
    plant = conditions.make_machine({} if foreign else hidden, hidden if foreign else {})
    readings = read_encoders(simulate_machine(plant, conditions.runs), plant, conditions.runs.times)
    rng = make_case_rng(case.name, "noise")
    return conditions, np.array([conditions.noise.add_to(run, rng) for run in readings])


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


def build_description(
    case: BenchmarkCase, conditions: MachineRecordingConditions
) -> dict[str, object]:
    """Build the description of the recording, as the document of a TOML file.

    It states what a user knows: units, constants or the model file, held-out runs and sometimes the
    noise, but neither the hidden causes nor the true parameters.

    Args:
        case: case of the benchmark: its recording conditions and hidden causes.
        conditions: recording conditions: parameters, commands, initial states and noise.
    """
    is_arm = case.system == "arm2"
    plant = MACHINES[case.system]
    noise_entry = {"noise": conditions.noise_sigmas} if case.stated else {}
    channels = {name: {"unit": "rad", **noise_entry} for name in plant.channels}
    inputs = (
        {f"u.{name}": {"unit": "N*m"} for name in plant.motors}
        if is_arm
        else {"goal": {"unit": "rad"}, "torque_enable": {"unit": "1"}}
    )
    first_held_out = case.runs - conditions.held_out
    runs = {str(number): {"held_out": True} for number in range(first_held_out, case.runs)}
    source_entry = {"model": MODEL_FILE_NAME} if is_arm else {"system": case.system}
    constants = {} if is_arm else {"constants": _get_stated_constants(conditions)}
    return {**source_entry, "channels": channels, "inputs": inputs, **constants, "runs": runs}


def _get_stated_constants(conditions: MachineRecordingConditions) -> dict[str, float]:
    """Return the parameters of a servo that its recording states and that are not fitted."""
    return {
        name: v for name, v in conditions.numbers.items() if name not in conditions.free_parameters
    }


def format_table(
    case: BenchmarkCase, conditions: MachineRecordingConditions, readings: Array
) -> str:
    """Format the recording as CSV text.

    Shapes: R runs, T samples, N joints.

    Args:
        case: case of the benchmark: its recording conditions and hidden causes.
        conditions: recording conditions: parameters, commands, initial states and noise.
        readings: encoder readings, (R, T, N).
    """
    plant, is_arm = MACHINES[case.system], case.system == "arm2"
    inputs = [f"u.{name}" for name in plant.motors] if is_arm else ["goal", "torque_enable"]
    lines = [",".join(["run", "t", *inputs, *plant.channels])]
    for number, run in enumerate(readings):
        for k, t in enumerate(conditions.runs.times.tolist()):
            commands = conditions.runs.commands[number, k].tolist() + ([] if is_arm else [1.0])
            cells = [t, *commands, *run[k].tolist()]
            lines.append(",".join([str(number), *(f"{value:.9g}" for value in cells)]))
    return "\n".join(lines) + "\n"


def write_case(case: BenchmarkCase, folder: Path) -> Path:
    """Write the recording, its description and, for an arm, its model file.

    Args:
        case: case of the benchmark: its recording conditions and hidden causes.
        folder: folder for the files.

    Returns:
        Path of the CSV file.
    """
    import tomli_w

    conditions, readings = record_case(case)
    if case.system == "arm2":
        (folder / MODEL_FILE_NAME).write_text(render_arm_mjcf(conditions.numbers), encoding="utf-8")
    path = folder / "recording.csv"
    path.write_text(format_table(case, conditions, readings), encoding="utf-8")
    description = tomli_w.dumps(build_description(case, conditions))
    path.with_suffix(".toml").write_text(description, encoding="utf-8")
    return path
