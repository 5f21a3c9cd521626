"""Prepare a URDF for MuJoCo: remove elements that MuJoCo does not read, and repair mistakes."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from typing import Any
from xml.etree.ElementTree import Element, SubElement

from sims.base import InputError, unknown
from sims.limits import cut
from sims.robot.links import inertials, mass, number, shapes
from sims.robot.native import SOLIMP
from sims.robot.quiet import one_line
from sims.robot.words import listed
from sims.robot.xmlfile import Files, children, written

READ = ("link", "joint", "mujoco")
"""Child elements of a robot that are read."""
SEEN = ("material", "visual")
"""Elements that are only visual."""
SINGLE = ("revolute", "continuous", "prismatic")
MOVING = (*SINGLE, "floating", "planar", "spherical")
KINDS = ("fixed", *MOVING)
WORLD = "world"
"""Name of the link that is the fixed world by a convention of many files."""
RIGID = (1e-4, 1.0)
"""Parameter `solref` of a rigid mimic relation.

MuJoCo raises its time constant, in s, to two time steps.
"""


def mended(files: Files, root: Element) -> list[str]:
    """Repair a URDF in place.

    Args:
        files: reader of the model file.
        root: root element of the URDF.

    Returns:
        Notes, one line for each kind of repair or omission.

    Raises:
        InputError: the links do not form a tree, or nothing in it moves.
    """
    _no_macros(files, root)
    links, joints = _links(files, root), children(root, "joint")
    notes = [*_with_world(files, root, links, joints), *_unread(root), *_named(files, joints)]
    above = _joined(files, links, joints)
    if not any(joint.get("type") in MOVING for joint in joints):
        raise InputError(f"{files.path}: none of its {len(joints)} joints moves")
    held = {name for name in links if _held(above, name)}
    heavy = [name for name in links if name not in above and mass(links[name]) > 0]
    if heavy:
        notes.append(f"held to the world, as MuJoCo does with a URDF's root: {listed(heavy)}")
    notes += _once([*links.values(), *joints])
    notes += inertials(files, links, held)
    _checked(files, root)
    notes += shapes(files, links, _compiler(root), held)
    notes += _limits(joints)
    notes += _mimics(joints)
    return notes


def _no_macros(files: Files, root: Element) -> None:
    for element in root.iter():
        macros = [value for value in element.attrib.values() if "${" in value or "$(" in value]
        if element.tag.startswith("xacro:") or macros:
            what = cut(macros[0]) if macros else f"<{cut(element.tag)}>"
            raise files.fault(element, f"{what} is a macro; run xacro, and give the result")


def _unread(root: Element) -> list[str]:
    """Remove elements that MuJoCo does not read."""
    tags = sorted({child.tag for child in root if child.tag not in (*READ, *SEEN)})
    root[:] = [child for child in root if child.tag in READ]
    unread = listed([f"<{tag}>" for tag in tags])
    return [f"not read, since MuJoCo knows no such thing: {unread}"] if tags else []


def _links(files: Files, root: Element) -> dict[str, Element]:
    links: dict[str, Element] = {}
    for link in children(root, "link"):
        name = link.get("name")
        if not name:
            raise files.fault(link, "a link without a name")
        if name in links:
            raise files.fault(link, f"two links are called '{cut(name)}'")
        links[name] = link
    return links


def _with_world(
    files: Files, root: Element, links: dict[str, Element], joints: Sequence[Element]
) -> list[str]:
    """Add the link `world` if joints refer to it and the file does not define it.

    Simulators with a link of this name read such a file in this way.
    """
    if WORLD in links or not any(_end(files, joint, "parent") == WORLD for joint in joints):
        return []
    links[WORLD] = SubElement(root, "link", {"name": WORLD})
    return [f"the link {WORLD}, which the file does not state, is the fixed world"]


def _named(files: Files, joints: Sequence[Element]) -> list[str]:
    """Give each joint a unique name."""
    seen: set[str] = set()
    notes = []
    for joint in joints:
        name = joint.get("name") or ""
        own = name or f"joint_{_end(files, joint, 'child')}"
        while own in seen:
            own += "_"
        seen.add(own)
        if own == name:
            continue
        joint.set("name", own)
        was = f"another joint {cut(name)}" if name else "a joint without a name"
        notes.append(f"called {cut(own)} here: {was}")
    return notes


def _end(files: Files, joint: Element, tag: str) -> str:
    """Return the name of a joint's parent or child link."""
    ends = children(joint, tag)
    name = ends[0].get("link") if ends else None
    if not name:
        label = cut(joint.get("name") or "without a name")
        raise files.fault(joint, f"joint {label} states no {tag} link")
    return name


