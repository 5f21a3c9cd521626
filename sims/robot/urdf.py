"""What a URDF says, made fit for MuJoCo: what it does not read is left out, slips are mended."""

from __future__ import annotations

import math
from collections.abc import Sequence
from xml.etree.ElementTree import Element, SubElement

import numpy as np

from sims.base import InputError
from sims.limits import cut
from sims.robot.meshes import Meshes
from sims.robot.words import listed
from sims.robot.xmlfile import Files, children

READ = ("link", "joint", "mujoco", "material")
"""What is read of a robot; materials colour what is seen and move nothing."""
MOVING = ("revolute", "continuous", "prismatic", "floating", "planar", "spherical")
POINT = 1e-9
"""kg m^2: what a link's moments are that states a mass and none: it is a point."""
ENTRIES = {"ixx": (0, 0), "iyy": (1, 1), "izz": (2, 2), "ixy": (0, 1), "ixz": (0, 2), "iyz": (1, 2)}
"""Of a tensor of inertia, with row and column."""
SINGLE = ("revolute", "continuous", "prismatic")


def mended(files: Files, root: Element) -> list[str]:
    """Mend a URDF in its place.

    Returns:
        One line for each thing that was mended or left out.

    Raises:
        InputError: it is no tree of links, or nothing in it moves.
    """
    _no_macros(files, root)
    links, joints = _links(files, root), children(root, "joint")
    notes = [*_unread(root), *_named(files, joints)]
    _joined(files, links, joints)
    if not any(joint.get("type") in MOVING for joint in joints):
        raise InputError(f"{files.path}: none of its {len(joints)} joints moves")
    carried = {_end(files, joint, "child") for joint in joints}
    roots = [name for name in links if name not in carried]
    compiler = _compiler(root)
    notes += _once([*links.values(), *joints])
    notes += _held(links, roots)
    notes += _inertials(files, links, roots)
    notes += _shapes(files, links, compiler)
    notes += _limits(joints)
    notes += _mimics(files, joints)
    return notes


def _no_macros(files: Files, root: Element) -> None:
    for element in root.iter():
        macros = [value for value in element.attrib.values() if "${" in value or "$(" in value]
        if element.tag.startswith("xacro:") or macros:
            what = cut(macros[0]) if macros else f"<{cut(element.tag)}>"
            raise files.fault(element, f"{what} is a macro; run xacro, and give the result")


def _unread(root: Element) -> list[str]:
    """Take away what MuJoCo does not read."""
    tags = sorted({child.tag for child in root if child.tag not in READ})
    root[:] = [child for child in root if child.tag in READ and child.tag != "material"]
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


def _named(files: Files, joints: Sequence[Element]) -> list[str]:
    """See that each joint has a name of its own."""
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
        notes.append(f"joint {cut(own)}: so called here; it is {was}")
    return notes


def _end(files: Files, joint: Element, tag: str) -> str:
    """The name of a joint's parent or child."""
    ends = children(joint, tag)
    name = ends[0].get("link") if ends else None
    if not name:
        label = cut(joint.get("name") or "without a name")
        raise files.fault(joint, f"joint {label} states no {tag} link")
    return name


def _joined(files: Files, links: dict[str, Element], joints: Sequence[Element]) -> None:
    """Refuse what is no tree."""
    parents: dict[str, str] = {}
    for joint in joints:
        label = cut(joint.get("name") or "")
        for tag in ("parent", "child"):
            name = _end(files, joint, tag)
            if name not in links:
                raise files.fault(joint, f"joint {label}: there is no link '{cut(name)}'")
        child = _end(files, joint, "child")
        if child in parents:
            raise files.fault(
                joint,
                f"link {cut(child)} hangs on two joints; a loop needs an MJCF",
            )
        parents[child] = _end(files, joint, "parent")
    for name in links:
        above, steps = name, 0
        while above in parents:
            above, steps = parents[above], steps + 1
            if steps > len(links):
                raise files.fault(links[name], f"link {cut(name)} hangs on itself")


def _compiler(root: Element) -> Element:
    """The settings of MuJoCo's compiler; those of files and of what is seen are dealt with here."""
    blocks = children(root, "mujoco")
    block = blocks[0] if blocks else SubElement(root, "mujoco")
    found = children(block, "compiler")
    return found[0] if found else SubElement(block, "compiler")


def _once(parts: Sequence[Element]) -> list[str]:
    """Keep the first of what stands twice in a link or a joint."""
    notes = []
    for part in parts:
        name, seen = cut(part.get("name") or ""), set[str]()
        for child in list(part):
            if child.tag in seen and child.tag not in ("visual", "collision"):
                part.remove(child)
                notes.append(f"{part.tag} {name}: the second <{cut(child.tag)}> is not read")
            seen.add(child.tag)
    return notes


def _held(links: dict[str, Element], roots: Sequence[str]) -> list[str]:
    """Say what is fused to the world though it has a mass."""
    heavy = [name for name in roots if _mass(links[name]) > 0]
    return [f"{cut(name)}: held to the world, as MuJoCo does with a URDF's root" for name in heavy]


def _mass(link: Element) -> float:
    for element in children(link, "inertial", "mass"):
        return _number(element.get("value"))
    return 0.0


def _number(text: str | None) -> float:
    """The number; 0 where there is none, NaN where it is not one."""
    try:
        return float(text) if text else 0.0
    except ValueError:
        return math.nan


