"""Write a robot's model file with its causes.

An MJCF keeps its author's text: only attributes change, each with a comment that states the reason.
Where this is impossible (elements that generate several elements, a URDF), MuJoCo writes the model,
with the same comments.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from sims.robot.export.apply_causes import ModifiedModel, apply_causes
from sims.robot.export.mjcf_attributes import (
    KEPT_VALUE_NOTE,
    MAX_CORRECTION_ROUNDS,
    ROUNDING_TOLERANCE,
    AttributeStatement,
    find_missing_statements,
)
from sims.robot.export.mjcf_document import MjcfDocument, compile_mjcf
from sims.robot.export.mjcf_writer import (
    MjcfWriter,
    format_heading,
    render_with_added_elements,
)
from sims.robot.export.model_comparison import EQUAL_NUMBERS_TOLERANCE, find_first_difference
from sims.robot.export.xml_editing import (
    NotEditableError,
)
from sims.robot.fitted_causes import CauseCoefficients
from sims.robot.robot_model import RobotModel


@dataclass(frozen=True)
class WrittenModelFiles:
    """Model files of a robot with causes applied.

    Attributes:
        xml: an MJCF that MuJoCo loads.
        urdf: a URDF, if the robot was read from one.
        notes: notes about causes that the files cannot express, and about the written ones.
        applied: the model that `xml` describes.
    """

    xml: str | None
    urdf: str | None
    notes: tuple[str, ...]
    applied: ModifiedModel = field(compare=False, repr=False)


def write_model_files(
    robot: RobotModel, causes: CauseCoefficients, recording: str = ""
) -> WrittenModelFiles:
    """Write causes into the robot's own model file.

    * An MJCF keeps its text and gets changed attributes.
    * If this is impossible, because its text generates elements, or because a recording adds
      actuators, MuJoCo writes the MJCF.
    * For a URDF, MuJoCo writes an MJCF; a URDF is written in addition, with the causes that it can
      state.

    Args:
        robot: robot as read from its model file.
        causes: coefficients by ``effect@place``, ``effect@*`` or ``effect``.
        recording: title of the recording, for comments.

    Raises:
        InputError: the robot has no place of that name.
    """
    applied = apply_causes(robot, causes, recording)
    notes = list(applied.notes)
    try:
        if robot.format != "mjcf":
            raise NotEditableError("it is a URDF")
        if robot.actuator_tables:
            raise NotEditableError("its actuators are the recording's")
        text = MjcfEditor(
            applied.robot,
            applied,
            recording,
            render_with_added_elements(applied.robot, applied.model),
        ).to_text()
    except NotEditableError as unfit:
        if robot.format == "mjcf":
            notes.append(f"the MJCF is as MuJoCo writes it, not as {robot.path.name}: {unfit}")
        text = MjcfEditor(applied.robot, applied, recording, applied.text.encode()).to_text()
    urdf = None
    if robot.format == "urdf":
        # This module imports SciPy, which takes long.
        from sims.robot.export.urdf_writer import render_urdf

        urdf = render_urdf(robot, causes, recording, notes)
    return WrittenModelFiles(text, urdf, tuple(notes), applied)


class MjcfEditor:
    """Writer of the wanted attributes into an MJCF text."""

    def __init__(
        self, robot: RobotModel, applied: ModifiedModel, recording: str, text: bytes
    ) -> None:
        """Compile the document before its attributes change, as a reference for what must change.

        Args:
            robot: robot with the text.
            applied: model that the text should compile to.
            recording: title of the recording.
            text: text of the model file.
        """
        self.robot, self.applied, self.recording, self.text = robot, applied, recording, text
        self.folder = robot.path.resolve().parent
        self.original = compile_mjcf(self._parse_document().to_text())

    def _parse_document(self) -> MjcfDocument:
        """Parse the text, with asset folders that are valid from anywhere."""
        document = MjcfDocument(self.text, self.robot.path)
        document.make_paths_absolute(self.folder)
        return document

    def to_text(self) -> str:
        """Return the text with all wanted attributes, checked by compiling it.

        MuJoCo derives its numbers from attributes in many ways, so a change may have no effect, or
        change other numbers too. So in each of at most `MAX_CORRECTION_ROUNDS` rounds:

        1. Find the attributes whose numbers in the compiled text differ from the wanted ones, and
           add them to those that are to be written.
        2. Write all of them into the original text, and compile it.

        Raises:
            NotEditableError: the edited text does not compile to the wanted model.
        """
        # An element with comments needs a statement even if its numbers are in the text already.
        statements = {element: AttributeStatement(element) for element in self.applied.comments}
        model = self.original
        for _ in range(MAX_CORRECTION_ROUNDS):
            # 1. Differences.
            for statement in find_missing_statements(
                model, self.applied.target_values, ROUNDING_TOLERANCE
            ):
                element_statement = statements.setdefault(
                    statement.element, AttributeStatement(statement.element)
                )
                # Attributes that were written without effect, or that another change has altered
                # (in a round after the first), need their related attributes.
                had_no_effect = bool(element_statement.values)
                is_later_round = model is not self.original
                element_statement.insisted = had_no_effect or is_later_round
                element_statement.values |= statement.values
            # 2. New text.
            text = self._render_document(list(statements.values()))
            model = compile_mjcf(text)
            if not find_missing_statements(model, self.applied.target_values, ROUNDING_TOLERANCE):
                break
        difference = find_first_difference(model, self.applied.model, EQUAL_NUMBERS_TOLERANCE)
        if difference:
            raise NotEditableError(f"its attributes do not state everything ({difference})")
        return text

    def _render_document(self, statements: Sequence[AttributeStatement]) -> str:
        """Return the text of the document with the statements, their comments and a heading.

        The comments of an element name the causes that change it. An element without a cause has a
        statement because another change would alter it, and its comment says so.

        Args:
            statements: attribute values to write, by element.
        """
        document = self._parse_document()
        writer = MjcfWriter(document, self.original, self.applied.target_values)
        for statement in statements:
            writer.write(statement, self.applied.comments.get(statement.element, [KEPT_VALUE_NOTE]))
        heading = format_heading(self.robot.path, self.recording, self.applied.notes)
        document.root.within.insert(0, ([heading], ""))
        return document.to_text()
