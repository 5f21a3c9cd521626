"""Prepare a URDF for MuJoCo: remove elements that MuJoCo does not read, and repair its links."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from typing import Any
from xml.etree.ElementTree import Element, SubElement

import numpy as np

from sims.core.simulator import InputError, make_unknown_name_error
from sims.core.user_messages import truncate_text
from sims.robot import inertia_tensors
from sims.robot.dry_friction import FRICTION_SOLIMP
from sims.robot.mujoco_messages import format_item_list, format_mujoco_error, format_name_list
from sims.robot.parsing.mesh_files import MeshLookup
from sims.robot.parsing.xml_files import ModelFileReader, find_children, format_tree

TENSOR_ENTRIES = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
FRAME_MASS_THRESHOLD = 1e-6
"""Mass, in kg, below which a link counts as a mere frame, whose inertia needs no note."""
MESH_FOLDER_SETTINGS = ("meshdir", "assetdir", "texturedir", "strippath", "discardvisual")
"""Settings of MuJoCo's compiler about mesh files, which are removed after the meshes were found."""


def parse_number(text: str | None) -> float:
    """Parse a number; 0 for a missing text, NaN for an invalid one."""
    try:
        return float(text) if text else 0.0
    except ValueError:
        return math.nan


def get_link_mass(link: Element) -> float:
    """Return the mass that a link specifies, in kg; 0 if it specifies none."""
    mass_elements = find_children(link, "inertial", "mass")
    return parse_number(mass_elements[0].get("value")) if mass_elements else 0.0


def repair_inertials(
    files: ModelFileReader, links: Mapping[str, Element], fixed_links: set[str]
) -> list[str]:
    """Repair masses and moments of inertia of links that MuJoCo would reject.

    * A missing mass becomes zero.
    * Principal moments that are not positive become the nearest ones that a body can have.
    * A link without any inertial stays as it is: MuJoCo computes its mass from collision shapes.

    The notes are silent about links whose mass has no influence: those that never move, and mere
    frames with almost no mass.

    Args:
        files: reader of the model file.
        links: link elements by name; changed in place.
        fixed_links: links that are fused to the world, which need no notes.

    Returns:
        Notes about the repairs.

    Raises:
        InputError: a mass is negative, or an entry is not a number.
    """
    # Links for notes: with a mass but no moments; with changed moments; and without an inertial.
    point_masses, raised_links, inferred_links = [], [], []
    for name, link in links.items():
        inertials = find_children(link, "inertial")
        if not inertials:
            if find_children(link, "collision") and name not in fixed_links:
                inferred_links.append(name)
            continue
        inertial, *_ = inertials
        mass = get_link_mass(link)
        if not 0 <= mass < math.inf:
            raise files.make_error(inertial, f"link {truncate_text(name)}: its mass is {mass:g} kg")
        if not find_children(inertial, "mass"):
            SubElement(inertial, "mass", value="0")
        tensors = find_children(inertial, "inertia")
        tensor = tensors[0] if tensors else SubElement(inertial, "inertia")
        entries = [parse_number(tensor.get(key)) for key in TENSOR_ENTRIES]
        if not np.isfinite(entries).all():
            raise files.make_error(
                tensor, f"link {truncate_text(name)}: its inertia is not made of numbers"
            )
        change = _raise_moments(tensor, entries)
        if name in fixed_links or mass < FRAME_MASS_THRESHOLD or not change:
            continue  # No note is needed.
        if max(map(abs, entries)) < inertia_tensors.NEGLIGIBLE_MOMENT:
            point_masses.append(name)
        else:
            raised_links.append(f"{name} {change}")
    return _format_repair_notes(point_masses, raised_links, inferred_links)


