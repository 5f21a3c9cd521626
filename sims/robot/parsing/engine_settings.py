"""Time step, integrator and fixed base that a recording sets in a model file."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypedDict

from sims.core import toml_validation
from sims.core.simulator import InputError, make_unknown_name_error


class EngineTable(TypedDict, total=False):
    """Table ``[engine]`` of a recording."""

    timestep: float
    integrator: str
    fix_base: bool


INTEGRATORS = ("Euler", "RK4", "implicit", "implicitfast")
"""Names of integrators, in the order of MuJoCo's mjtIntegrator."""


MIN_TIME_STEP, MAX_TIME_STEP = 1e-9, 1.0
"""Smallest and largest allowed time step, in seconds."""


def apply_engine_settings(spec: Any, table: Mapping[str, Any], source: str) -> list[str]:
    """Apply the time step and integrator of a recording to a model, and fix its base.

    Args:
        spec: a mujoco.MjSpec; it is changed in place.
        table: ``timestep`` in s, ``integrator`` by MuJoCo's name, and whether to ``fix_base``.
        source: beginning of error messages.

    Returns:
        Notes about the fixed bodies and omitted keyframes.

    Raises:
        InputError: the table is invalid.
    """
    import mujoco

    settings = toml_validation.check_entries(
        source, "engine", table, toml_validation.get_type_hints_of(EngineTable)
    )
    if "timestep" in settings:
        step = toml_validation.check_finite(source, "engine.timestep", settings["timestep"])
        if not MIN_TIME_STEP <= step <= MAX_TIME_STEP:
            raise toml_validation.make_error(
                source, "engine.timestep", f"{MIN_TIME_STEP:g} to {MAX_TIME_STEP:g} s", step
            )
        spec.option.timestep = step
    if "integrator" in settings:
        name = settings["integrator"]
        if name not in INTEGRATORS:
            raise InputError(
                f"{source}: engine: {make_unknown_name_error('integrator', name, INTEGRATORS)}"
            )
        spec.option.integrator = int(mujoco.mjtIntegrator(INTEGRATORS.index(name)))
    return fix_bases(spec) if settings.get("fix_base") else []


def fix_bases(spec: Any) -> list[str]:
    """Fix all free bodies where the model file has them, and return notes about it.

    Keyframes are left out, since they have the coordinates of free joints.

    Args:
        spec: a mujoco.MjSpec; it is changed in place.
    """
    import mujoco

    free = [joint for joint in spec.joints if joint.type == mujoco.mjtJoint.mjJNT_FREE]
    if not free:
        return ["fix_base: no body of the model file floats"]
    names = [joint.parent.name for joint in free]
    keyframes = list(spec.keys)
    for element in (*free, *keyframes):
        spec.delete(element)
    left_out = f"; {len(keyframes)} keyframes are left out" if keyframes else ""
    return [f"fixed in the pose of the model file: {', '.join(names)}{left_out}"]
