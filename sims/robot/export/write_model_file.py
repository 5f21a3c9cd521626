"""Write a robot's model file with its causes, or a default class with constants of a drive.

An MJCF keeps its author's text: only attributes change, each with a comment that states the reason.
Where this is impossible (elements that generate several elements, a URDF), MuJoCo writes the model,
with the same comments.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from sims.core.freed_memory import release_free_memory
from sims.extended_simulator import FittedValue
from sims.robot.coupled_drives import find_preceding_joint
from sims.robot.export.apply_causes import (
    COULOMB,
    KEPT_VALUE_NOTE,
    MAX_CORRECTION_ROUNDS,
    ROUNDING_TOLERANCE,
    ModifiedModel,
    apply_causes,
)
from sims.robot.export.mjcf_attributes import (
    ATTRIBUTES_BY_KIND,
    AttributeStatement,
    ModelElement,
    UnstatableCauseError,
    Values,
    find_missing_statements,
    list_all_attributes,
)
from sims.robot.export.mjcf_document import (
    FILE_ELEMENTS,
    MjcfDocument,
    NotEditableError,
    format_comment,
    format_element,
    format_heading,
    format_number,
    format_numbers,
)
from sims.robot.export.mjcf_writer import SHORTCUT_ATTRIBUTES, MjcfWriter, format_attributes
from sims.robot.export.model_comparison import find_first_difference
from sims.robot.fitted_causes import expand_families
from sims.robot.model_field_effects import get_coupling_address, get_write_order
from sims.robot.mujoco_messages import capture_mujoco_warnings
from sims.robot.robot_model import COUPLING_TENDON_SUFFIX, RobotModel

CauseCoefficients = Mapping[str, Mapping[str, FittedValue]]
"""Coefficients by ``effect@place``, ``effect@*`` or ``effect``."""

EQUAL_NUMBERS_TOLERANCE = 1e-12
"""Relative difference between numbers of a compiled model that counts as rounding."""

_SOFT_FRICTION_URDF_NOTE = (
    "friction.coulomb: a URDF cannot state that dry friction is stiff, and MuJoCo reads it in its "
    "soft form; extended.xml has the stiff form"
)


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

    An MJCF keeps its text and gets changed attributes. If this is impossible, or for a URDF,
    MuJoCo writes the MJCF; a URDF is written in addition, with the causes that it can state.

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
            applied.robot, applied, recording, render_with_added_elements(applied)
        ).to_text()
    except NotEditableError as unfit:
        if robot.format == "mjcf":
            notes.append(f"the MJCF is as MuJoCo writes it, not as {robot.path.name}: {unfit}")
        text = MjcfEditor(applied.robot, applied, recording, applied.text.encode()).to_text()
    urdf = _render_urdf(robot, causes, recording, notes) if robot.format == "urdf" else None
    return WrittenModelFiles(text, urdf, tuple(notes), applied)


def render_with_added_elements(applied: ModifiedModel) -> bytes:
    """Return the text of the model file with the elements that causes add, and a fixed base.

    These elements are joints in series (second joints of flexible or slack drives), tendons of
    coupled drives, and pairs of geoms with contact parameters of their own. Their numbers are
    written afterwards. Without any of them, the text is unchanged.

    Raises:
        NotEditableError: the text does not contain a required joint, actuator or geom.
    """
    robot = applied.robot
    text = robot.path.read_bytes()
    has_fixed_base = robot.engine_table.get("fix_base", False)
    if not robot.series and not robot.coupled and not has_fixed_base and not robot.spec.pairs:
        return text
    document = MjcfDocument(text, robot.path)
    # Free joints and keyframes are removed, as by `parsing.compile_repairs.fix_bases`.
    for tag in document.walk() if has_fixed_base else ():
        is_free = tag.name == "joint" and tag.attributes.get("type") == "free"
        if tag.name in ("freejoint", "keyframe") or is_free:
            tag.text = b""
    if robot.coupled:
        _write_couplings(document, applied)
    _add_pairs(document, robot)
    tags = {tag.attributes.get("name"): tag for tag in document.walk() if tag.name == "joint"}
    for series_joint in (joint for joint in robot.spec.joints if joint.name in robot.series):
        joint_tag = tags.get(series_joint.name.rpartition("_")[0])
        if joint_tag is None:
            raise NotEditableError(f"no joint of its text is in series with {series_joint.name}")
        joint_tag.after.append(_render_series_joint(series_joint))
    return document.to_text().encode()


def _write_couplings(document: MjcfDocument, applied: ModifiedModel) -> None:
    """Write the couplings of joints: a fixed tendon for each, which the joint's actuators drive.

    The length of the tendon is q + c q_first, with the coefficient c and the preceding joint
    q_first.

    Args:
        document: the MJCF, changed in place.
        applied: model with the causes, which include the couplings.

    Raises:
        NotEditableError: the text lacks a joint or an actuator of the compiled model.
    """
    robot, model = applied.robot, applied.model
    tags = [child for tag in document.find_elements("actuator") for child in document.children(tag)]
    if len(tags) != len(robot.actuators):
        raise NotEditableError("the compiled model has other actuators")
    for name in robot.coupled:
        first = find_preceding_joint(robot, name)
        assert first is not None
        joint_names = {tag.attributes.get("name") for tag in document.walk() if tag.name == "joint"}
        if not {name, first.name} <= joint_names:
            raise NotEditableError(f"no joint of its text is called {name} or {first.name}")
        c = format_number(float(model.wrap_prm[get_coupling_address(robot, name)]))
        joints = f'<joint joint="{name}" coef="1"/><joint joint="{first.name}" coef="{c}"/>'
        tendon = f'<fixed name="{name}{COUPLING_TENDON_SUFFIX}">{joints}</fixed>'
        document.root.within.append(([], f"<tendon>{tendon}</tendon>"))
        for actuator in (a for a in robot.actuators if a.joint == name):
            tags[actuator.id].removed |= {"joint", "jointinparent"}
            tags[actuator.id].new["tendon"] = f"{name}{COUPLING_TENDON_SUFFIX}"


def _add_pairs(document: MjcfDocument, robot: RobotModel) -> None:
    """Write the elements `<pair>` of a robot that the text lacks.

    A pair states the parameters of one contact; it refers to its geoms by their names.

    Args:
        document: the MJCF, changed in place.
        robot: the robot with its pairs.

    Raises:
        NotEditableError: a geom has no name in the text.
    """
    existing_pairs = document.find_pairs()
    names = {tag.attributes.get("name") for tag in document.walk() if tag.name == "geom"}
    for pair in robot.spec.pairs:
        geoms = [pair.geomname1, pair.geomname2]
        if frozenset(geoms) in existing_pairs:
            continue
        if not set(geoms) <= names:
            raise NotEditableError(f"a geom of the contact {pair.name} has no name in its text")
        attributes = {"name": pair.name, "geom1": geoms[0], "geom2": geoms[1]}
        attributes["condim"] = str(pair.condim)
        for name in ("friction", "solref", "solimp"):
            attributes[name] = format_numbers(tuple(getattr(pair, name)))
        attributes |= {name: format_number(getattr(pair, name)) for name in ("margin", "gap")}
        pair_text = format_element("pair", attributes)
        document.root.within.append(([], f"<contact>{pair_text}</contact>"))


def _render_series_joint(second: Any) -> str:
    """Render a joint in series as an MJCF element, with all attributes stated.

    The file's default classes then have no influence on it. `is_limited` is whether its range is
    limited, which represents backlash.
    """
    kind = "slide" if str(second.type).endswith("SLIDE") else "hinge"
    is_limited = str(second.limited).endswith("TRUE")
    attributes = {
        "name": second.name,
        "type": kind,
        "axis": format_numbers(tuple(second.axis)),
        "pos": format_numbers(tuple(second.pos)),
        "limited": "true" if is_limited else "false",
        "actuatorfrclimited": "false",
    }
    if is_limited:
        attributes["range"] = format_numbers(tuple(second.range))
        attributes["solreflimit"] = format_numbers(tuple(second.solref_limit))
        attributes["solimplimit"] = format_numbers(tuple(second.solimp_limit))
    attributes |= dict.fromkeys(("damping", "frictionloss", "armature", "stiffness"), "0")
    return format_element("joint", attributes)


def _render_urdf(
    robot: RobotModel, causes: CauseCoefficients, recording: str, notes: list[str]
) -> str | None:
    """Render the URDF with the causes that it can express, and add notes about all others.

    Args:
        robot: the robot as read from its URDF.
        causes: coefficients of all causes.
        recording: title of the recording, for comments.
        notes: notes for the user, extended in place.
    """
    # Importing scipy.spatial takes 0.1 s, and only robots from a URDF need it.
    from sims.robot.export.urdf_writer import UrdfWriter

    try:
        writer = UrdfWriter(robot, recording)
    except NotEditableError as unfit:
        notes.append(f"no URDF is written: {unfit}")
        return None
    lines = []
    fitted_causes = expand_families(robot, causes)
    for cause in sorted(fitted_causes, key=lambda entry: get_write_order(entry.effect)):
        try:
            writer.write(cause)
        except UnstatableCauseError as reason:
            lines.append(f"{cause.format(recording)}: not in the URDF: {reason}")
            continue
        if cause.effect == COULOMB and robot.friction_form == "stiff":
            lines.append(_SOFT_FRICTION_URDF_NOTE)
    lines = list(dict.fromkeys(lines))
    notes += lines
    return writer.to_text(lines)


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
        change other numbers too. So the attributes are written, the text is compiled, and what
        still differs is written as well, for at most `MAX_CORRECTION_ROUNDS` rounds.

        Raises:
            NotEditableError: the edited text does not compile to the wanted model.
        """
        # An element with comments needs a statement even if its numbers are in the text already.
        statements = {element: AttributeStatement(element) for element in self.applied.comments}
        model = self.original
        for _ in range(MAX_CORRECTION_ROUNDS):
            for statement in find_missing_statements(
                model, self.applied.target_values, ROUNDING_TOLERANCE
            ):
                element_statement = statements.setdefault(
                    statement.element, AttributeStatement(statement.element)
                )
                # Attributes that were written without effect need their related attributes.
                element_statement.insisted = (
                    bool(element_statement.values) or model is not self.original
                )
                element_statement.values |= statement.values
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

        A statement without a cause of its own keeps a value that would change otherwise.
        """
        document = self._parse_document()
        writer = MjcfWriter(document, self.original, self.applied.target_values)
        for statement in statements:
            writer.write(statement, self.applied.comments.get(statement.element, [KEPT_VALUE_NOTE]))
        heading = format_heading(self.robot.path, self.recording, self.applied.notes)
        document.root.within.insert(0, ([heading], ""))
        return document.to_text()


def compile_mjcf(text: str) -> Any:
    """Compile an MJCF text without printing MuJoCo's warnings.

    Raises:
        NotEditableError: MuJoCo rejects the text.
    """
    import mujoco

    try:
        with capture_mujoco_warnings():
            model = mujoco.MjSpec.from_string(text).compile()
    except ValueError as error:
        raise NotEditableError(f"MuJoCo refuses it: {' '.join(str(error).split())}") from None
    # The discarded spec held all meshes a second time.
    release_free_memory()
    return model


_MUJOCO_DEFAULTS: Mapping[str, Values] = {
    "solreffriction": (0.02, 1.0),
    "solimpfriction": (0.9, 0.95, 0.001, 0.5, 2.0),
}
"""MuJoCo's default values of attributes; all other attributes default to zero."""
_POSE_ATTRIBUTES = frozenset({"axis", "ref", "springref"})
"""Attributes that stay with a joint since they depend on its pose."""
_NONE, _FIXED, _AFFINE = 0.0, 0.0, 1.0
"""MuJoCo's enumeration values of a position servo: no dynamics, fixed gain, affine bias."""