def _raise_moments(tensor: Element, entries: Sequence[float]) -> str:
    """Raise principal moments of a link that are not positive to the nearest ones of a real body.

    Args:
        tensor: element with the inertia tensor, changed in place.
        entries: the six entries of the tensor in kg m², in the order of `TENSOR_ENTRIES`.

    Returns:
        Text with the moments before and after; empty if nothing was changed.
    """
    moments, axes = inertia_tensors.compute_principal_moments(entries)
    smallest, *_ = moments
    if smallest >= inertia_tensors.NEGLIGIBLE_MOMENT:
        return ""
    after = inertia_tensors.find_nearest_valid_moments(moments)
    for key, entry in zip(
        TENSOR_ENTRIES, inertia_tensors.compose_inertia_tensor(after, axes), strict=True
    ):
        tensor.set(key, repr(entry))
    return inertia_tensors.format_moments(moments, after)


def _format_repair_notes(
    point_masses: list[str], raised_links: list[str], inferred_links: list[str]
) -> list[str]:
    """Return the notes about repaired inertials of links, one for each kind of repair.

    Args:
        point_masses: links with a mass and no moments of inertia.
        raised_links: links with moments that were not positive, with the values before and after.
        inferred_links: links without an inertial, whose mass follows from their collision shapes.
    """
    notes = []
    if point_masses:
        min_moment = f"{inertia_tensors.MIN_MOMENT:g} kg·m²"
        notes.append(
            f"a mass and no moments of inertia, so it is a point mass ({min_moment}): "
            f"{format_name_list(point_masses)}"
        )
    if raised_links:
        notes.append(
            "principal moments that are not positive; the nearest that a body can have are taken "
            f"(kg·m²): {format_item_list(raised_links)}"
        )
    if inferred_links:
        notes.append(
            "no mass stated; it follows from the collision shapes at 1000 kg/m^3, as MuJoCo does: "
            f"{format_name_list(inferred_links)}"
        )
    return notes


def remove_unusable_shapes(
    files: ModelFileReader, links: Mapping[str, Element], compiler: Element, fixed_links: set[str]
) -> list[str]:
    """Remove visual shapes, and collision shapes whose mesh is missing or of an unsupported format.

    The paths of the other meshes are replaced by those of the files found. A missing mesh is only
    acceptable if the mass of the link does not follow from its shapes, or does not matter.

    Args:
        files: reader of the model file.
        links: link elements by name; changed in place.
        compiler: settings of MuJoCo's compiler; those about mesh files are removed, since the paths
            no longer depend on them.
        fixed_links: links that are fused to the world, whose mass does not matter.

    Returns:
        Notes about the omitted shapes.

    Raises:
        InputError: the mass of a moving link would depend on a missing mesh.
    """
    meshes = MeshLookup(files, compiler.get("meshdir") or compiler.get("assetdir") or "")
    is_mass_inferred = compiler.get("inertiafromgeom") == "true"
    for key in MESH_FOLDER_SETTINGS:
        compiler.attrib.pop(key, None)
    for name, link in links.items():
        has_stated_mass = bool(find_children(link, "inertial")) and not is_mass_inferred
        # The mass of a link that never moves does not matter.
        has_mass = has_stated_mass or name in fixed_links
        for shape in find_children(link, "visual"):
            link.remove(shape)
        for shape in find_children(link, "collision"):
            if not _resolve_collision_shape(files, name, shape, meshes, has_mass):
                link.remove(shape)
    return meshes.notes


def _resolve_collision_shape(
    files: ModelFileReader, name: str, shape: Element, meshes: MeshLookup, has_mass: bool
) -> bool:
    """Set the path of a collision shape's mesh.

    Args:
        files: reader of the files of the model.
        name: name of the link.
        shape: its collision element, in which the path is set.
        meshes: finds the files of meshes.
        has_mass: whether the mass of the link is specified, so that a missing mesh is not an error.

    Returns:
        Whether the shape can be read. A shape without a mesh, such as a box, always can; a mesh
        that cannot be read is recorded for a note.

    Raises:
        InputError: the mesh cannot be read, and the mass of the link depends on it.
    """
    # A shape has at most one mesh.
    for mesh in find_children(shape, "geometry", "mesh"):
        file = mesh.get("filename") or ""
        path, reason = meshes.find(file)
        if path is not None:
            mesh.set("filename", path)
            return True
        if not has_mass:
            raise files.make_error(
                mesh,
                f"mesh {truncate_text(file)} {reason}, and the mass of link {truncate_text(name)} "
                "would follow from it; put it there, or state the link's <inertial>",
            )
        meshes.leave_out(file, reason)
        return False
    return True


