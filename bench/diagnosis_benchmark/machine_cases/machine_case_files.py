"""Files of a machine case: recording, its description and the model file."""

from __future__ import annotations

from pathlib import Path

from bench.diagnosis_benchmark.case_generation.benchmark_case import BenchmarkCase
from bench.diagnosis_benchmark.machine_cases.machine_case_sampling import record_case
from bench.diagnosis_benchmark.machine_cases.machine_dynamics import MACHINES
from bench.diagnosis_benchmark.machine_cases.machine_recording_conditions import (
    MachineRecordingConditions,
)
from bench.diagnosis_benchmark.machine_cases.model_file import MODEL_FILE_NAME, render_arm_mjcf
from sims.core.simulator import Array


def build_description(
    case: BenchmarkCase, conditions: MachineRecordingConditions
) -> dict[str, object]:
    """Build the description of the recording, as the document of a TOML file.

    Args:
        case: the case.
        conditions: its recording conditions.
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
    first = case.runs - conditions.held_out
    runs = {str(number): {"held_out": True} for number in range(first, case.runs)}
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

    Args:
        case: the case.
        conditions: its recording conditions.
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
        case: the case.
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
