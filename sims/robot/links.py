"""Repair inertias and shapes of URDF links for MuJoCo."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from xml.etree.ElementTree import Element, SubElement

import numpy as np

from sims.limits import cut
from sims.robot import inertia
from sims.robot.meshes import Meshes
from sims.robot.words import listed, told
from sims.robot.xmlfile import Files, children

ENTRIES = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
LIGHT = 1e-6
"""Mass, in kg, below which a link counts as a mere frame, whose inertia needs no note."""
FOLDERS = ("meshdir", "assetdir", "texturedir", "strippath", "discardvisual")
"""Settings of MuJoCo's compiler about mesh files, which are removed after the meshes were found."""


def number(text: str | None) -> float:
    """Parse a number; 0 for a missing text, NaN for an invalid one."""
    try:
        return float(text) if text else 0.0
    except ValueError:
        return math.nan


def mass(link: Element) -> float:
    """Return the mass that a link specifies, in kg; 0 if it specifies none."""
    stated = children(link, "inertial", "mass")
    return number(stated[0].get("value")) if stated else 0.0


def inertials(files: Files, links: Mapping[str, Element], held: set[str]) -> list[str]:
    """Repair masses and moments of inertia.

    Args:
        files: reader of the model file.
        links: link elements by name; changed in place.
        held: links that are fused to the world, which need no notes.

    Returns:
        Notes about the repairs.

    Raises:
        InputError: a mass is negative, or an entry is not a number.
    """
    points, raised, inferred = [], [], []
    for name, link in links.items():
        stated = children(link, "inertial")
        if not stated:
            inferred += [name] if children(link, "collision") and name not in held else []
            continue
        weight = mass(link)
        if not 0 <= weight < math.inf:
            raise files.fault(stated[0], f"link {cut(name)}: its mass is {weight:g} kg")
        if not children(stated[0], "mass"):
            SubElement(stated[0], "mass", value="0")
        tensor = (children(stated[0], "inertia") or [SubElement(stated[0], "inertia")])[0]
        entries = [number(tensor.get(key)) for key in ENTRIES]
        if not np.isfinite(entries).all():
            raise files.fault(tensor, f"link {cut(name)}: its inertia is not made of numbers")
        change = _raised(tensor, entries)
        if name in held or weight < LIGHT or not change:
            continue
        points += [name] if max(map(abs, entries)) < inertia.NONE else []
        raised += [f"{name} {change}"] if name not in points else []
    return _said(points, raised, inferred)


def _raised(tensor: Element, entries: Sequence[float]) -> str:
    """Raise principal moments that are not positive; return a text about the change."""
    moments, axes = inertia.principal(entries)
    if moments[0] >= inertia.NONE:
        return ""
    after = inertia.nearest(moments)
    for key, entry in zip(ENTRIES, inertia.tensor(after, axes), strict=True):
        tensor.set(key, repr(entry))
    return inertia.shown(moments, after)


def _said(points: list[str], raised: list[str], inferred: list[str]) -> list[str]:
    notes = []
    if points:
        least = f"{inertia.LEAST:g} kg m^2"
        notes.append(f"a mass and no moments of inertia, so a point ({least}): {listed(points)}")
    if raised:
        notes.append(
            "principal moments that are not positive; the nearest that a body can have are taken "
            f"(kg m^2): {told(raised)}"
        )
    if inferred:
        notes.append(
            "no mass stated; it follows from the collision shapes at 1000 kg/m^3, as MuJoCo does: "
            f"{listed(inferred)}"
        )
    return notes


def shapes(
    files: Files, links: Mapping[str, Element], compiler: Element, held: set[str]
) -> list[str]:
    """Remove visual shapes, and collision shapes whose mesh is missing or of an unsupported format.

    Args:
        files: reader of the model file.
        links: link elements by name; changed in place.
        compiler: settings of MuJoCo's compiler; changed in place.
        held: links that are fused to the world, whose mass does not matter.

    Returns:
        Notes about the omitted shapes.

    Raises:
        InputError: the mass of a moving link would depend on a missing mesh.
    """
    meshes = Meshes(files, compiler.get("meshdir") or compiler.get("assetdir") or "")
    inferring = compiler.get("inertiafromgeom") == "true"
    for key in FOLDERS:
        compiler.attrib.pop(key, None)
    for name, link in links.items():
        stated = (bool(children(link, "inertial")) and not inferring) or name in held
        for shape in children(link, "visual"):
            link.remove(shape)
        for shape in children(link, "collision"):
            if not _kept(files, name, shape, meshes, stated):
                link.remove(shape)
    return meshes.notes


def _kept(files: Files, name: str, shape: Element, meshes: Meshes, stated: bool) -> bool:
    """Return whether a collision shape can be read, and set the path of its mesh."""
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
        meshes.leave_out(file, why)
        return False
    return True