READ_ELEMENTS = ("link", "joint", "mujoco")
"""Child elements of a robot that are read."""
VISUAL_ELEMENTS = ("material", "visual")
"""Elements that are only visual."""
ONE_DOF_JOINT_TYPES = ("revolute", "continuous", "prismatic")
MOVING_JOINT_TYPES = (*ONE_DOF_JOINT_TYPES, "floating", "planar", "spherical")
JOINT_TYPES = ("fixed", *MOVING_JOINT_TYPES)
WORLD_LINK = "world"
"""Name of the link that is the fixed world by a convention of many files."""
RIGID_SOLREF = (1e-4, 1.0)
"""Parameter `solref` of a rigid mimic relation.

MuJoCo raises its time constant, in s, to two time steps.
"""


def repair_urdf(files: ModelFileReader, root: Element) -> list[str]:
    """Repair a URDF in place, so that MuJoCo reads it and nothing is ignored without a note.

    1. Reject unexpanded macros, add a missing world link, remove elements that MuJoCo does not
       read, and give joints unique names.
    2. Check that the links form a tree with a moving joint, and note links that MuJoCo fixes to the
       world.
    3. Remove repeated elements, repair inertials, and remove shapes without a file, meaningless
       limits, and relations between joints (mimics) that MuJoCo cannot represent.

    Args:
        files: reader of the files of the model.
        root: root element of the URDF.

    Returns:
        Notes, one line for each kind of repair or omission.

    Raises:
        InputError: the links do not form a tree, or nothing in it moves.
    """
    # 1. Elements and names.
    _reject_macros(files, root)
    links, joints = _collect_links(files, root), find_children(root, "joint")
    notes = [
        *_add_world_link(files, root, links, joints),
        *_remove_unread_elements(root),
        *_make_joint_names_unique(files, joints),
    ]
    # 2. Tree.
    parents = _find_parent_links(files, links, joints)
    if not any(joint.get("type") in MOVING_JOINT_TYPES for joint in joints):
        raise InputError(f"{files.path}: none of its {len(joints)} joints moves")
    fixed_links = {name for name in links if _is_fixed_to_root(parents, name)}
    heavy_roots = [name for name in links if name not in parents and get_link_mass(links[name]) > 0]
    if heavy_roots:
        notes.append(
            f"held to the world, as MuJoCo does with a URDF's root: {format_name_list(heavy_roots)}"
        )
    # 3. Contents of links and joints.
    notes += _remove_repeated_elements([*links.values(), *joints])
    notes += repair_inertials(files, links, fixed_links)
    _check_mujoco_settings(files, root)
    notes += remove_unusable_shapes(files, links, _get_compiler_element(root), fixed_links)
    notes += _remove_meaningless_limits(joints)
    notes += _remove_unsupported_mimics(joints)
    return notes


def _reject_macros(files: ModelFileReader, root: Element) -> None:
    """Reject a file with unexpanded xacro macros, and tell the user how to expand them.

    Args:
        files: reader of the files of the model.
        root: root element of the URDF.

    Raises:
        InputError: the file has a macro.
    """
    for element in root.iter():
        macros = [value for value in element.attrib.values() if "${" in value or "$(" in value]
        if element.tag.startswith("xacro:") or macros:
            macro_text = truncate_text(macros[0]) if macros else f"<{truncate_text(element.tag)}>"
            command = f"pip install xacro; xacro {files.path.name} > robot.urdf"
            raise files.make_error(
                element, f"{macro_text} is a macro; run xacro, and give the result ({command})"
            )