def _joined(
    files: Files, links: Mapping[str, Element], joints: Sequence[Element]
) -> dict[str, tuple[str, Element]]:
    """Return the parent link and the joint of each link; raise an error if links form no tree."""
    above: dict[str, tuple[str, Element]] = {}
    for joint in joints:
        label, kind = cut(joint.get("name") or ""), joint.get("type") or ""
        if kind not in KINDS:
            raise files.fault(joint, f"joint {label}: {unknown('type', kind, KINDS)}")
        parent, child = _end(files, joint, "parent"), _end(files, joint, "child")
        for name in (parent, child):
            if name not in links:
                raise files.fault(joint, f"joint {label}: there is no link '{cut(name)}'")
        if child in above:
            raise files.fault(joint, f"link {cut(child)} hangs on two joints; a loop needs an MJCF")
        above[child] = (parent, joint)
    for name in links:
        upwards, steps = name, 0
        while upwards in above:
            upwards, steps = above[upwards][0], steps + 1
            if steps > len(links):
                raise files.fault(links[name], f"link {cut(name)} hangs on itself")
    return above


def _held(above: Mapping[str, tuple[str, Element]], name: str) -> bool:
    """Return whether a link is fused to the world."""
    while name in above:
        name, joint = above[name]
        if joint.get("type") != "fixed":
            return False
    return True


def _compiler(root: Element) -> Element:
    """Return the settings element of MuJoCo's compiler, which is created if missing."""
    blocks = children(root, "mujoco")
    block = blocks[0] if blocks else SubElement(root, "mujoco")
    found = children(block, "compiler")
    return found[0] if found else SubElement(block, "compiler")


def _checked(files: Files, root: Element) -> None:
    """Raise an error for unknown MuJoCo settings, which MuJoCo ignores in a URDF."""
    import mujoco

    for child in children(root, "mujoco"):
        for setting in child:
            alone = Element("mujoco")
            alone.append(Element(setting.tag, setting.attrib))
            try:
                mujoco.MjSpec.from_string(written(alone)[0])
            except ValueError as error:
                said = re.sub(r", line \d+", "", one_line(error))
                raise files.fault(setting, said) from None


def _once(parts: Sequence[Element]) -> list[str]:
    """Remove repeated elements in a link or a joint, except for the first of each kind."""
    twice = []
    for part in parts:
        seen: set[str] = set()
        for child in list(part):
            if child.tag in seen and child.tag not in ("visual", "collision"):
                part.remove(child)
                twice.append(f"<{child.tag}> of {part.tag} {part.get('name')}")
            seen.add(child.tag)
    return [f"stated twice, the first is read: {listed(twice)}"] if twice else []


def speeds(root: Element) -> dict[str, float]:
    """Return the velocity limits of joints, rad/s or m/s, where the file specifies them."""
    found = {}
    for joint in children(root, "joint"):
        for limit in children(joint, "limit"):
            fastest = number(limit.get("velocity"))
            if joint.get("type") in SINGLE and 0 < fastest < math.inf:
                found[joint.get("name") or ""] = fastest
    return found


def _limits(joints: Sequence[Element]) -> list[str]:
    unstated, empty, clamped = [], [], []
    for joint in joints:
        name, kind = joint.get("name") or "", joint.get("type")
        for limit in children(joint, "limit"):
            if kind not in SINGLE:
                joint.remove(limit)
                continue
            effort = number(limit.get("effort"))
            if "effort" in limit.attrib and not (0 < effort < math.inf):
                unstated.append(name)
                del limit.attrib["effort"]
            elif effort > 0:
                clamped.append(f"{name} {effort:g}")
            if kind == "continuous" or number(limit.get("lower")) >= number(limit.get("upper")):
                empty += [name] if kind != "continuous" else []
                limit.attrib.pop("lower", None)
                limit.attrib.pop("upper", None)
    notes = []
    if clamped:
        notes.append(f"effort limits clamp what actuators exert (N m or N): {listed(clamped)}")
    if unstated:
        notes.append(f"an effort limit that is not positive is read as none: {listed(unstated)}")
    if empty:
        notes.append(f"a lower limit not below the upper is read as none: {listed(empty)}")
    return notes


def stiffen_mimics(spec: Any) -> None:
    """Make mimic joints follow as stiffly as MuJoCo allows.

    URDF specifies a rigid relation, and MuJoCo's default equality follows it with a delay of 20 ms.

    Args:
        spec: mujoco.MjSpec of a URDF, whose only equalities are those of mimic joints.
    """
    for equality in spec.equalities:
        equality.solref = RIGID
        equality.solimp = SOLIMP


def _mimics(joints: Sequence[Element]) -> list[str]:
    kinds = {joint.get("name"): joint.get("type") for joint in joints}
    tied, loose = [], []
    for joint in joints:
        for mimic in children(joint, "mimic"):
            name, other = joint.get("name") or "", mimic.get("joint") or ""
            if joint.get("type") in SINGLE and kinds.get(other) in SINGLE and name != other:
                factor, shift = mimic.get("multiplier") or "1", mimic.get("offset") or "0"
                tied.append(f"{name} = {factor} {other} + {shift}")
            else:
                joint.remove(mimic)
                loose.append(f"{name} ({other})")
    notes = []
    if tied:
        notes.append(f"mimic joints follow as stiffly as MuJoCo allows: {listed(tied)}")
    if loose:
        notes.append(f"mimics of joints that do not move, or are not there: {listed(loose)}")
    return notes
