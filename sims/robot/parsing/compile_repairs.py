"""Automatic repairs that make a model compile: moments of inertia, massless bodies, meshes."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from sims.core.simulator import Array, InputError
from sims.robot.mujoco_messages import format_mujoco_error
from sims.robot.note_text import format_item_list, format_name_list
from sims.robot.parsing import inertia_repair
from sims.robot.parsing.missing_meshes import OmittedShapes, remove_mesh, remove_texture
from sims.robot.parsing.xml_files import ModelFileReader

DEFAULT_BODY_MASS = 1e-6
"""Mass, in kg, given to a moving body without a mass."""
MESH_ERROR_PATTERN = re.compile(r"mesh|vert|face|stl|obj|msh|hull|volume", re.IGNORECASE)
TEXTURE_ERROR_PATTERN = re.compile(r"png|ktx|texture|image", re.IGNORECASE)


@dataclass
class CompileRepairs:
    """Repairs made while a spec was compiled.

    Attributes:
        files: reader of the model file and its assets.
        left: omitted shapes.
        balanced: bodies whose principal moments were changed, with the values before and after.
        massless: bodies that were given a mass, by whether other bodies are attached to them.
        slight: bodies that were given moments of inertia.
    """

    files: ModelFileReader
    left: OmittedShapes
    balanced: list[str] = field(default_factory=list)
    massless: dict[bool, list[str]] = field(default_factory=dict)
    slight: list[str] = field(default_factory=list)

    def compile(self, spec: Any) -> tuple[Any, Any]:
        """Compile a spec, and repair what MuJoCo rejects.

        MuJoCo reports one error at a time. So the spec is compiled again after each repair;
        the number of attempts is limited by two for each body, mesh and texture.

        Args:
            spec: a mujoco.MjSpec; it must not be used afterwards.

        Returns:
            The repaired spec, copied before compilation since a compiled spec holds all meshes
            twice; and the compiled model.

        Raises:
            InputError: MuJoCo rejects the model; contains MuJoCo's message.
        """
        for _ in range(2 * (len(spec.bodies) + len(spec.meshes) + len(spec.textures)) + 2):
            try:
                uncompiled = spec.copy()
                return uncompiled, spec.compile()
            except InputError:
                raise
            except Exception as error:
                message = format_mujoco_error(error)
                if not self._repair_named_element(spec, message):
                    break
        raise self.files.make_mujoco_error(message)

    def _repair_named_element(self, spec: Any, message: str) -> bool:
        """Repair the element that MuJoCo's message names, and return whether anything was changed.

        The message is the only information about the reason, so its text is searched. False
        means that it fits no known repair, and that the user must change the file.
        """
        name_match = re.search(r"Element name '(.*?)', id", message)
        name = name_match[1] if name_match else ""
        if "balanceinertia" in message:
            return self._repair_triangle_inequality(spec)
        if "mass and inertia of moving bodies" in message:
            return self._set_default_mass(spec, name)
        reason = f"is refused by MuJoCo ({re.sub(r'; Element.*|Error: ', '', message)})"
        if TEXTURE_ERROR_PATTERN.search(reason) and remove_texture(spec, name, reason, self.left):
            return True
        return bool(MESH_ERROR_PATTERN.search(reason)) and remove_mesh(
            spec, name, reason, self.left
        )

    def _repair_triangle_inequality(self, spec: Any) -> bool:
        """Replace principal moments that violate the triangle inequality A + B >= C, in all bodies.

        Returns whether any body was changed; no rigid body can have moments that violate
        it.
        """
        before = len(self.balanced)
        for body in spec.bodies:
            moments, axes = _get_principal_moments(body)
            if inertia_repair.compute_triangle_violation(moments) > 0:
                after = inertia_repair.find_nearest_valid_moments(moments)
                _set_principal_moments(body, after, axes)
                self.balanced.append(f"{body.name} {inertia_repair.format_moments(moments, after)}")
        return len(self.balanced) > before

    def _set_default_mass(self, spec: Any, name: str) -> bool:
        """Give a moving body the default mass and the least moments, where it has less.

        Returns whether the body was changed. `has_children` is whether other bodies are attached
        to it.
        """
        for body in [body for body in spec.bodies if body.name == name]:
            mass, (moments, axes) = float(np.nan_to_num(body.mass)), _get_principal_moments(body)
            is_too_light, has_small_moments = (
                mass < DEFAULT_BODY_MASS,
                min(moments) < inertia_repair.MIN_MOMENT * (1 - inertia_repair.ROUNDING_SHARE),
            )
            body.mass = max(mass, DEFAULT_BODY_MASS)
            _set_principal_moments(body, np.maximum(moments, inertia_repair.MIN_MOMENT), axes)
            body.explicitinertial = True
            if is_too_light:
                has_children = any(
                    b.parent is not None and b.parent.name == name for b in spec.bodies
                )
                self.massless.setdefault(has_children, []).append(name)
            elif has_small_moments:
                self.slight.append(name)
            return is_too_light or has_small_moments
        return False

    @property
    def notes(self) -> list[str]:
        """Notes, one for each kind of repair."""
        notes = self.left.notes
        if self.balanced:
            notes.append(
                "no body has principal moments A + B < C; the nearest are taken (kg·m²): "
                f"{format_item_list(self.balanced)}"
            )
        repair_text = (
            f"given {DEFAULT_BODY_MASS:g} kg and moments of {inertia_repair.MIN_MOMENT:g} kg·m²"
        )
        for has_children, names in self.massless.items():
            childless_note = (
                ""
                if has_children
                else ", and carry no other bodies, so their joints have little effect"
            )
            notes.append(
                f"move without a mass{childless_note}; {repair_text}: {format_name_list(names)}"
            )
        if self.slight:
            min_moment = f"{inertia_repair.MIN_MOMENT:g} kg·m²"
            notes.append(
                f"move without moments of inertia; given {min_moment}: "
                f"{format_name_list(self.slight)}"
            )
        return notes


def _get_principal_moments(body: Any) -> tuple[Array, Array | None]:
    """Return the specified principal moments in kg m^2, and their axes or None.

    None stands for the axes of the body's inertial frame.
    """
    tensor = np.asarray(body.fullinertia, dtype=float)
    if np.isfinite(tensor).all() and tensor.any():
        return inertia_repair.compute_principal_moments(list(tensor))
    return np.nan_to_num(np.asarray(body.inertia, dtype=float)), None


def _set_principal_moments(body: Any, moments: Array, axes: Array | None) -> None:
    """Write principal moments in kg m^2 into a body of the spec, about the given axes.

    Without axes, they are about the axes of the body's inertial frame.
    """
    if axes is None:
        body.inertia = moments
    else:
        body.fullinertia = inertia_repair.compose_inertia_tensor(moments, axes)
