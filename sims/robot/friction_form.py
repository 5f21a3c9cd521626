"""Solver forms of the dry friction that effects add to the joints of a robot."""

from __future__ import annotations

from typing import Literal

FrictionForm = Literal["stiff", "soft"]
"""Form in which MuJoCo's solver applies the dry friction that effects add.

``stiff`` is Coulomb friction that is as stiff as the integrator allows. ``soft`` keeps the solver
parameters of the model file (`solreffriction`, `solimpfriction`), or MuJoCo's defaults if the file
does not specify them.
"""
FRICTION_FORMS: tuple[FrictionForm, ...] = ("stiff", "soft")
"""All values of `FrictionForm`."""
