"""Write the causes found by explain back into the robot's own model file.

An MJCF keeps its author's text: only attributes change, each with a comment that states the reason.
Where this is impossible (elements that generate several elements, a URDF), MuJoCo writes the model,
with the same comments.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from sims.extended import Number
from sims.memory import release_free_memory
from sims.robot.causes import one_by_one
from sims.robot.changes import CLOSE, COULOMB, KEPT, ROUNDS, Applied, apply
from sims.robot.coupled import before
from sims.robot.document import Document
from sims.robot.markup import UnfitError, heading, number, numbers
from sims.robot.mjcf_out import Writer
from sims.robot.model import TENDON, Robot
from sims.robot.native import arm_of
from sims.robot.precise import unlike
from sims.robot.quiet import quiet
from sims.robot.stated import Statement, lacking
from sims.robot.urdf_out import UrdfWriter

Causes = Mapping[str, Mapping[str, Number]]
"""Coefficients by ``effect@place``, ``effect@*`` or ``effect``."""

SAME = 1e-12
"""Relative difference between numbers of a compiled model that counts as rounding."""

_SOFT_IN_URDF = (
    "friction.coulomb: a URDF cannot say that dry friction is stiff, and MuJoCo reads it in its "
    "soft form; extended.xml holds the stiff form"
)


@dataclass(frozen=True)
class Written:
    """Model files of a robot with causes applied.

    Attributes:
        xml: an MJCF that MuJoCo loads.
        urdf: a URDF, if the robot was read from one.
        said: notes about causes that the files cannot express, and about the written ones.
        applied: the model that `xml` describes.
    """

    xml: str | None
    urdf: str | None
    said: tuple[str, ...]
    applied: Applied = field(compare=False, repr=False)


def written(robot: Robot, causes: Causes, recording: str = "") -> Written:
    """Write causes into the robot's own model file.

    Args:
        robot: robot as read from its model file.
        causes: coefficients by ``effect@place``, ``effect@*`` or ``effect``.
        recording: title of the recording, for comments.

    Raises:
        InputError: the robot has no place of that name.
    """
    applied = apply(robot, causes, recording)
    said = list(applied.said)
    try:
        if robot.format != "mjcf":
            raise UnfitError("it is a URDF")
        if robot.actuator_tables:
            raise UnfitError("its actuators are the recording's")
        text = Edit(applied.robot, applied, recording, with_series(applied)).stated()
    except UnfitError as unfit:
        if robot.format == "mjcf":
            said.append(f"the MJCF is as MuJoCo writes it, not as {robot.path.name}: {unfit}")
        text = Edit(applied.robot, applied, recording, applied.text.encode()).stated()
    urdf = _urdf(robot, causes, recording, said) if robot.format == "urdf" else None
    return Written(text, urdf, tuple(said), applied)


def with_series(applied: Applied) -> bytes:
    """Render the model file with joints in series with its own, and tendons of coupled drives.

    Args:
        applied: model with the causes applied.

    Raises:
        UnfitError: the text does not contain a required joint or actuator.
    """
    robot = applied.robot
    text = robot.path.read_bytes()
    if not robot.series and not robot.coupled:
        return text
    document = Document(text, robot.path)
    if robot.coupled:
        _couple(document, applied)
    tags = {tag.attributes.get("name"): tag for tag in document.walk() if tag.name == "joint"}
    for second in (joint for joint in robot.spec.joints if joint.name in robot.series):
        first = tags.get(second.name.rpartition("_")[0])
        if first is None:
            raise UnfitError(f"no joint of its text is in series with {second.name}")
        first.after.append(_joint(second))
    return document.written().encode()


def _couple(document: Document, applied: Applied) -> None:
    """Add tendons, and let actuators drive them instead of their joints."""
    robot, model = applied.robot, applied.model
    tags = [child for tag in document.under("actuator") for child in document.children(tag)]
    if len(tags) != len(robot.actuators):
        raise UnfitError("the compiled model has other actuators")
    for name in robot.coupled:
        first = before(robot, name)
        assert first is not None
        known = {tag.attributes.get("name") for tag in document.walk() if tag.name == "joint"}
        if not {name, first.name} <= known:
            raise UnfitError(f"no joint of its text is called {name} or {first.name}")
        c = number(float(model.wrap_prm[arm_of(robot, name)]))
        joints = f'<joint joint="{name}" coef="1"/><joint joint="{first.name}" coef="{c}"/>'
        tendon = f'<fixed name="{name}{TENDON}">{joints}</fixed>'
        document.root.within.append(([], f"<tendon>{tendon}</tendon>"))
        for actuator in (a for a in robot.actuators if a.joint == name):
            tags[actuator.id].removed |= {"joint", "jointinparent"}
            tags[actuator.id].new["tendon"] = f"{name}{TENDON}"


def _joint(second: Any) -> str:
    """Render a joint in series as an element that does not depend on the file's default classes."""
    kind = "slide" if str(second.type).endswith("SLIDE") else "hinge"
    plays = str(second.limited).endswith("TRUE")
    attributes = {
        "name": second.name,
        "type": kind,
        "axis": numbers(tuple(second.axis)),
        "pos": numbers(tuple(second.pos)),
        "limited": "true" if plays else "false",
        "actuatorfrclimited": "false",
    }
    if plays:
        attributes["range"] = numbers(tuple(second.range))
        attributes["solreflimit"] = numbers(tuple(second.solref_limit))
        attributes["solimplimit"] = numbers(tuple(second.solimp_limit))
    attributes |= dict.fromkeys(("damping", "frictionloss", "armature", "stiffness"), "0")
    said = " ".join(f'{name}="{value}"' for name, value in attributes.items())
    return f"<joint {said}/>"


