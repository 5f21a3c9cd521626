"""Data sheet as an MJCF default class, and a model that uses it and can be scored.

With it, the exported model can be scored on the same log (`simgap score`).

Comments state what MuJoCo cannot express. For a system, whose state is known at every sample, a dry
friction law that MuJoCo lacks is replaced by its mean over the runs, which is the best
approximation in MJCF.
"""

from __future__ import annotations

import re
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from os.path import relpath
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from bench.diagnosis.datasheet.datasheet_content import SheetContent
from sims import effects as library
from sims.core.effect import Friction
from sims.core.simulator import Array
from sims.core.system import RenderedModelFile, StateSnapshot
from sims.core.toml_validation import read_toml
from sims.extended_simulator import FittedValue
from sims.recording.recording import Run
from sims.recording.recording_description import get_description_path
from sims.robot.fitted_causes import collect_causes


@dataclass(frozen=True)
class ConstantsGroup:
    """Runs of a recording with equal constants.

    Attributes:
        name: Short name from the constants; empty if there are none.
        numbers: Parameters and constants.
        runs: Runs of the recording.
    """

    name: str
    numbers: Mapping[str, float]
    runs: tuple[Run, ...]


def group_runs_by_constants(sheet: SheetContent) -> list[ConstantsGroup]:
    """Group the runs with equal constants, such as one load, in the order of the recording.

    An MJCF model has fixed numbers, so each group needs its own model.

    Args:
        sheet: content of the data sheet, with the recording and the extended simulator.

    Returns:
        A group for each set of constants, with all numbers of its model by name. The later source
        of a number takes precedence: defaults of the system, constants of the recording, constants
        and fitted parameters of the extended simulator, constants of the runs.
    """
    by_constants: dict[tuple[tuple[str, float], ...], list[Run]] = {}
    for run in sheet.recording.runs:
        by_constants.setdefault(tuple(sorted(run.constants.items())), []).append(run)
    defaults = {c.name: c.value for c in sheet.subject.kind.constants}
    defaults |= {p.name: p.nominal for p in sheet.subject.kind.parameters}
    fitted_values = {name: number.value for name, number in sheet.extended.parameters.items()}
    numbers = {**defaults, **sheet.recording.constants, **sheet.extended.constants, **fitted_values}
    return [
        ConstantsGroup(
            "_".join(f"{name}{value:g}" for name, value in constants),
            {**numbers, **dict(constants)},
            tuple(runs),
        )
        for constants, runs in by_constants.items()
    ]


MOTOR_ON_THRESHOLD = 0.5
"""Value of a switching input above which the motor is on."""


def describe_log_for_model(
    sheet: SheetContent, group: ConstantsGroup, model: RenderedModelFile, stem: str, folder: Path
) -> Iterator[tuple[str, str]]:
    """Yield file name and text of a description of the log, in which its runs are marked held out.

    With it, the exported model can be scored on the same log, as scores are computed on held-out
    runs. Signals get the names of the model. Runs in which the motor is off for a time are not
    marked, since the model cannot switch it. Nothing is yielded for a log of several files.

    Args:
        sheet: content of the data sheet, with the recording.
        group: runs with equal constants, for which the model is made.
        model: the MJCF model, with the names of its signals.
        stem: name of the model file without suffix.
        folder: folder of the sheet, to which paths are relative.
    """
    import tomli_w

    path = sheet.recording.path
    # Runs name their log only if several logs were joined; one description cannot refer to them.
    if path.suffix != ".csv" or any(run.log for run in sheet.recording.runs):
        return
    log_description = read_toml(get_description_path(path))
    file = relpath(path.resolve(), folder.resolve())
    document: dict[str, Any] = {
        "model": f"{stem}.xml",
        "title": f"{sheet.name} as {stem}.xml",
        "channels": {},
        "inputs": {},
        "runs": {
            run.name: {"held_out": True} for run in group.runs if _is_motor_always_on(run, model)
        },
    }
    for kind in ("channels", "inputs"):
        for name, description in log_description.get(kind, {}).items():
            # Signals that the model does not have, such as switches of the motor, are left out.
            if name in model.signals:
                document[kind][model.signals[name]] = {"file": file, "column": name, **description}
    yield f"{stem}.toml", tomli_w.dumps(document)