def render_default_class(
    applied: ModifiedModel, joint: int, actuator: int | None, name: str, notes: Sequence[str] = ()
) -> str:
    """Render a default class as ``<default class="NAME">``, with a comment for each cause.

    Args:
        applied: model with the causes applied.
        joint: number of the joint in the model.
        actuator: number of the actuator of the joint; None if there is none.
        name: name of the class.
        notes: further comments.
    """
    lines = [f'<default class="{name}">', *(f"  {format_comment(note)}" for note in notes)]
    elements = [ModelElement("joint", joint)]
    elements += [] if actuator is None else [ModelElement("actuator", actuator)]
    for element in elements:
        cause_comments = applied.comments.get(element, [])
        lines += [f"  {format_comment(text)}" for text in dict.fromkeys(cause_comments)]
        tag, attributes = _format_default_element(
            element, list_all_attributes(applied.model, element, applied.target_values)
        )
        lines.append(f"  {format_element(tag, attributes)}")
    return "\n".join([*lines, "</default>"])


def _format_default_element(
    element: ModelElement, values: Mapping[str, Values]
) -> tuple[str, dict[str, str]]:
    """Return the tag of an element in a default class, and its attributes as text.

    Attributes with MuJoCo's default values are omitted, and those that belong to the pose of one
    joint. An actuator that is a position servo becomes ``position`` with its gains; any other one
    becomes ``general``.

    Args:
        element: the joint or actuator.
        values: its values by MJCF attribute.
    """
    class_values = {
        name: value
        for name, value in values.items()
        if name not in _POSE_ATTRIBUTES and value != _MUJOCO_DEFAULTS.get(name, (0.0,) * len(value))
    }
    if element.kind == "joint":
        if not values["frictionloss"][0]:
            class_values = {
                name: value for name, value in class_values.items() if not name.startswith("sol")
            }
        return "joint", format_attributes(class_values)
    ranges = {"ctrlrange": "ctrllimited", "forcerange": "forcelimited"}
    class_values = {
        k: v for k, v in class_values.items() if k not in ranges or values[ranges[k]][0]
    }
    if not _is_servo(values):
        return "general", format_attributes(
            {**class_values, **{k: values[k] for k in ("gaintype", "biastype")}}
        )
    gains = {"kp": format_number(values["gainprm"][0]), "kv": format_number(-values["biasprm"][2])}
    return "position", gains | format_attributes(
        {k: v for k, v in class_values.items() if not k.startswith(("gain", "bias", "dyn"))}
    )


