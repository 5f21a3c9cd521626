"""Actuators that a recording adds to a model file."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypedDict

from sims.core import toml_validation
from sims.core.simulator import InputError, make_unknown_name_error
from sims.core.toml_validation import Range
from sims.core.user_messages import truncate_text


class ActuatorTable(TypedDict, total=False):
    """Table ``[actuators.NAME]`` of a recording."""

    joint: str
    kind: str
    kp: float
    ki: float
    kd: float
    kv: float
    gear: float
    control_range: Range
    force_range: Range
    # These two are read with the recording (`sims.recording.drive_switches`). They are listed here
    # so that error messages name them.
    enable: str
    disable: str


COMMON_ACTUATOR_KEYS = ("joint", "kind", "gear", "control_range", "force_range")
GAIN_KEYS_BY_KIND: Mapping[str, tuple[str, ...]] = {
    "motor": (),
    "position": ("kp", "kv"),
    "velocity": ("kv",),
    "pid": ("kp", "ki", "kd", "kv"),
}
"""Gains by kind of actuator; the first one is required."""


def add_actuators(spec: Any, tables: Mapping[str, Any], source: str) -> tuple[str, ...]:
    """Add the actuators that a recording's description states to a model.

    Let l be the joint's position times the gear, v the rate of l, and u the control. Actuators
    exert, by their kind,

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
    rate_controlled = []
    for name, entries in tables.items():
        table_name = f"actuators.{name}"
        table = toml_validation.check_entries(
            source, table_name, entries, toml_validation.get_type_hints_of(ActuatorTable)
        )
        _check_actuator_table(spec, source, table_name, name, table)
        _add_actuator(spec, name, table)
        rate_controlled += [name] if "kd" in table else []
    return tuple(rate_controlled)


def _check_actuator_table(
    spec: Any, source: str, table_name: str, name: str, table: Mapping[str, Any]
) -> None:
    """Check the table of an added actuator.

    * It states a joint with one degree of freedom, and a kind.
    * Its name is not that of another actuator.
    * It has only the gains of its kind, and the first of these is required.
    * Not both kd and kv are given: kd acts on the rate of the error, kv on that of the joint.
    * Numbers are finite, and gains are not negative.

    Args:
        spec: editable MuJoCo model (`mujoco.MjSpec`) with the joints and actuators of the file.
        source: beginning of error messages, the file.
        table_name: name of the table in error messages, such as ``actuators.elbow``.
        name: name of the new actuator.
        table: entries of the table.

    Raises:
        InputError: the model cannot have this actuator.
    """
    import mujoco

    for key in ("joint", "kind"):
        if key not in table:
            raise InputError(f"{source}: {table_name} states no {key}")
    kind = table["kind"]
    if kind not in GAIN_KEYS_BY_KIND:
        error = make_unknown_name_error("kind", kind, list(GAIN_KEYS_BY_KIND))
        raise InputError(f"{source}: {table_name}: {error}")
    one_axis_types = mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE
    joints = [joint.name for joint in spec.joints if joint.type in one_axis_types]
    if table["joint"] not in joints:
        error = make_unknown_name_error("joint", table["joint"], joints or ["none"])
        raise InputError(f"{source}: {table_name}: {error}")
    if name in [actuator.name for actuator in spec.actuators]:
        raise InputError(
            f"{source}: {table_name}: the model has an actuator {truncate_text(name)} already"
        )
    allowed = (*COMMON_ACTUATOR_KEYS, *GAIN_KEYS_BY_KIND[kind])
    toml_validation.check_known_names(f"entry of [{table_name}], of kind {kind}", table, allowed)
    # The first gain is required; a motor has none.
    for key in GAIN_KEYS_BY_KIND[kind][:1]:
        if key not in table:
            raise InputError(
                f"{source}: {table_name}: kind {kind} needs {key}; free it if it is a guess"
            )
    if "kd" in table and "kv" in table:
        raise InputError(
            f"{source}: {table_name}: kd acts on the error's rate, kv on the joint's: give one"
        )
    for key in ("kp", "ki", "kd", "kv", "gear"):
        if key in table:
            value = toml_validation.check_finite(source, f"{table_name}.{key}", table[key])
            if value < 0 and key != "gear":
                raise toml_validation.make_error(source, f"{table_name}.{key}", "0 or more", value)


def _add_actuator(spec: Any, name: str, table: Mapping[str, Any]) -> None:
    """Add an actuator to a MuJoCo model from its checked table: motor, position, velocity or PID.

    Args:
        spec: Editable MuJoCo model (`mujoco.MjSpec`), changed in place.
        name: Name of the actuator.
        table: Table ``[actuators.NAME]`` of the description: kind, joint, gains, gear and ranges.
    """
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
    """Make an actuator a PID servo, with or without a gain kd on the rate of the error.

    With kd, the actuator has two controls: the set point and its rate. MuJoCo then takes kd in
    place of kv.

    Args:
        actuator: actuator of a `mujoco.MjSpec`, changed in place.
        gains: gains kp, ki and kv that are given; kd is added to it as kv.
        kd: gain on the rate of the error; None if it is not given.

    Raises:
        InputError: this version of MuJoCo has no such actuator.
    """
    import mujoco

    if not hasattr(actuator, "set_to_pid"):
        raise InputError(f"kind pid needs MuJoCo 4, found {mujoco.__version__}")
    inputs = int(mujoco.mjtCtrlInput.mjINPUT_POS)
    if kd is not None:
        inputs |= int(mujoco.mjtCtrlInput.mjINPUT_VEL)
        gains["kv"] = float(kd)
    actuator.set_to_pid(**gains, ctrlspec=inputs)
