"""Repair inertias and shapes of URDF links for MuJoCo."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from xml.etree.ElementTree import Element, SubElement

import numpy as np

from sims.core.value_limits import truncate_text
from sims.robot.note_text import format_item_list, format_name_list
from sims.robot.parsing import inertia_repair
from sims.robot.parsing.mesh_lookup import MeshLookup
from sims.robot.parsing.xml_files import ModelFileReader, find_children

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

    Args:
        files: reader of the model file.
        links: link elements by name; changed in place.
        fixed_links: links that are fused to the world, which need no notes.

    Returns:
        Notes about the repairs.

    Raises:
        InputError: a mass is negative, or an entry is not a number.
    """
    point_masses, raised_links, inferred_links = [], [], []
    for name, link in links.items():
        inertials = find_children(link, "inertial")
        if not inertials:
            inferred_links += (
                [name] if find_children(link, "collision") and name not in fixed_links else []
            )
            continue
        weight = get_link_mass(link)
        if not 0 <= weight < math.inf:
            raise files.make_error(
                inertials[0], f"link {truncate_text(name)}: its mass is {weight:g} kg"
            )
        if not find_children(inertials[0], "mass"):
            SubElement(inertials[0], "mass", value="0")
        tensor = (find_children(inertials[0], "inertia") or [SubElement(inertials[0], "inertia")])[
            0
        ]
        entries = [parse_number(tensor.get(key)) for key in TENSOR_ENTRIES]
        if not np.isfinite(entries).all():
            raise files.make_error(
                tensor, f"link {truncate_text(name)}: its inertia is not made of numbers"
            )
        change = _raise_moments(tensor, entries)
        if name in fixed_links or weight < FRAME_MASS_THRESHOLD or not change:
            continue
        point_masses += [name] if max(map(abs, entries)) < inertia_repair.NEGLIGIBLE_MOMENT else []
        raised_links += [f"{name} {change}"] if name not in point_masses else []
    return _format_repair_notes(point_masses, raised_links, inferred_links)


def _raise_moments(tensor: Element, entries: Sequence[float]) -> str:
    """Raise principal moments that are not positive; return a text about the change."""
    moments, axes = inertia_repair.compute_principal_moments(entries)
    if moments[0] >= inertia_repair.NEGLIGIBLE_MOMENT:
        return ""
    after = inertia_repair.find_nearest_valid_moments(moments)
    for key, entry in zip(
        TENSOR_ENTRIES, inertia_repair.compose_inertia_tensor(after, axes), strict=True
    ):
        tensor.set(key, repr(entry))
    return inertia_repair.format_moments(moments, after)


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
        min_moment = f"{inertia_repair.MIN_MOMENT:g} kg·m²"
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

    Args:
        files: reader of the model file.
        links: link elements by name; changed in place.
        compiler: settings of MuJoCo's compiler; changed in place.
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
        has_mass = (
            bool(find_children(link, "inertial")) and not is_mass_inferred
        ) or name in fixed_links
        for shape in find_children(link, "visual"):
            link.remove(shape)
        for shape in find_children(link, "collision"):
            if not _resolve_collision_shape(files, name, shape, meshes, has_mass):
                link.remove(shape)
    return meshes.notes


def _resolve_collision_shape(
    files: ModelFileReader, name: str, shape: Element, meshes: MeshLookup, has_mass: bool
) -> bool:
    """Return whether a collision shape can be read, and set the path of its mesh."""
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
