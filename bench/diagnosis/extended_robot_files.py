"""Extended model files of a robot, with the fitted causes that a model file may contain."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

from sims.core.freed_memory import release_free_memory
from sims.core.user_messages import append_unit
from sims.extended_simulator import ExtendedSimulator, FittedValue
from sims.robot.fitted_causes import collect_causes

if TYPE_CHECKING:
    from sims.robot.export.write_model_file import WrittenModelFiles


class ExtendedRobotFiles(NamedTuple):
    """Extended model files of a robot.

    Attributes:
        contents: Content by file name.
        notes: Notes on the files and on what they cannot express, one line each.
        before, after: Text of the user's file, and of the extended file in the same format.
    """

    contents: Mapping[str, str]
    notes: tuple[str, ...] = ()
    before: str = ""
    after: str = ""


def build_robot_files(extended: ExtendedSimulator) -> ExtendedRobotFiles:
    """Build the extended model files of a robot; none for a system that is not a robot.

    The files are loaded again and compared with the intended model; on a mismatch no file is
    returned.

    Args:
        extended: extended simulator of a diagnosis, with the fitted changes.
    """
    kind: Any = extended.kind
    if kind is None or not kind.has_model:
        return ExtendedRobotFiles({})
    from sims.robot.export.round_trip_check import check_written_files
    from sims.robot.export.write_model_file import write_model_files
    from sims.robot.export.xml_editing import strip_heading
    from sims.robot.parsing.read_model_file import restore_floating_joints

    # Models with all meshes are compiled several times, which needs the memory of the search.
    release_free_memory()
    causes, left_out = select_written_causes(collect_causes(extended), kind.robot.base_joints)
    # The simulator has slides and hinges in place of floating joints whose pose is recorded; the
    # written file has the floating joints again.
    robot = restore_floating_joints(kind.robot)
    written_files = write_model_files(robot, causes, extended.title)
    try:
        check_written_files(robot, causes, written_files)
    except RuntimeError as error:
        # An error here must not discard the result of minutes of search.
        return ExtendedRobotFiles(
            {}, (f"no model file is written because of an internal error of simgap: {error}",)
        )
    try:
        before = kind.robot.path.read_text(encoding="utf-8", errors="replace")
    except OSError:
        # The file was deleted after it was read; changes are then shown without the old text.
        before = ""
    after = written_files.xml if written_files.urdf is None else written_files.urdf
    return ExtendedRobotFiles(
        contents=_collect_written_files(written_files),
        notes=(*left_out, *written_files.notes),
        before=before,
        after=strip_heading(after or ""),
    )


def select_written_causes(
    causes: Mapping[str, Mapping[str, FittedValue]],
    base_joints: Collection[str] = (),
) -> tuple[dict[str, Mapping[str, FittedValue]], tuple[str, ...]]:
    """Select the causes that a model file may contain.

    - Options of the integrator are always written.
    - Effects at the coordinates of a floating body are left out, as the file does not have them.
    - Numbers at a bound of their range, or without an interval, are not results and are left out,
      with all coefficients of their effect at that place. Zero at a lower bound is a result.

    Args:
        causes: Coefficients by effect. A coefficient of an effect at several places (a family) is
            named ``COEFFICIENT@PLACE``.
        base_joints: Names of the coordinates of floating bodies.

    Returns:
        The selected causes, and a line for each effect and place that is left out, with a number
        that is not a result.
    """
    selected_causes: dict[str, Mapping[str, FittedValue]] = {}
    causes, left_out = _leave_out_base_effects(causes, base_joints)
    for effect, coefficients in causes.items():
        if effect.startswith("numerics."):
            selected_causes[effect] = coefficients
            continue
        # Each place of a family is handled alone; coefficients of one place belong together. So one
        # number that is not a result, by its place, leaves out all numbers of this place.
        unidentified = {
            _get_place(key): fitted_value
            for key, fitted_value in coefficients.items()
            if not fitted_value.is_result
        }
        selected_values = {
            key: fitted_value
            for key, fitted_value in coefficients.items()
            if _get_place(key) not in unidentified
        }
        if selected_values:
            selected_causes[effect] = selected_values
        for place, fitted_value in unidentified.items():
            # A number that was never fitted is zero and changes nothing, so it needs no line.
            if fitted_value.at_bound is None and not fitted_value.value:
                continue
            end = {"low": "lower", "high": "upper", None: ""}[fitted_value.at_bound]
            reason = f"is at the {end} bound of its range" if end else "has no finite interval"
            name = effect if not place else f"{effect.partition('@')[0]}@{place}"
            value_text = append_unit(f"{fitted_value.value:.3g}", fitted_value.unit)
            left_out.append(
                f"{name} is not written to the model file: its value, {value_text}, {reason} and "
                "is not a result"
            )
    return selected_causes, tuple(left_out)


def _get_place(name: str) -> str:
    """Return the place of an effect or a coefficient, such as a joint; empty if it names none."""
    return name.partition("@")[2]


def _leave_out_base_effects(
    causes: Mapping[str, Mapping[str, FittedValue]], base_joints: Collection[str]
) -> tuple[dict[str, Mapping[str, FittedValue]], list[str]]:
    """Leave out effects at the coordinates of floating bodies, and return a line for each.

    A floating body has one free joint in MuJoCo, without friction or damping of single coordinates.

    Args:
        causes: fitted coefficients by effect.
        base_joints: names of the coordinates of floating bodies.

    Returns:
        The remaining coefficients by effect, and the lines.
    """
    remaining: dict[str, Mapping[str, FittedValue]] = {}
    left_out = []
    for name, coefficients in causes.items():
        effect, _, effect_place = name.partition("@")
        remaining_values = {}
        for key, fitted_value in coefficients.items():
            # The coefficient of a family has its own place.
            place = _get_place(key) or effect_place
            if place not in base_joints:
                remaining_values[key] = fitted_value
                continue
            value_text = append_unit(f"{fitted_value.value:.4g}", fitted_value.unit)
            left_out.append(
                f"{effect}@{place}: {value_text}, not in the file: MuJoCo has no such element at a "
                "free joint"
            )
        if remaining_values:
            remaining[name] = remaining_values
    return remaining, left_out


def _collect_written_files(written_files: WrittenModelFiles) -> dict[str, str]:
    """Return the content of each extended model file that was written, by file name."""
    contents = {"extended.xml": written_files.xml, "extended.urdf": written_files.urdf}
    return {name: content for name, content in contents.items() if content is not None}