def _remove_unread_elements(root: Element) -> list[str]:
    """Remove elements that MuJoCo does not read, and return a note about them."""
    tags = sorted(
        {child.tag for child in root if child.tag not in (*READ_ELEMENTS, *VISUAL_ELEMENTS)}
    )
    root[:] = [child for child in root if child.tag in READ_ELEMENTS]
    unread_tags = format_name_list([f"<{tag}>" for tag in tags])
    return [f"ignored, since MuJoCo has no equivalent: {unread_tags}"] if tags else []


def _collect_links(files: ModelFileReader, root: Element) -> dict[str, Element]:
    """Return the links by name.

    Args:
        files: reader of the files of the model.
        root: root element of the URDF.

    Returns:
        Elements ``<link>`` by name.

    Raises:
        InputError: a link has no name, or two links have the same name.
    """
    links: dict[str, Element] = {}
    for link in find_children(root, "link"):
        name = link.get("name")
        if not name:
            raise files.make_error(link, "a link without a name")
        if name in links:
            raise files.make_error(link, f"two links are called '{truncate_text(name)}'")
        links[name] = link
    return links


def _add_world_link(
    files: ModelFileReader, root: Element, links: dict[str, Element], joints: Sequence[Element]
) -> list[str]:
    """Add the link `world` if joints refer to it and the file does not define it.

    Simulators in which the fixed world is a link of this name read such a file in this way.

    Args:
        files: reader of the files of the model.
        root: root element of the URDF, changed in place.
        links: links by name, changed in place.
        joints: elements of the joints.

    Returns:
        A note in a list; an empty list if nothing was added.
    """
    if WORLD_LINK in links or not any(
        _get_link_name(files, joint, "parent") == WORLD_LINK for joint in joints
    ):
        return []
    links[WORLD_LINK] = SubElement(root, "link", {"name": WORLD_LINK})
    return [f"the link {WORLD_LINK}, which the file does not state, is the fixed world"]


def _make_joint_names_unique(files: ModelFileReader, joints: Sequence[Element]) -> list[str]:
    """Give each joint a unique name, which MuJoCo requires, and return notes about the changes.

    A joint without a name is called ``joint_CHILD``, after its child link; a repeated name gets
    underscores.

    Args:
        files: reader of the files of the model.
        joints: elements of the joints, changed in place.
    """
    used_names: set[str] = set()
    notes = []
    for joint in joints:
        name = joint.get("name") or ""
        unique_name = name or f"joint_{_get_link_name(files, joint, 'child')}"
        while unique_name in used_names:
            unique_name += "_"
        used_names.add(unique_name)
        if unique_name == name:
            continue
        joint.set("name", unique_name)
        old_label = f"another joint {truncate_text(name)}" if name else "a joint without a name"
        notes.append(f"called {truncate_text(unique_name)} here: {old_label}")
    return notes


def _get_link_name(files: ModelFileReader, joint: Element, tag: str) -> str:
    """Return the name of the link at one end of a joint.

    Args:
        files: reader of the files of the model, which makes the error.
        joint: element of the joint.
        tag: ``parent`` or ``child``.

    Raises:
        InputError: the joint does not state this link.
    """
    end_elements = find_children(joint, tag)
    name = end_elements[0].get("link") if end_elements else None
    if not name:
        label = truncate_text(joint.get("name") or "without a name")
        raise files.make_error(joint, f"joint {label} states no {tag} link")
    return name


