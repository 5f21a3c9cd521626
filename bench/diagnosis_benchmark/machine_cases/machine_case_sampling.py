"""Sampling of cases for servo and arm, and their recordings.

`draw_case` chooses what is hidden and how strongly. `record_case` simulates the recording.
"""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import numpy as np

from bench.diagnosis_benchmark.case_generation.benchmark_case import (
    BenchmarkCase,
    RecordedCase,
    draw_size,
    make_case_rng,
    name_case,
)
from bench.diagnosis_benchmark.case_generation.equivalent_effects import find_equivalent_effects
from bench.diagnosis_benchmark.case_generation.recording_conditions import (
    ANY_CONDITIONS,
    RequestedConditions,
)
from bench.diagnosis_benchmark.machine_cases import machine_effect_coefficients
from bench.diagnosis_benchmark.machine_cases.arm_model_file import (
    MODEL_FILE_NAME,
    render_arm_mjcf,
)
from bench.diagnosis_benchmark.machine_cases.machine_dynamics import MACHINES
from bench.diagnosis_benchmark.machine_cases.machine_effect_coefficients import EFFECTS_BY_MACHINE
from bench.diagnosis_benchmark.machine_cases.machine_effect_sizing import (
    compute_unexplained_size,
    find_sized_coefficients,
)
from bench.diagnosis_benchmark.machine_cases.machine_recording_conditions import (
    MachineRecordingConditions,
    draw_conditions,
)
from bench.diagnosis_benchmark.machine_cases.machine_simulation import (
    read_encoders,
    simulate_machine,
)
from sims.core.simulator import Channel
from sims.core.system import System
from sims.recording.recording import Recording, Run
from sims.recording.recording_description import ModelFileReference
from sims.systems.servo import Servo

MACHINE_NAMES = tuple(MACHINES)
"""Names of the machines."""


def draw_case(
    kind: str,
    system: str,
    seed: int,
    effect: str | None = None,
    size: float | None = None,
    requested: RequestedConditions = ANY_CONDITIONS,
) -> BenchmarkCase | None:
    """Draw the recording conditions, the hidden causes and their size for a case of a machine.

    The recording conditions are drawn first, then each cause is scaled to the requested size in
    units of the noise.

    Args:
        kind: clean (no cause), single, double, or foreign (a cause that the effect library does not
            contain).
        system: servo or arm2.
        seed: seed from which everything else follows.
        effect: hidden effect (the first one of a double case); None to draw it.
        size: size in units of the noise; None to draw it.
        requested: recording conditions that are given; those that are None are drawn.

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
        return case if kind == "clean" else None  # the two effects drawn are equivalent
    # The first function finds the coefficients of a cause, the second one computes the residual
    # that the best wrong answer leaves.
    return case.hide(
        hidden,
        target_size,
        lambda name: find_sized_coefficients(name, conditions, target_size, rng),
        lambda effects: compute_unexplained_size(kind, conditions, effects, target_size, rng),
    )


@lru_cache(maxsize=4)
def restore_conditions(
    name: str, system: str, requested: RequestedConditions = ANY_CONDITIONS
) -> MachineRecordingConditions:
    """Draw the recording conditions of a case, which follow from its name; the last 4 are cached.

    Args:
        name: name of the case.
        system: servo or arm2.
        requested: conditions that are given; those that are None are drawn.
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
    causes = (
        machine_effect_coefficients.UNMODELLED_CAUSES if is_foreign else EFFECTS_BY_MACHINE[system]
    )
    first_candidates = machine_effect_coefficients.list_effect_places(
        system, effect or str(rng.choice(causes))
    )
    first = str(rng.choice(first_candidates))
    if kind != "double":
        return (first,)
    candidates = machine_effect_coefficients.list_effect_places(system, str(rng.choice(causes)))
    candidates = tuple(name for name in candidates if name != first)
    # Without another candidate it is the first effect again, which is equivalent to itself.
    second = str(rng.choice(candidates)) if candidates else first
    equivalent_effects = find_equivalent_effects(system, driven=True, effect=first)
    return () if second in equivalent_effects else (first, second)


class _ArmSignals(System):
    """Signals of the arm, for the units in the description of its recording."""

    channels = tuple(Channel(name, "rad") for name in MACHINES["arm2"].channels)
    inputs = tuple(Channel(f"u.{name}", "N*m") for name in MACHINES["arm2"].motors)


def record_case(case: BenchmarkCase) -> RecordedCase:
    """Simulate the recording of a case, with sensor noise; that of an arm has a model file.

    It states what a user knows: units, constants or the model file, held-out runs and sometimes the
    noise, but neither the hidden causes nor the true parameters.

    Args:
        case: the case of a servo or an arm.

    Returns:
        The recording, its system for the units, and the model file as text for an arm.
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
        commands = list(conditions.runs.commands[number].T)
        if not is_arm:
            commands.append(np.ones_like(times))  # second input: torque switched on
        inputs = dict(zip((channel.name for channel in declared.inputs), commands, strict=True))
        channels = dict(zip(case.channels, recorded.T, strict=True))
        is_held_out = number >= case.runs - conditions.held_out
        # The recording states neither initial states nor constants of a run.
        runs.append(Run(str(number), times, channels, inputs, {}, {}, is_held_out))
    noise = conditions.noise.sigma if case.stated else {}
    # The constants of an arm are in its model file.
    if is_arm:
        model = ModelFileReference(Path(MODEL_FILE_NAME), {}, {})
        recording = Recording(Path(), case.system, "", {}, noise, tuple(runs), model=model)
        model_text = render_arm_mjcf(conditions.numbers)
        return RecordedCase(recording, declared, {MODEL_FILE_NAME: model_text})
    stated_constants = {
        name: value
        for name, value in conditions.numbers.items()
        if name not in conditions.free_parameters
    }
    recording = Recording(Path(), case.system, "", stated_constants, noise, tuple(runs))
    return RecordedCase(recording, declared)
