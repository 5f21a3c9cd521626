"""The two forms of dry friction that effects add to a robot's joints."""

from __future__ import annotations

from typing import Literal

FrictionForm = Literal["stiff", "soft"]
"""How MuJoCo's solver holds the dry friction that effects add: ``stiff`` is Coulomb friction, as
stiff as the integrator allows; ``soft`` leaves the solver parameters of the model file
(`solreffriction`, `solimpfriction`, MuJoCo's defaults where the file states none).
"""
FRICTION_FORMS: tuple[FrictionForm, ...] = ("stiff", "soft")
"""Both forms."""