def _find_parent_links(
    files: ModelFileReader, links: Mapping[str, Element], joints: Sequence[Element]
) -> dict[str, tuple[str, Element]]:
    """Return the parent link of each link with the joint to it, and check that links form a tree.

    In a tree every joint connects two existing links, no link has two parents, and no link is its
    own ancestor. The root is left out, because it has no parent.

    Args:
        files: Reader of the model file, which locates errors.
        links: Elements ``<link>`` by name.
        joints: Elements ``<joint>``.

    Returns:
        Name of the parent link and element of the joint, by name of the child link.

    Raises:
        InputError: the links do not form a tree, or the type of a joint is unknown.
    """
    # Existing links, and one parent each.
    parents: dict[str, tuple[str, Element]] = {}
    for joint in joints:
        label, kind = truncate_text(joint.get("name") or ""), joint.get("type") or ""
        if kind not in JOINT_TYPES:
            raise files.make_error(
                joint, f"joint {label}: {make_unknown_name_error('type', kind, JOINT_TYPES)}"
            )
        parent = _get_link_name(files, joint, "parent")
        child = _get_link_name(files, joint, "child")
        for name in (parent, child):
            if name not in links:
                raise files.make_error(
                    joint, f"joint {label}: there is no link '{truncate_text(name)}'"
                )
        if child in parents:
            raise files.make_error(
                joint,
                f"link {truncate_text(child)} has two parent joints; a closed loop needs an MJCF",
            )
        parents[child] = (parent, joint)
    # No cycles: the way to the root, which has no parent, has fewer steps than there are links.
    for name in links:
        ancestor, steps = name, 0
        while ancestor in parents:
            ancestor, _ = parents[ancestor]  # parent link, and the joint to it
            steps += 1
            if steps > len(links):
                raise files.make_error(links[name], f"link {truncate_text(name)} is its own parent")
    return parents


def _is_fixed_to_root(parents: Mapping[str, tuple[str, Element]], name: str) -> bool:
    """Return whether only fixed joints are between a link and the root, so that it never moves.

    Args:
        parents: parent link of each link, and the joint between them.
        name: name of the link.
    """
    while name in parents:
        name, joint = parents[name]
        if joint.get("type") != "fixed":
            return False
    return True


def _get_compiler_element(root: Element) -> Element:
    """Return the settings element of MuJoCo's compiler, which is created if missing."""
    blocks = find_children(root, "mujoco")
    block = blocks[0] if blocks else SubElement(root, "mujoco")
    compilers = find_children(block, "compiler")
    return compilers[0] if compilers else SubElement(block, "compiler")


def _check_mujoco_settings(files: ModelFileReader, root: Element) -> None:
    """Check the element ``<mujoco>`` of a URDF, in which MuJoCo would ignore wrong settings.

    Each setting, a child element such as ``<compiler>``, is parsed alone as an MJCF, in which
    MuJoCo reports unknown names.

    Args:
        files: reader of the files of the model.
        root: root element of the URDF.

    Raises:
        InputError: MuJoCo rejects a setting.
    """
    import mujoco

    for child in find_children(root, "mujoco"):
        for setting in child:
            settings = Element("mujoco")
            settings.append(Element(setting.tag, setting.attrib))
            try:
                mujoco.MjSpec.from_string(format_tree(settings)[0])
            except ValueError as error:
                message = re.sub(r", line \d+", "", format_mujoco_error(error))
                raise files.make_error(setting, message) from None


def _remove_repeated_elements(parts: Sequence[Element]) -> list[str]:
    """Remove repeated elements in a link or a joint, except for the first of each kind.

    A link may have several visual and collision shapes; these stay.

    Args:
        parts: links and joints of the file; changed in place.

    Returns:
        A note in a list that names what was removed; an empty list if nothing was.
    """
    repeated = []
    for part in parts:
        seen_tags: set[str] = set()
        for child in list(part):
            if child.tag in seen_tags and child.tag not in ("visual", "collision"):
                part.remove(child)
                repeated.append(f"<{child.tag}> of {part.tag} {part.get('name')}")
            seen_tags.add(child.tag)
    return [f"stated twice, the first is read: {format_name_list(repeated)}"] if repeated else []


def read_velocity_limits(root: Element) -> dict[str, float]:
    """Return the velocity limits of joints, rad/s or m/s, where the file specifies them.

    Args:
        root: Element ``<robot>``.

    Returns:
        Limits by joint name.
    """
    limits = {}
    for joint in find_children(root, "joint"):
        for limit in find_children(joint, "limit"):
            max_velocity = parse_number(limit.get("velocity"))
            if joint.get("type") in ONE_DOF_JOINT_TYPES and 0 < max_velocity < math.inf:
                limits[joint.get("name") or ""] = max_velocity
    return limits