def _urdf(robot: Robot, causes: Causes, recording: str, said: list[str]) -> str | None:
    """Render the URDF with the causes that it can express, and add notes about all others."""
    try:
        writer = UrdfWriter(robot, recording)
    except UnfitError as unfit:
        said.append(f"no URDF is written: {unfit}")
        return None
    lines = []
    for cause in one_by_one(robot, causes):
        answer = writer.write(cause)
        if answer:
            lines.append(f"{cause.told(recording)}: not in the URDF: {answer}")
        elif cause.effect == COULOMB and robot.friction_form == "stiff":
            lines.append(_SOFT_IN_URDF)
    lines = list(dict.fromkeys(lines))
    said += lines
    return writer.text(lines)


class Edit:
    """Writer of the wanted attributes into an MJCF text.

    Args:
        robot: robot with the text.
        applied: model that the text should compile to.
        recording: title of the recording.
        text: text of the model file.
    """

    def __init__(self, robot: Robot, applied: Applied, recording: str, text: bytes) -> None:
        self.robot, self.applied, self.recording, self.text = robot, applied, recording, text
        self.folder = robot.path.resolve().parent
        self.original = compiled(self._document().written())

    def _document(self) -> Document:
        """Parse the text, with asset folders that are valid from anywhere."""
        document = Document(self.text, self.robot.path)
        document.rooted(self.folder)
        return document

    def stated(self) -> str:
        """Return the text with all wanted attributes.

        Raises:
            UnfitError: the edited text does not compile to the wanted model.
        """
        # An element with comments needs a statement even if its numbers are in the text already.
        statements = {element: Statement(element) for element in self.applied.comments}
        model = self.original
        for _ in range(ROUNDS):
            for statement in lacking(model, self.applied.wanted, CLOSE):
                held = statements.setdefault(statement.element, Statement(statement.element))
                # Attributes that were written without effect need their related attributes.
                held.insisted = bool(held.values) or model is not self.original
                held.values |= statement.values
            text = self._written(list(statements.values()))
            model = compiled(text)
            if not lacking(model, self.applied.wanted, CLOSE):
                break
        differs = unlike(model, self.applied.model, SAME)
        if differs:
            raise UnfitError(f"its attributes do not say all ({differs})")
        return text

    def _written(self, statements: Sequence[Statement]) -> str:
        document = self._document()
        writer = Writer(document, self.original, self.applied.wanted)
        for statement in statements:
            writer.write(statement, self.applied.comments.get(statement.element, [KEPT]))
        document.root.within.insert(0, ([self._heading()], ""))
        return document.written()

    def _heading(self) -> str:
        """Format the comment at the top: the origin of the file, and notes."""
        fitted = f", with what was found in {self.recording}" if self.recording else ""
        return heading([f"{self.robot.path.name}{fitted}", *self.applied.said])


def compiled(text: str) -> Any:
    """Compile an MJCF text.

    Raises:
        UnfitError: MuJoCo rejects the text.
    """
    import mujoco

    try:
        with quiet():
            model = mujoco.MjSpec.from_string(text).compile()
    except ValueError as error:
        raise UnfitError(f"MuJoCo refuses it: {' '.join(str(error).split())}") from None
    # The discarded spec held all meshes a second time.
    release_free_memory()
    return model
