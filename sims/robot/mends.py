"""Automatic repairs that make a model compile: moments of inertia, massless bodies, meshes."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from sims.base import Array, InputError
from sims.robot import inertia
from sims.robot.quiet import one_line
from sims.robot.shapes import Left, without_mesh, without_picture
from sims.robot.words import listed, told
from sims.robot.xmlfile import Files

MASS = 1e-6
"""Mass, in kg, given to a moving body without a mass."""
ABOUT_A_MESH = re.compile(r"mesh|vert|face|stl|obj|msh|hull|volume", re.IGNORECASE)
ABOUT_A_PICTURE = re.compile(r"png|ktx|texture|image", re.IGNORECASE)


@dataclass
class Mends:
    """Repairs made while a spec was compiled.

    Attributes:
        files: reader of the model file and its assets.
        left: omitted shapes.
        balanced: bodies whose principal moments were changed, with the values before and after.
        massless: bodies that were given a mass, by whether other bodies are attached to them.
        slight: bodies that were given moments of inertia.
    """

    files: Files
    left: Left
    balanced: list[str] = field(default_factory=list)
    massless: dict[bool, list[str]] = field(default_factory=dict)
    slight: list[str] = field(default_factory=list)

    def compiled(self, spec: Any) -> tuple[Any, Any]:
        """Compile a spec, and repair what MuJoCo rejects.

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
                before = spec.copy()
                return before, spec.compile()
            except InputError:
                raise
            except Exception as error:
                said = one_line(error)
                if not self._mended(spec, said):
                    break
        raise self.files.refused(said)

    def _mended(self, spec: Any, said: str) -> bool:
        found = re.search(r"Element name '(.*?)', id", said)
        name = found[1] if found else ""
        if "balanceinertia" in said:
            return self._balance(spec)
        if "mass and inertia of moving bodies" in said:
            return self._weigh(spec, name)
        why = f"is refused by MuJoCo ({re.sub(r'; Element.*|Error: ', '', said)})"
        if ABOUT_A_PICTURE.search(why) and without_picture(spec, name, why, self.left):
            return True
        return bool(ABOUT_A_MESH.search(why)) and without_mesh(spec, name, why, self.left)

    def _balance(self, spec: Any) -> bool:
        before = len(self.balanced)
        for body in spec.bodies:
            moments, axes = _moments(body)
            if inertia.lack(moments) > 0:
                after = inertia.nearest(moments)
                _state(body, after, axes)
                self.balanced.append(f"{body.name} {inertia.shown(moments, after)}")
        return len(self.balanced) > before

    def _weigh(self, spec: Any, name: str) -> bool:
        for body in [body for body in spec.bodies if body.name == name]:
            mass, (moments, axes) = float(np.nan_to_num(body.mass)), _moments(body)
            light, thin = mass < MASS, min(moments) < inertia.LEAST * (1 - inertia.ROUNDING)
            body.mass = max(mass, MASS)
            _state(body, np.maximum(moments, inertia.LEAST), axes)
            body.explicitinertial = True
            if light:
                carries = any(b.parent is not None and b.parent.name == name for b in spec.bodies)
                self.massless.setdefault(carries, []).append(name)
            elif thin:
                self.slight.append(name)
            return light or thin
        return False

    @property
    def notes(self) -> list[str]:
        """Notes, one for each kind of repair."""
        notes = self.left.notes
        if self.balanced:
            notes.append(
                "no body has principal moments A + B < C; the nearest are taken (kg m^2): "
                f"{told(self.balanced)}"
            )
        given = f"given {MASS:g} kg and moments of {inertia.LEAST:g} kg m^2"
        for carries, names in self.massless.items():
            hangs = "" if carries else ", and nothing hangs on them, so their joints mean little"
            notes.append(f"move without a mass{hangs}; {given}: {listed(names)}")
        if self.slight:
            least = f"{inertia.LEAST:g} kg m^2"
            notes.append(f"move without moments of inertia; given {least}: {listed(self.slight)}")
        return notes


def _moments(body: Any) -> tuple[Array, Array | None]:
    """Return the specified principal moments in kg m^2, and their axes or None.

    None stands for the axes of the body's inertial frame.
    """
    full = np.asarray(body.fullinertia, dtype=float)
    if np.isfinite(full).all() and full.any():
        return inertia.principal(list(full))
    return np.nan_to_num(np.asarray(body.inertia, dtype=float)), None


def _state(body: Any, moments: Array, axes: Array | None) -> None:
    if axes is None:
        body.inertia = moments
    else:
        body.fullinertia = inertia.tensor(moments, axes)