def _is_motor_always_on(run: Run, model: RenderedModelFile) -> bool:
    """Return whether the inputs that switch the motor are on all the time.

    Args:
        run: recorded run: times, channels and inputs.
        model: the MJCF model; inputs that it does not have are switches.
    """
    switches = [values for name, values in run.inputs.items() if name not in model.signals]
    return all(bool((values > MOTOR_ON_THRESHOLD).all()) for values in switches)


def compute_mean_friction_limit(
    sheet: SheetContent,
    group: ConstantsGroup,
    effect: type[Friction],
    numbers: Mapping[str, FittedValue],
) -> float:
    """Compute the mean limit of a friction law over the samples of some runs, in N or N·m.

    The limit is the largest force with which the friction holds the joint. MuJoCo has only a
    constant limit, of which the mean is the best approximation.

    Args:
        sheet: Content of the data sheet.
        group: Runs with equal constants.
        effect: Friction law.
        numbers: Its fitted coefficients by name; missing ones are zero.
    """
    limits = [_compute_friction_limits(sheet, group, run, effect, numbers) for run in group.runs]
    values = np.concatenate(limits)
    return float(values[np.isfinite(values)].mean())


def _compute_friction_limits(
    sheet: SheetContent,
    group: ConstantsGroup,
    run: Run,
    effect: type[Friction],
    numbers: Mapping[str, FittedValue],
) -> Array:
    """Compute the limit (T,) of a friction law at each of T samples of a run, as one batch.

    The limit is the largest dry friction at that position, velocity and input; its mean replaces a
    law that MuJoCo lacks.

    Args:
        sheet: content of the data sheet.
        group: runs with equal constants.
        run: one of these runs.
        effect: class of the friction law.
        numbers: its fitted coefficients by name; others are zero.
    """
    kind = sheet.subject.kind
    system = kind.system()
    (coordinate,) = system.coordinates
    position = run.channels[coordinate]
    rate = np.gradient(position, run.times)
    # The samples are the T elements of a batch, each with one state.
    shape = (len(position), 1)
    theta = np.array([[group.numbers[p.name] for p in kind.parameters]])
    coefficients = np.array(
        [
            numbers[coefficient.name].value if coefficient.name in numbers else 0.0
            for coefficient in effect.on(system)
        ]
    )
    # System, parameters, constants, times, positions, velocities and inputs of the batch.
    state = StateSnapshot(
        system,
        np.repeat(theta, len(position), axis=0),
        {
            constant.name: np.full(shape, group.numbers[constant.name])
            for constant in kind.constants
        },
        (run.times - run.times[0])[:, None],
        position[:, None],
        rate[:, None],
        {name: values[:, None] for name, values in run.inputs.items()},
    )
    batch_coefficients = np.broadcast_to(coefficients[:, None, None], (len(coefficients), *shape))
    limit: Array = effect().limit(batch_coefficients, state)[:, 0]
    return limit


CLASS_FILE = "class.xml"
"""File name of the classes."""


class MjcfFiles(NamedTuple):
    """MJCF files by name, and notes on what they cannot express."""

    contents: Mapping[str, str]
    notes: tuple[str, ...]


class _DefaultClass(NamedTuple):
    """Default class, notes on what it cannot express, and a model that uses it, if there is one."""

    text: str
    notes: Sequence[str]
    model: str = ""


def build_mjcf(sheet: SheetContent, folder: Path) -> MjcfFiles:
    """Build the class and the models that use it.

    Args:
        sheet: Content of the data sheet.
        folder: Folder of the files; the path of the log is relative to it.
    """
    from sims.robot.mujoco_messages import capture_mujoco_warnings

    with capture_mujoco_warnings():
        if sheet.subject.kind.has_model:
            return _build_robot_files(sheet)
        return _build_system_files(sheet, folder)


