"""Actuators and engine settings that a recording adds to a model file."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypedDict

from sims import user_toml
from sims.base import InputError, unknown
from sims.limits import cut
from sims.user_toml import Pair


class ActuatorTable(TypedDict, total=False):
    """Table ``[actuators.NAME]`` of a recording."""

    joint: str
    kind: str
    kp: float
    ki: float
    kd: float
    kv: float
    gear: float
    control_range: Pair
    force_range: Pair
    # These two are read with the recording (`sims.recording.drive_switches`). They are listed here
    # so that error messages name them.
    enable: str
    disable: str


class EngineTable(TypedDict, total=False):
    """Table ``[engine]`` of a recording."""

    timestep: float
    integrator: str


ALWAYS = ("joint", "kind", "gear", "control_range", "force_range")
GAINS: Mapping[str, tuple[str, ...]] = {
    "motor": (),
    "position": ("kp", "kv"),
    "velocity": ("kv",),
    "pid": ("kp", "ki", "kd", "kv"),
}
"""Gains by kind of actuator; the first one is required."""
INTEGRATORS = ("Euler", "RK4", "implicit", "implicitfast")
"""Names of integrators, in the order of MuJoCo's mjtIntegrator."""
SHORTEST, LONGEST = 1e-9, 1.0
"""Smallest and largest allowed time step, in seconds."""


def add_actuators(spec: Any, tables: Mapping[str, Any], source: str) -> tuple[str, ...]:
    """Add actuators to a model.

    With the gear times the joint's position l, its rate v and the control u, they exert

        motor     u                                                                             (1)
        position  kp (u - l) - kv v                                                             (2)
        velocity  kv (u - v)                                                                    (3)
        pid       kp (u - l) + ki ∫(u - l) dt - kv v                                            (4)
        pid       kp (u - l) + ki ∫(u - l) dt + kd (du/dt - v)                                  (5)

    within their force range. The joint receives the gear times this force. In (5), which applies if
    kd is given, the actuator has a second control, the rate of u; the caller that steps the model
    must set it.

    Args:
        spec: a mujoco.MjSpec; it is changed in place.
        tables: tables as in a recording's TOML, by name of the actuator.
        source: beginning of error messages.

    Returns:
        The names of the actuators with kd.

    Raises:
        InputError: a table is invalid; existing names are listed.
    """
    rated = []
    for name, given in tables.items():
        where = f"actuators.{name}"
        table = user_toml.entries(source, where, given, user_toml.hints_of(ActuatorTable))
        _check(spec, source, where, name, table)
        _add(spec, name, table)
        rated += [name] if "kd" in table else []
    return tuple(rated)


def _check(spec: Any, source: str, where: str, name: str, table: Mapping[str, Any]) -> None:
    for key in ("joint", "kind"):
        if key not in table:
            raise InputError(f"{source}: {where} states no {key}")
    kind = table["kind"]
    if kind not in GAINS:
        raise InputError(f"{source}: {where}: {unknown('kind', kind, list(GAINS))}")
    joints = [joint.name for joint in spec.joints if _single(joint)]
    if table["joint"] not in joints:
        raise InputError(
            f"{source}: {where}: {unknown('joint', table['joint'], joints or ['none'])}"
        )
    if name in [actuator.name for actuator in spec.actuators]:
        raise InputError(f"{source}: {where}: the model has an actuator {cut(name)} already")
    allowed = (*ALWAYS, *GAINS[kind])
    user_toml.known(f"entry of [{where}], of kind {kind}", table, allowed)
    for key in GAINS[kind][:1]:
        if key not in table:
            raise InputError(
                f"{source}: {where}: kind {kind} needs {key}; free it if it is a guess"
            )
    if "kd" in table and "kv" in table:
        raise InputError(
            f"{source}: {where}: kd acts on the error's rate, kv on the joint's: give one"
        )
    for key in ("kp", "ki", "kd", "kv", "gear"):
        if key in table:
            value = user_toml.finite(source, f"{where}.{key}", table[key])
            if value < 0 and key != "gear":
                raise user_toml.fault(source, f"{where}.{key}", "0 or more", value)


def _single(joint: Any) -> bool:
    import mujoco

    return joint.type in (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)


def _add(spec: Any, name: str, table: Mapping[str, Any]) -> None:
    import mujoco

    actuator = spec.add_actuator(
        name=name, target=table["joint"], trntype=mujoco.mjtTrn.mjTRN_JOINT
    )
    gains = {key: float(table[key]) for key in ("kp", "ki", "kv") if key in table}
    if table["kind"] == "motor":
        actuator.set_to_motor()
    elif table["kind"] == "position":
        actuator.set_to_position(**gains)
    elif table["kind"] == "velocity":
        actuator.set_to_velocity(**gains)
    else:
        _set_pid(actuator, gains, table.get("kd"))
    actuator.gear = [float(table.get("gear", 1.0)), 0, 0, 0, 0, 0]
    if "control_range" in table:
        actuator.ctrlrange = list(table["control_range"])
        actuator.ctrllimited = mujoco.mjtLimited.mjLIMITED_TRUE
    if "force_range" in table:
        actuator.forcerange = list(table["force_range"])
        actuator.forcelimited = mujoco.mjtLimited.mjLIMITED_TRUE


def _set_pid(actuator: Any, gains: dict[str, float], kd: float | None) -> None:
    import mujoco

    if not hasattr(actuator, "set_to_pid"):
        raise InputError(f"kind pid needs MuJoCo 4, found {mujoco.__version__}")
    inputs = int(mujoco.mjtCtrlInput.mjINPUT_POS)
    if kd is not None:
        inputs |= int(mujoco.mjtCtrlInput.mjINPUT_VEL)
        gains["kv"] = float(kd)
    actuator.set_to_pid(**gains, ctrlspec=inputs)


def set_engine(spec: Any, table: Mapping[str, Any], source: str) -> None:
    """Apply the time step and integrator of a recording to a model.

    Args:
        spec: a mujoco.MjSpec; it is changed in place.
        table: ``timestep`` in s, ``integrator`` by MuJoCo's name.
        source: beginning of error messages.

    Raises:
        InputError: the table is invalid.
    """
    import mujoco

    given = user_toml.entries(source, "engine", table, user_toml.hints_of(EngineTable))
    if "timestep" in given:
        step = user_toml.finite(source, "engine.timestep", given["timestep"])
        if not SHORTEST <= step <= LONGEST:
            raise user_toml.fault(source, "engine.timestep", f"{SHORTEST:g} to {LONGEST:g} s", step)
        spec.option.timestep = step
    if "integrator" in given:
        name = given["integrator"]
        if name not in INTEGRATORS:
            raise InputError(f"{source}: engine: {unknown('integrator', name, INTEGRATORS)}")
        spec.option.integrator = int(mujoco.mjtIntegrator(INTEGRATORS.index(name)))