def _inertials(files: Files, links: dict[str, Element], roots: Sequence[str]) -> list[str]:
    notes, points, inferred = [], [], []
    for name, link in links.items():
        inertials = children(link, "inertial")
        if not inertials:
            shapes = children(link, "collision")
            inferred += [name] if shapes and name not in roots else []
            continue
        inertial = inertials[0]
        mass = _mass(link)
        if not mass >= 0:
            raise files.fault(inertial, f"link {cut(name)}: its mass is {mass:g} kg")
        if not children(inertial, "mass"):
            SubElement(inertial, "mass", value="0")
        for tensor in children(inertial, "inertia") or [SubElement(inertial, "inertia")]:
            entries = [
                _number(tensor.get(key)) for key in ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
            ]
            if not all(map(math.isfinite, entries)):
                raise files.fault(tensor, f"link {cut(name)}: its inertia is not made of numbers")
            points += [name] if not any(entries) and mass > 0 and name not in roots else []
            notes += _positive(name, tensor, entries)
    if points:
        notes.append(
            f"{listed(points)}: mass without moments of inertia; points of {POINT:g} kg m^2"
        )
    if inferred:
        notes.append(
            f"{listed(inferred)}: no mass stated; it follows from the collision shapes at "
            "1000 kg/m^3, as MuJoCo does"
        )
    return notes


def _positive(name: str, tensor: Element, entries: Sequence[float]) -> list[str]:
    """Raise principal moments that are not positive."""
    xx, yy, zz, xy, xz, yz = entries
    moments, axes = np.linalg.eigh(np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]))
    if moments[0] >= POINT * 1e-3:
        return []
    largest = max(float(moments[-1]), 0.0)
    least = max(POINT, 1e-6 * largest)
    full = axes @ np.diag(np.maximum(moments, least)) @ axes.T
    keys = {
        "ixx": (0, 0),
        "iyy": (1, 1),
        "izz": (2, 2),
        "ixy": (0, 1),
        "ixz": (0, 2),
        "iyz": (1, 2),
    }
    for key, at in keys.items():
        tensor.set(key, repr(float(full[at])))
    if not any(entries):
        return []
    shown = ", ".join(f"{moment:.3g}" for moment in moments)
    return [f"{cut(name)}: principal moments {shown} kg m^2 are raised to at least {least:.3g}"]


def _shapes(files: Files, links: dict[str, Element], compiler: Element) -> list[str]:
    """Leave out what is only seen, and shapes whose mesh is absent or of another format."""
    meshes = Meshes(files, compiler.get("meshdir") or compiler.get("assetdir") or "")
    inferring = compiler.get("inertiafromgeom") == "true"
    for key in ("meshdir", "assetdir", "texturedir", "strippath", "discardvisual"):
        compiler.attrib.pop(key, None)
    for name, link in links.items():
        stated = bool(children(link, "inertial")) and not inferring
        for shape in [*children(link, "visual"), *children(link, "collision")]:
            if shape.tag == "visual" or not _kept(files, name, shape, meshes, stated):
                link.remove(shape)
    return meshes.notes


def _kept(files: Files, name: str, shape: Element, meshes: Meshes, stated: bool) -> bool:
    """Whether a collision shape can be read; its mesh is called by where it lies."""
    for mesh in children(shape, "geometry", "mesh"):
        file = mesh.get("filename") or ""
        found, why = meshes.find(file)
        if found is not None:
            mesh.set("filename", found)
            return True
        if not stated:
            raise files.fault(
                mesh,
                f"mesh {cut(file)} {why}, and the mass of link {cut(name)} would follow from it; "
                "put it there, or state the link's <inertial>",
            )
        meshes.leave_out(file, why, name)
        return False
    return True


def _limits(joints: Sequence[Element]) -> list[str]:
    unstated, empty, clamped = [], [], []
    for joint in joints:
        name, kind = joint.get("name") or "", joint.get("type")
        for limit in children(joint, "limit"):
            if kind not in SINGLE:
                joint.remove(limit)
                continue
            effort = _number(limit.get("effort"))
            if "effort" in limit.attrib and not (0 < effort < math.inf):
                unstated.append(name)
                del limit.attrib["effort"]
            elif effort > 0:
                clamped.append(f"{cut(name)} {effort:g}")
            lower, upper = _number(limit.get("lower")), _number(limit.get("upper"))
            if kind == "continuous" or lower >= upper:
                limit.attrib.pop("lower", None)
                limit.attrib.pop("upper", None)
                empty += [name] if kind != "continuous" else []
    notes = []
    if clamped:
        notes.append(f"effort limits clamp what actuators exert (N m, N): {', '.join(clamped)}")
    if unstated:
        notes.append(f"{listed(unstated)}: an effort limit that is not positive is read as none")
    if empty:
        notes.append(f"{listed(empty)}: a lower limit that is not below the upper is read as none")
    return notes


def _mimics(files: Files, joints: Sequence[Element]) -> list[str]:
    kinds = {joint.get("name"): joint.get("type") for joint in joints}
    notes = []
    for joint in joints:
        for mimic in children(joint, "mimic"):
            name, other = joint.get("name") or "", mimic.get("joint") or ""
            if other not in kinds:
                raise files.fault(mimic, f"joint {cut(name)} mimics '{cut(other)}': no such joint")
            if joint.get("type") in SINGLE and kinds[other] in SINGLE:
                factor, shift = mimic.get("multiplier") or "1", mimic.get("offset") or "0"
                notes.append(
                    f"{cut(name)}: mimics {cut(other)} ({cut(factor)} q + {cut(shift)}) by an "
                    "equality constraint, which is soft as MuJoCo's are"
                )
            else:
                joint.remove(mimic)
                notes.append(
                    f"{cut(name)}: its mimic of {cut(other)} is not read; one does not turn"
                )
    return notes
