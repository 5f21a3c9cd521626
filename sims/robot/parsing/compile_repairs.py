"""Repairs that MuJoCo needs to compile a model file."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from sims.core.simulator import Array, InputError
from sims.robot.inertia_tensors import (
    MIN_MOMENT,
    ROUNDING_SHARE,
    compose_inertia_tensor,
    compute_principal_moments,
    compute_triangle_violation,
    find_nearest_valid_moments,
    format_moments,
)
from sims.robot.mujoco_messages import format_item_list, format_mujoco_error, format_name_list
from sims.robot.parsing.mesh_files import OmittedShapes, find_assets_of_file, remove_asset
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
        omitted: omitted shapes and textures.
        balanced: bodies whose principal moments were changed, with the values before and after.
        massless: bodies that were given a mass, by whether other bodies are attached to them.
        slight: bodies that were given moments of inertia.
    """

    files: ModelFileReader
    omitted: OmittedShapes
    balanced: list[str] = field(default_factory=list)
    massless: dict[bool, list[str]] = field(default_factory=dict)
    slight: list[str] = field(default_factory=list)

    def compile(self, spec: Any) -> tuple[Any, Any]:
        """Compile an editable model, and repair what MuJoCo rejects.

        MuJoCo reports one error at a time. So the model is compiled again after each repair. The
        number of attempts is limited to two for each body and asset, and two more.

        Args:
            spec: editable model (`mujoco.MjSpec`); it must not be used afterwards.

        Returns:
            The repaired spec, copied before compilation since a compiled spec holds all meshes
            twice; and the compiled model.

        Raises:
            InputError: MuJoCo rejects the model; contains MuJoCo's message.
        """
        assets = (*spec.meshes, *spec.hfields, *spec.skins, *spec.textures)
        for _ in range(2 * (len(spec.bodies) + len(assets)) + 2):
            # Only errors of the compiler are repaired; an `InputError` of a repair is already for
            # the user.
            try:
                uncompiled = spec.copy()
                return uncompiled, spec.compile()
            except InputError:
                raise
            except Exception as error:  # MuJoCo raises several kinds of errors.
                message = format_mujoco_error(error)
                if not self._repair_named_element(spec, message):
                    break
        raise self.files.make_mujoco_error(message)

    def _repair_named_element(self, spec: Any, message: str) -> bool:
        """Repair the element that MuJoCo's message names.

        The message is the only information about the reason, so its text is searched. The repairs
        are:

        * principal moments that violate the triangle inequality: replace them,
        * a moving body without mass or inertia: give it a small one,
        * a file that does not exist, or a mesh or texture that MuJoCo refuses: remove the asset.

        Args:
            spec: the model as an `MjSpec`, changed in place.
            message: message of MuJoCo's compiler.

        Returns:
            Whether anything was changed; otherwise the user must change the file.
        """
        name_match = re.search(r"Element name '(.*?)', id", message)
        name = name_match[1] if name_match else ""
        # MuJoCo's message names its setting that would repair the moments.
        if "balanceinertia" in message:
            return self._repair_triangle_inequality(spec)
        if "mass and inertia of moving bodies" in message:
            return self._set_default_mass(spec, name)
        missing_file = re.search(r"opening file '(.*?)'", message)
        if missing_file:
            assets, reason = find_assets_of_file(spec, missing_file[1]), "is absent"
        else:
            reason = f"is refused by MuJoCo ({re.sub(r'; Element.*|Error: ', '', message)})"
            assets = []
            if TEXTURE_ERROR_PATTERN.search(reason):
                assets = [texture for texture in spec.textures if texture.name == name]
            if not assets and MESH_ERROR_PATTERN.search(reason):
                assets = [mesh for mesh in spec.meshes if mesh.name == name]
        for asset in assets:
            remove_asset(spec, asset, reason, self.omitted)
        return bool(assets)

    def _repair_triangle_inequality(self, spec: Any) -> bool:
        """Replace principal moments that no rigid body can have, in all bodies.

        The moments A <= B <= C of a body satisfy the triangle inequality A + B >= C. Each changed
        body is noted in `balanced`, with the values before and after.

        Args:
            spec: the model as an `MjSpec`, changed in place.

        Returns:
            Whether any body was changed.
        """
        notes_before = len(self.balanced)
        for body in spec.bodies:
            moments, axes = _get_principal_moments(body)
            if compute_triangle_violation(moments) > 0:
                valid_moments = find_nearest_valid_moments(moments)
                _set_principal_moments(body, valid_moments, axes)
                self.balanced.append(f"{body.name} {format_moments(moments, valid_moments)}")
        return len(self.balanced) > notes_before

    def _set_default_mass(self, spec: Any, name: str) -> bool:
        """Give a moving body the default mass and moments of inertia, where it has less.

        MuJoCo refuses moving bodies without mass or inertia. A changed body is noted: in `slight`
        if it had a mass; otherwise in `massless`, by whether other bodies are attached to it
        (without any, its joints have little effect).

        Args:
            spec: the model as an `MjSpec`, changed in place.
            name: name of the body.

        Returns:
            Whether the body was changed.
        """
        body = next((body for body in spec.bodies if body.name == name), None)
        if body is None:
            return False
        # NaN is a mass that the file does not state.
        mass, (moments, axes) = float(np.nan_to_num(body.mass)), _get_principal_moments(body)
        is_too_light = mass < DEFAULT_BODY_MASS
        has_small_moments = min(moments) < MIN_MOMENT * (1 - ROUNDING_SHARE)
        body.mass = max(mass, DEFAULT_BODY_MASS)
        _set_principal_moments(body, np.maximum(moments, MIN_MOMENT), axes)
        body.explicitinertial = True
        if is_too_light:
            has_children = any(b.parent is not None and b.parent.name == name for b in spec.bodies)
            self.massless.setdefault(has_children, []).append(name)
        elif has_small_moments:
            self.slight.append(name)
        return is_too_light or has_small_moments

    @property
    def notes(self) -> list[str]:
        """Notes about omitted shapes, and one note for each kind of repair of bodies."""
        notes = self.omitted.notes
        if self.balanced:
            notes.append(
                "no body has principal moments A + B < C; the nearest are taken (kg·m²): "
                f"{format_item_list(self.balanced)}"
            )
        repair_text = f"given {DEFAULT_BODY_MASS:g} kg and moments of {MIN_MOMENT:g} kg·m²"
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
            min_moment = f"{MIN_MOMENT:g} kg·m²"
            notes.append(
                f"move without moments of inertia; given {min_moment}: "
                f"{format_name_list(self.slight)}"
            )
        return notes


def _get_principal_moments(body: Any) -> tuple[Array, Array | None]:
    """Return the principal moments of inertia of a body in kg m^2, and their axes.

    A model file states either a full inertia tensor, or moments about the axes of the body's
    inertial frame; the axes are None then. Numbers that are missing count as zero.

    Args:
        body: body of a `mujoco.MjSpec`.

    Returns:
        Moments (3,), and axes (3, 3) as columns or None.
    """
    tensor = np.asarray(body.fullinertia, dtype=float)
    if np.isfinite(tensor).all() and tensor.any():
        return compute_principal_moments(list(tensor))
    return np.nan_to_num(np.asarray(body.inertia, dtype=float)), None


def _set_principal_moments(body: Any, moments: Array, axes: Array | None) -> None:
    """Write principal moments in kg m^2 into a body of the spec, about the given axes.

    Without axes, they are about the axes of the body's inertial frame.

    Args:
        body: body of a `mujoco.MjSpec`, changed in place.
        moments: (3,) principal moments in kg m^2.
        axes: (3, 3) principal axes as columns; None for those of the inertial frame.
    """
    if axes is None:
        body.inertia = moments
    else:
        body.fullinertia = compose_inertia_tensor(moments, axes)
