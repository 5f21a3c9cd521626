"""Extended model files of a robot, and the lines that differ from its model file."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from difflib import SequenceMatcher
from typing import TYPE_CHECKING, Any, NamedTuple

from bench.diagnosis.report.report_data import ModelFileChange
from sims.core.freed_memory import release_free_memory
from sims.core.plain_values import append_unit
from sims.extended_simulator import ExtendedSimulator, FittedValue

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
        The selected causes, and a line for each number that is left out.
    """
    selected_causes: dict[str, Mapping[str, FittedValue]] = {}
    causes, left_out = _leave_out_base_effects(causes, base_joints)
    for effect, coefficients in causes.items():
        if effect.startswith("numerics."):
            selected_causes[effect] = coefficients
            continue
        # Each place of a family is handled alone; coefficients of one place belong together.
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
            # A number that was never fitted has the value of the model file.
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


def collect_causes(extended: ExtendedSimulator) -> dict[str, Mapping[str, FittedValue]]:
    """Collect the fitted changes of a robot as coefficients by effect.

    They are numbers of its model file that the user freed for the fit, diagnosed effects, and the
    time step and other options of the integrator if they differ from those of the file.

    Args:
        extended: extended simulator of a robot, with the fitted values.
    """
    kind: Any = extended.kind
    causes: dict[str, Mapping[str, FittedValue]] = {}
    for effect in kind.system.freed_effects:
        names = [coefficient.name for coefficient in effect.coefficients]
        # A freed number is a parameter with the name of its effect, and of its coefficient if there
        # are several.
        parameters = (
            [effect.name] if len(names) == 1 else [f"{effect.name}.{name}" for name in names]
        )
        causes[effect.name] = {
            name: extended.parameters[parameter]
            for name, parameter in zip(names, parameters, strict=True)
        }
    return {**causes, **extended.effects, **_list_numerics_causes(kind)}


def _list_numerics_causes(kind: Any) -> dict[str, Mapping[str, FittedValue]]:
    """Return the options of the model as causes, if they differ from those of the model file.

    The step is in seconds; an option that is a word in the file has its MuJoCo number. They have no
    intervals because they are chosen, not fitted.
    """
    from sims.robot.integrator_settings import list_changed_options

    return {
        effect: {effect.removeprefix("numerics."): make_option_value(effect, *numbers)}
        for effect, numbers in list_changed_options(kind.robot, kind.numerics).items()
    }


def make_option_value(effect: str, stated: float, number: float) -> FittedValue:
    """Return the value of a changed option of the model file, which is chosen and has no interval.

    Args:
        effect: Effect that names the option, such as ``numerics.impratio``.
        stated: Number in the model file.
        number: Number that replaces it.
    """
    unit = "s" if effect == "numerics.step" else "1"
    return FittedValue(float(number), unit, None, None, stated=float(stated), total=float(number))


MIN_UNCHANGED_SHARE = 0.5
"""Minimum share of unchanged elements; with fewer, the file counts as rewritten and old lines are
not shown.
"""
FITTED_COMMENT_MARKER = ", fitted to "
"""Text that marks comments about a cause."""
_COMMENT = re.compile(r"<!--\s*(.*?)\s*-->")
_PART = re.compile(r"<!--.*?-->|<[^>]*>", re.DOTALL)
_HEAD = re.compile(r"<(\w+)")
_NAME = re.compile(r"\bname\s*=\s*[\"']([^\"']*)")


def find_model_file_changes(before: str, after: str) -> tuple[ModelFileChange, ...]:
    """Find the changed lines of a model file, in its order.

    The files are compared element by element. If hardly anything is equal, the file was rewritten
    (for example from another format): then the elements with a comment are the changes.

    Args:
        before: Text of the file; empty if there is none of the same format.
        after: Text of the extended file, where comments precede the elements that they describe.
    """
    old_elements, new_elements = _split_into_elements(before), _split_into_elements(after)
    matcher = SequenceMatcher(None, old_elements, new_elements, autojunk=False)
    if matcher.ratio() < MIN_UNCHANGED_SHARE:
        return tuple(_list_commented_elements(new_elements))
    changes: list[ModelFileChange] = []
    for kind, old_begin, old_end, new_begin, new_end in matcher.get_opcodes():
        if kind != "equal":
            changes += _compare_blocks(
                old_elements[old_begin:old_end], new_elements[new_begin:new_end]
            )
    return tuple(changes)


def _split_into_elements(text: str) -> list[str]:
    """Split the text into tags and comments, whatever the line breaks."""
    return [" ".join(part.split()) for part in _PART.findall(text)]


def _compare_blocks(old: Sequence[str], new: Sequence[str]) -> Iterator[ModelFileChange]:
    """Yield the changes of a block of elements, each with the comments before it.

    With equal counts, each new element replaces the old one at its position. Otherwise the first
    new element stands for all old ones; a block without new elements was removed.

    Args:
        old: lines of the block in the user's file, one for each element.
        new: lines of the block in the extended file, with comments before elements.
    """
    elements = list(_pair_with_comments(new))
    lines_before = list(old)
    if len(old) != len(elements):
        # All old elements stand before the first new one.
        lines_before = ["\n".join(old), *[""] * (len(elements) - 1)]
    if elements:
        for line_before, (line, comment) in zip(lines_before, elements, strict=True):
            yield ModelFileChange(_format_element(line), line_before, line, comment)
    # The block was removed.
    elif old:
        yield ModelFileChange(_format_element(old[0]), "\n".join(old), "")


def _list_commented_elements(lines: Sequence[str]) -> Iterator[ModelFileChange]:
    """Yield the elements with a comment, of a rewritten file."""
    for line, comment in _pair_with_comments(lines):
        if comment:
            yield ModelFileChange(_format_element(line), "", line, comment)


def _pair_with_comments(lines: Sequence[str]) -> Iterator[tuple[str, str]]:
    """Yield each XML element (a line) with the comments before it that explain a fitted value.

    Args:
        lines: tags and comments of the file, one each; a comment precedes its element.
    """
    comments: list[str] = []
    for line in lines:
        match = _COMMENT.fullmatch(line)
        if match is None:
            yield line, "; ".join(comments)
            comments = []
        # Other comments, such as one on the whole file, do not describe the next element.
        elif FITTED_COMMENT_MARKER in match[1]:
            comments.append(match[1])


def _format_element(line: str) -> str:
    """Format the element of a line of XML, such as ``joint elbow``."""
    head, name = _HEAD.search(line), _NAME.search(line)
    return " ".join(match[1] for match in (head, name) if match)