def _remove_meaningless_limits(joints: Sequence[Element]) -> list[str]:
    """Remove limits that are meaningless, and return notes about the limits of joints.

    Removed are

    * all limits of joints without one degree of freedom,
    * effort limits (maximum force or torque) that are not positive,
    * position limits of continuous joints, without a note,
    * position ranges that are empty.

    Valid effort limits are noted too, because they have an influence on the motion.

    Args:
        joints: elements of the joints, changed in place.
    """
    invalid_efforts, empty_ranges, effort_limits = [], [], []
    for joint in joints:
        name, kind = joint.get("name") or "", joint.get("type")
        for limit in find_children(joint, "limit"):
            if kind not in ONE_DOF_JOINT_TYPES:
                joint.remove(limit)
                continue
            effort = parse_number(limit.get("effort"))
            if "effort" in limit.attrib and not (0 < effort < math.inf):
                invalid_efforts.append(name)
                del limit.attrib["effort"]
            elif effort > 0:
                effort_limits.append(f"{name} {effort:g}")
            # Missing limits count as zero, so a range without numbers is empty.
            lower, upper = (parse_number(limit.get(key)) for key in ("lower", "upper"))
            is_continuous = kind == "continuous"
            if is_continuous or lower >= upper:
                if not is_continuous:
                    empty_ranges.append(name)
                limit.attrib.pop("lower", None)
                limit.attrib.pop("upper", None)
    notes = []
    if effort_limits:
        notes.append(
            "effort limits clamp what actuators exert (N·m or N): "
            f"{format_name_list(effort_limits)}"
        )
    if invalid_efforts:
        notes.append(
            "an effort limit that is not positive is read as none: "
            f"{format_name_list(invalid_efforts)}"
        )
    if empty_ranges:
        notes.append(
            f"a lower limit not below the upper is read as none: {format_name_list(empty_ranges)}"
        )
    return notes


def stiffen_mimics(spec: Any) -> None:
    """Make mimic joints follow as stiffly as MuJoCo allows.

    URDF specifies a rigid relation, and MuJoCo's default equality follows it with a delay of 20 ms.

    Args:
        spec: mujoco.MjSpec of a URDF, whose only equalities are those of mimic joints.
    """
    for equality in spec.equalities:
        equality.solref = RIGID_SOLREF
        equality.solimp = FRICTION_SOLIMP


def _remove_unsupported_mimics(joints: Sequence[Element]) -> list[str]:
    """Remove mimic elements that MuJoCo cannot represent, and return notes about all of them.

    A mimic joint follows another joint: q = multiplier q_other + offset. Both must exist and have
    one degree of freedom.

    Args:
        joints: elements of the joints, changed in place.
    """
    kinds = {joint.get("name"): joint.get("type") for joint in joints}
    kept_mimics, removed_mimics = [], []  # texts for the notes
    for joint in joints:
        for mimic in find_children(joint, "mimic"):
            name, leading_joint = joint.get("name") or "", mimic.get("joint") or ""
            if (
                joint.get("type") in ONE_DOF_JOINT_TYPES
                and kinds.get(leading_joint) in ONE_DOF_JOINT_TYPES
                and name != leading_joint
            ):
                factor, offset = mimic.get("multiplier") or "1", mimic.get("offset") or "0"
                kept_mimics.append(f"{name} = {factor} {leading_joint} + {offset}")
            else:
                joint.remove(mimic)
                removed_mimics.append(f"{name} ({leading_joint})")
    notes = []
    if kept_mimics:
        notes.append(
            f"mimic joints follow as stiffly as MuJoCo allows: {format_name_list(kept_mimics)}"
        )
    if removed_mimics:
        notes.append(
            "mimics of joints that do not move, or are not there: "
            f"{format_name_list(removed_mimics)}"
        )
    return notes