def _is_servo(values: Mapping[str, Values]) -> bool:
    """Return whether actuator attributes are those of MJCF's ``position`` shortcut."""
    kinds = values["dyntype"][0], values["gaintype"][0], values["biastype"][0]
    offset, stiffness = values["biasprm"][:2]
    return kinds == (_NONE, _FIXED, _AFFINE) and offset == 0 and stiffness == -values["gainprm"][0]


def render_model_using_class(
    robot: RobotModel,
    applied: ModifiedModel,
    joint: int,
    actuator: int | None,
    name: str,
    text: str,
) -> str:
    """Render the model file with all causes, where a joint and its actuator use a default class.

    The class has their numbers, so these are removed from their own elements. The result is
    compiled to check that it is the same model.

    Args:
        robot: robot as read from its model file.
        applied: model with the causes applied.
        joint: number of the joint in the model.
        actuator: number of the actuator of the joint; None if there is none.
        name: name of the class.
        text: the class, from `render_default_class`.

    Raises:
        NotEditableError: the rendered file differs from the modified model; states the field.
    """
    document = MjcfDocument(applied.text.encode(), robot.path)
    tags = document.map_to_compiled_ids(applied.model)
    tag = tags[ModelElement("joint", joint)]
    tag.new["class"] = name
    tag.removed |= {a.name for a in ATTRIBUTES_BY_KIND["joint"]} - _POSE_ATTRIBUTES
    if actuator is not None:
        element = ModelElement("actuator", actuator)
        tag = tags[element]
        tag.new["class"] = name
        tag.removed |= {a.name for a in ATTRIBUTES_BY_KIND["actuator"]} | set(SHORTCUT_ATTRIBUTES)
        tag.renamed, _ = _format_default_element(
            element, list_all_attributes(applied.model, element, applied.target_values)
        )
    if not any(element_tag.name in FILE_ELEMENTS for element_tag in document.walk()):
        for compiler in document.find_elements("compiler"):
            compiler.removed |= {"meshdir", "texturedir"}
    document.root.within.insert(
        0, ([], "<default>\n    " + text.replace("\n", "\n    ") + "\n  </default>")
    )
    written_text = document.to_text()
    difference = find_first_difference(
        compile_mjcf(written_text), applied.model, EQUAL_NUMBERS_TOLERANCE
    )
    if difference:
        raise NotEditableError(difference)
    return written_text
