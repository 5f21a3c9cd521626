"""Files of a machine case: recording, its description and the correct model file of an arm."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from bench.diagnosis_benchmark.case_generation.recording_conditions import BenchmarkCase
from bench.diagnosis_benchmark.machine_cases.machine_case_sampling import record_case
from bench.diagnosis_benchmark.machine_cases.machine_dynamics import MACHINES
from bench.diagnosis_benchmark.machine_cases.machine_recording_conditions import (
    MachineRecordingConditions,
)
from sims.core.simulator import Array

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
