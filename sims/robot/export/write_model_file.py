"""Write a robot's model file with its causes.

An MJCF keeps its author's text: only attributes change, each with a comment that states the reason.
Where this is impossible (elements that generate several elements, a URDF), MuJoCo writes the model,
with the same comments.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from sims.robot.export.apply_causes import ModifiedModel, apply_causes
from sims.robot.export.mjcf_writer import MjcfEditor, render_with_added_elements
from sims.robot.export.xml_editing import NotEditableError
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
            notes.append(
                f"MuJoCo wrote the MJCF, so it lacks the comments and order of {robot.path.name}, "
                f"which cannot be edited: {unfit}"
            )
        text = MjcfEditor(applied.robot, applied, recording, applied.text.encode()).to_text()
    urdf = None
    if robot.format == "urdf":
        # This module imports SciPy, which takes 0.1 s, and only robots from a URDF need it.
        from sims.robot.export.urdf_writer import render_urdf

        urdf = render_urdf(robot, causes, recording, notes)
    return WrittenModelFiles(text, urdf, tuple(notes), applied)
