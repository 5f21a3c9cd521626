"""Write the fitted numbers of a joint and its actuator as a default class of an MJCF."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from sims.robot.export.apply_causes import ModifiedModel
from sims.robot.export.mjcf_attributes import (
    ATTRIBUTES_BY_KIND,
    ModelElement,
    Values,
    list_all_attributes,
)
from sims.robot.export.mjcf_document import FILE_ELEMENTS, MjcfDocument, compile_mjcf
from sims.robot.export.mjcf_writer import SHORTCUT_ATTRIBUTES, format_attributes
from sims.robot.export.model_comparison import EQUAL_NUMBERS_TOLERANCE, find_first_difference
from sims.robot.export.xml_editing import (
    NotEditableError,
    format_comment,
    format_element,
    format_number,
)
from sims.robot.robot_model import RobotModel

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
    """Render the numbers of a joint and its actuator as a default class of an MJCF.

    The text is an element ``<default class="NAME">`` with a comment for each cause.

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
    joint. In addition:

    * A joint without dry friction omits the solver parameters of friction.
    * An actuator omits ranges that do not limit it. If it is a position servo, it becomes
      ``position`` with its gains; any other one becomes ``general``.

    Args:
        element: the joint or actuator.
        values: its values by MJCF attribute.

    Returns:
        Name of the element, such as ``joint`` or ``position``, and texts by attribute.
    """
    # Most attributes are zero by default.
    class_values = {
        name: value
        for name, value in values.items()
        if name not in _POSE_ATTRIBUTES and value != _MUJOCO_DEFAULTS.get(name, (0.0,) * len(value))
    }
    # A joint; the names of the solver parameters of friction begin with "sol".
    if element.kind == "joint":
        if not values["frictionloss"][0]:
            class_values = {
                name: value for name, value in class_values.items() if not name.startswith("sol")
            }
        return "joint", format_attributes(class_values)
    # An actuator; each range has a flag that tells whether it limits.
    flag_of_range = {"ctrlrange": "ctrllimited", "forcerange": "forcelimited"}
    class_values = {
        name: value
        for name, value in class_values.items()
        if name not in flag_of_range or values[flag_of_range[name]][0]
    }
    if not _is_servo(values):
        types = {name: values[name] for name in ("gaintype", "biastype")}
        return "general", format_attributes(class_values | types)
    # A servo's force is kp (control - position) - kv velocity: kp is the gain, and the third number
    # of the bias is -kv.
    (stiffness, *_), (_, _, negative_damping, *_) = values["gainprm"], values["biasprm"]
    gains = {"kp": format_number(stiffness), "kv": format_number(-negative_damping)}
    # The element ``position`` implies all attributes of gain, bias and dynamics.
    others = {
        name: value
        for name, value in class_values.items()
        if not name.startswith(("gain", "bias", "dyn"))
    }
    return "position", gains | format_attributes(others)


def _is_servo(values: Mapping[str, Values]) -> bool:
    """Return whether actuator attributes are those of MJCF's ``position`` shortcut."""
    kinds = values["dyntype"], values["gaintype"], values["biastype"]
    (gain, *_), (offset, stiffness, *_) = values["gainprm"], values["biasprm"]
    return kinds == ((_NONE,), (_FIXED,), (_AFFINE,)) and offset == 0 and stiffness == -gain


def render_model_using_class(
    robot: RobotModel,
    applied: ModifiedModel,
    joint: int,
    actuator: int | None,
    name: str,
    text: str,
) -> str:
    """Render the model file with all causes, where a joint and its actuator use a default class.

    1. Refer to the class in the elements of the joint and the actuator, and remove the numbers from
       them that the class has.
    2. Without asset files, remove the folders of assets.
    3. Insert the class, and compile the result to check that it is the same model.

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
    # 1. Elements of the text: attributes to set (`new`), to remove, and another element name.
    document = MjcfDocument(applied.text.encode(), robot.path)
    tags = document.map_to_compiled_ids(applied.model)
    joint_tag = tags[ModelElement("joint", joint)]
    joint_tag.new["class"] = name
    joint_tag.removed |= {a.name for a in ATTRIBUTES_BY_KIND["joint"]} - _POSE_ATTRIBUTES
    if actuator is not None:
        element = ModelElement("actuator", actuator)
        actuator_tag = tags[element]
        actuator_tag.new["class"] = name
        actuator_tag.removed |= {a.name for a in ATTRIBUTES_BY_KIND["actuator"]}
        actuator_tag.removed |= set(SHORTCUT_ATTRIBUTES)
        # The element gets the name that it has in the class.
        actuator_tag.renamed, _ = _format_default_element(
            element, list_all_attributes(applied.model, element, applied.target_values)
        )
    # 2. Folders.
    if not any(element_tag.name in FILE_ELEMENTS for element_tag in document.walk()):
        for compiler in document.find_elements("compiler"):
            compiler.removed |= {"meshdir", "texturedir"}
    # 3. Class, as the first element within the root, without comments before it.
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