def _build_robot_files(sheet: SheetContent) -> MjcfFiles:
    """Build the MJCF default class of a joint of a robot, and the robot's model with this class.

    The class is for the joint of the sheet and its first actuator. The model is omitted if the
    class cannot be used in it.

    Args:
        sheet: content of the data sheet.

    Returns:
        Contents of the files by name, and notes to the user.
    """
    kind: Any = sheet.subject.kind
    causes = collect_causes(sheet.extended)
    actuator = next(iter(sheet.subject.actuators), None)
    rendered = _render_class(
        kind.robot, causes, sheet.subject.joint, actuator, make_class_name(sheet.name), sheet
    )
    files = {CLASS_FILE: _format_file(sheet, [rendered])}
    if rendered.model:
        files["model.xml"] = rendered.model
    return MjcfFiles(files, tuple(rendered.notes))


def _build_system_files(sheet: SheetContent, folder: Path) -> MjcfFiles:
    """Build a class, a model and a log description for each group of runs with equal constants.

    A system has no model file, so one is rendered and read as a robot, to which the effects are
    added as to any robot.

    Args:
        sheet: content of the data sheet.
        folder: folder of the sheet, to which the log descriptions refer.
    """
    from sims.robot.parsing.read_model_file import read_robot

    classes: list[_DefaultClass] = []
    files: dict[str, str] = {}
    for group in group_runs_by_constants(sheet):
        model = _render_model_file(sheet, group)
        if model is None:
            return MjcfFiles({}, (f"{sheet.subject.kind.name} has no form in MJCF",))
        name = make_class_name("_".join([sheet.name, group.name]) if group.name else sheet.name)
        with tempfile.TemporaryDirectory() as folder_name:
            path = Path(folder_name) / f"{sheet.subject.kind.name}.xml"
            path.write_text(model.text)
            robot = read_robot(path)
        causes, notes = _map_effects_to_model(sheet, group, model)
        rendered = _render_class(
            robot, causes, model.joint, model.actuator, name, sheet, (*model.notes, *notes)
        )
        classes.append(rendered)
        stem = f"model_{group.name}" if group.name else "model"
        if rendered.model:
            files[f"{stem}.xml"] = rendered.model
            files |= describe_log_for_model(sheet, group, model, stem, folder)
    distinct_notes = dict.fromkeys(line for rendered in classes for line in rendered.notes)
    return MjcfFiles({CLASS_FILE: _format_file(sheet, classes), **files}, tuple(distinct_notes))


def _render_model_file(sheet: SheetContent, group: ConstantsGroup) -> RenderedModelFile | None:
    """Render the system with the constants of one group of runs as an MJCF model.

    Return None if the constants give no valid model, or if the system has no form in MJCF.

    Args:
        sheet: content of the data sheet.
        group: runs with equal constants.
    """
    try:
        return sheet.subject.kind.system.model_file(group.numbers)
    except ZeroDivisionError:
        # The file may contain a value that was edited by hand.
        return None


def _render_class(
    robot: Any,
    causes: Mapping[str, Mapping[str, FittedValue]],
    joint: str,
    actuator: str | None,
    name: str,
    sheet: SheetContent,
    notes: Sequence[str] = (),
) -> _DefaultClass:
    """Write the fitted effects into a robot's model, and render its joint as a default class.

    The model that uses the class is left out, with a note, if its file cannot be edited.

    Args:
        robot: Robot whose model is changed.
        causes: Fitted coefficients by effect with its place.
        joint: Joint of the class.
        actuator: Actuator of the class; None for an undriven joint.
        name: Name of the class.
        sheet: Content of the data sheet.
        notes: Notes for the comment of the class.
    """
    from sims.robot.export.apply_causes import apply_causes
    from sims.robot.export.default_class import render_default_class, render_model_using_class
    from sims.robot.export.xml_editing import NotEditableError

    applied = apply_causes(robot, causes, sheet.extended.title)
    joint_id = robot.joint(joint).id
    actuator_id = robot.actuator(actuator).id if actuator else None
    class_notes = [*notes, *applied.notes]
    text = render_default_class(applied, joint_id, actuator_id, name, class_notes)
    try:
        model = render_model_using_class(robot, applied, joint_id, actuator_id, name, text)
    except NotEditableError as error:
        return _DefaultClass(
            text, [*class_notes, f"no model that uses the class is written: {error}"]
        )
    return _DefaultClass(text, class_notes, model)


