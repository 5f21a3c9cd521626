"""All cases that can be drawn, dispatched by system.

Ball, pendulum and slider are simulated by scipy and MuJoCo (`case_generation.case_sampling`), a
servo and a two-joint arm by their own equations of motion (`diagnosis_benchmark.machine_cases`).
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

from bench.diagnosis_benchmark.case_generation import case_sampling
from bench.diagnosis_benchmark.case_generation.recording_conditions import (
    ANY_CONDITIONS,
    BenchmarkCase,
    RequestedConditions,
)
from bench.diagnosis_benchmark.case_generation.reference_simulation import (
    SIMULATORS,
    UNMODELLED_CAUSES,
)
from bench.diagnosis_benchmark.machine_cases import hidden_causes, machine_case_files
from bench.diagnosis_benchmark.machine_cases import machine_case_sampling as machines
from sims import effects as library
from sims.systems.servo import Servo

ALL_SYSTEMS = (*case_sampling.SYSTEMS, *machines.MACHINE_NAMES)
"""Names of all systems."""
DEFAULT_SYSTEMS = case_sampling.SYSTEMS
"""Systems that are used if an experiment does not name any."""


class RecordingFiles(NamedTuple):
    """Recording as texts of files.

    Attributes:
        table: CSV text.
        description: TOML text.
        extra_files: texts of other files, by file name.
    """

    table: str
    description: str
    extra_files: Mapping[str, str]


def draw_case(
    kind: str,
    system: str,
    seed: int,
    effect: str | None = None,
    size: float | None = None,
    requested: RequestedConditions = ANY_CONDITIONS,
) -> BenchmarkCase | None:
    """Draw a case; see `bench.diagnosis_benchmark.case_generation.case_sampling.draw_case`.

    Args:
        kind: one of `KINDS`.
        system: one of `ALL_SYSTEMS`.
        seed: seed of the case.
        effect: hidden effect; None to draw it.
        size: size in units of the noise; None to draw it.
        requested: recording conditions that are not drawn.

    Returns:
        The case, or None if the hidden cause is not observable.
    """
    draw = machines.draw_case if system in machines.MACHINE_NAMES else case_sampling.draw_case
    return draw(kind, system, seed, effect, size, requested)


def list_hideable_effects(system: str) -> list[str]:
    """List the effects of the library that can be hidden in a system."""
    if system in machines.MACHINE_NAMES:
        return list(hidden_causes.EFFECTS_BY_MACHINE[system])
    return sorted(library.list_effects_for(SIMULATORS[system].system))


def list_unmodelled_causes(system: str) -> list[str]:
    """List the causes for a system that the library does not contain."""
    return list(
        hidden_causes.UNMODELLED_CAUSES
        if system in machines.MACHINE_NAMES
        else UNMODELLED_CAUSES[system]
    )


def find_equivalent_effects(case: BenchmarkCase, effect: str) -> frozenset[str]:
    """Return an effect and all effects that are equivalent to it in the recording of a case."""
    if case.system in machines.MACHINE_NAMES:
        return machines.find_equivalent_causes(case.system, effect)
    return case_sampling.find_equivalent_effects(case.system, case.driven, effect)


def list_coefficient_names(system: str, name: str) -> list[str]:
    """List the names of an effect's coefficients, in the order of the numbers in a case.

    Args:
        system: name of the system.
        name: name of the effect, with or without a place.
    """
    effect = library.get_effect(name.partition("@")[0])
    if system == "arm2":
        return [coefficient.name for coefficient in effect.coefficients]
    system_model = Servo.system if system == "servo" else SIMULATORS[system].system
    return [coefficient.name for coefficient in effect.on(system_model)]


def render_recording(case: BenchmarkCase) -> RecordingFiles:
    """Render the recording of a case as texts, for the process of a diagnoser.

    The process receives these texts and no path, so that it cannot find other files of the case.

    Args:
        case: the case; its true causes are not among the texts.
    """
    with tempfile.TemporaryDirectory() as folder:
        if case.system in machines.MACHINE_NAMES:
            path = machine_case_files.write_case(case, Path(folder))
        else:
            path = case_sampling.write_case(case, folder, truth=False)
        description = path.with_suffix(".toml")
        other_files = [
            file for file in sorted(Path(folder).iterdir()) if file not in (path, description)
        ]
        other_texts = {file.name: file.read_text("utf-8") for file in other_files}
        return RecordingFiles(path.read_text("utf-8"), description.read_text("utf-8"), other_texts)