def make_class_name(name: str) -> str:
    """Convert a name to one that is valid as a class name in XML and MuJoCo."""
    valid_name = re.sub(r"[^A-Za-z0-9_.-]+", "_", name).strip("_")
    return valid_name or "drive"


def _format_file(sheet: SheetContent, classes: Sequence[_DefaultClass]) -> str:
    """Format the classes as a file that MuJoCo loads and that others can include.

    Args:
        sheet: content of the data sheet.
        classes: the default classes.
    """
    title = sheet.recording.title or sheet.recording.path.stem
    heading = f"{make_class_name(sheet.name)}: data sheet from {title}; written by simgap datasheet"
    # An XML comment must not contain two hyphens in a row.
    escaped_heading = re.sub(r"-(?=-)", "- ", heading)
    inner = "\n".join(rendered.text for rendered in classes).replace("\n", "\n    ")
    return (
        f"<mujoco>\n  <!-- {escaped_heading} -->\n"
        f"  <default>\n    {inner}\n  </default>\n</mujoco>\n"
    )


def _map_effects_to_model(
    sheet: SheetContent, group: ConstantsGroup, model: RenderedModelFile
) -> tuple[dict[str, Mapping[str, FittedValue]], list[str]]:
    """Map the fitted effects of a system to the joint, actuator and channel of its MJCF model.

    The effects of a system have no place, as it has one joint. Effects of a robot need one, so
    each gets the name of the joint, actuator or channel on which it acts.

    A friction law that MuJoCo does not have becomes a constant dry friction (its mean over the
    runs), with a note. All such means are added to the fitted Coulomb friction, if there is one,
    because MuJoCo has one ``frictionloss`` for each joint.

    Args:
        sheet: content of the data sheet, with the fitted effects.
        group: runs with equal constants.
        model: the MJCF model.

    Returns:
        Coefficients by name of the effect with its place (``EFFECT@PLACE``), and the notes.
    """
    from sims.robot.model_field_effects import MODEL_FIELD_EFFECTS

    place_by_kind = {
        "joint": model.joint,
        "actuator": model.actuator,
        "channel": model.signals["q"],
    }
    coefficients_by_place: dict[str, Mapping[str, FittedValue]] = {}
    dry_friction, notes = 0.0, []
    for name, numbers in sheet.extended.effects.items():
        effect = library.get_effect(name)
        if issubclass(effect, Friction) and name not in MODEL_FIELD_EFFECTS:
            mean_limit = compute_mean_friction_limit(sheet, group, effect, numbers)
            dry_friction += mean_limit
            notes.append(
                f"{name}: MuJoCo has no such law; frictionloss is its mean over these runs, "
                f"{mean_limit:.4g} N·m"
            )
            continue
        # Place of the effect in the MJCF model; an effect on the environment has none.
        place = place_by_kind.get(effect.at, "")
        # A coefficient that is not in the file is zero.
        zero_value = FittedValue(0.0, "1", None, None)
        coefficients = {
            coefficient.name: numbers.get(coefficient.name, zero_value)
            for coefficient in effect.on(sheet.subject.kind.system)
        }
        coefficients_by_place[f"{name}@{place}" if place else name] = coefficients
    if dry_friction:
        key = f"friction.coulomb@{model.joint}"
        fitted_friction = coefficients_by_place.get(key, {}).get("coefficient")
        total = dry_friction + (fitted_friction.value if fitted_friction else 0.0)
        coefficients_by_place[key] = {"coefficient": FittedValue(total, "N*m", None, None)}
    return coefficients_by_place, notes
