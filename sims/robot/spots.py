"""The places of a robot where something may be missing: its joints, actuators, bodies and channels,
with what the file states of each.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from sims.robot.coupled import places as coupled_places
from sims.robot.mass_offset import observable_axes, reach
from sims.robot.model import Robot

WORDS = {
    "armature": "inertia.armature",
    "damping": "drag.linear",
    "frictionloss": "friction.coulomb",
    "gear": "input.gain",
    "gravity": "gravity.scale",
    "inertia": "inertia.scale",
    "ipos": "mass.offset",
    "kp": "actuator.stiffness",
    "kv": "actuator.damping",
    "mass": "mass.scale",
    "stiffness": "spring.linear",
}
"""MuJoCo's words for what a file states, and the effects that change it."""


class Spot(NamedTuple):
    """A place at which an effect may act.

    Attributes:
        name: of the joint, actuator, body or channel.
        kind: of the coordinate whose units count: hinge or slide.
        coordinate: its number; None where it has none.
        signal: the input or channel; empty for a joint or body.
        unit: of the signal.
        size: a typical force along the coordinate, N or N m.
        inertia: about it, kg or kg m^2.
        stated: what the file states, by name of the effect that changes it.
        words: how a sentence calls it.
        servo: whether it is an actuator that follows a set point of its position.
        last: whether it is a joint, the last one of its body.
        coupled: whether it is a joint whose drive may be coupled to the joint before.
        offsets: of a body, by axis of its frame (``x``, ``y``, ``z``), the lowest and the highest
            offset in metres that leaves its centre of mass within the link; both zero along an
            axis where an offset cannot be observed.
    """

    name: str
    kind: str
    coordinate: int | None
    signal: str
    unit: str
    size: float
    inertia: float
    stated: Mapping[str, float]
    words: str
    servo: bool = False
    last: bool = False
    coupled: bool = False
    offsets: Mapping[str, tuple[float, float]] = MappingProxyType({})


def spots(robot: Robot, channels: Sequence[tuple[str, str]]) -> dict[str, list[Spot]]:
    """The places of a robot by kind: joint, actuator, body, channel.

    Args:
        robot: whose.
        channels: names and units of those that it can show.
    """
    from sims.robot.scales import coefficient_scales

    sizes = coefficient_scales(robot)
    found: dict[str, list[Spot]] = {"joint": [], "actuator": [], "body": [], "channel": []}
    numbers: dict[str, int] = {}
    may_be_coupled = coupled_places(robot)
    bodies = robot.compiled.jnt_bodyid
    lasts = {int(body): i for i, body in enumerate(bodies)}
    for number, joint in enumerate(j for j in robot.joints if j.single):
        numbers[joint.name] = number
        found["joint"].append(
            Spot(
                joint.name,
                joint.kind,
                number,
                "",
                joint.unit,
                sizes.force[number],
                sizes.inertia[number],
                _stated(robot, joint.velocity, joint.id),
                f"joint {joint.name}",
                last=lasts[int(bodies[joint.id])] == joint.id,
                coupled=joint.name in may_be_coupled,
            )
        )
    for actuator in robot.actuators:
        on = next((s for s in found["joint"] if s.name == actuator.joint), None)
        if on is None:
            continue
        unit = _control_unit(actuator.kind, on)
        found["actuator"].append(
            on._replace(
                name=actuator.name,
                signal=f"u.{actuator.name}",
                unit=unit,
                stated=_gains(robot, actuator.id),
                words=f"actuator {actuator.name}",
                servo=actuator.kind == "position",
            )
        )
    for body in robot.bodies:
        nothing: Mapping[str, float] = {}
        words = f"body {body.name}"
        box = reach(robot, body.name)
        axes = observable_axes(robot, body.name)
        ends = np.where(np.isin(range(3), axes)[:, None], box, 0.0).tolist()
        offsets = {axis: (low, high) for axis, (low, high) in zip("xyz", ends, strict=True)}
        spot = Spot(body.name, "hinge", None, "", "kg", 1.0, 1.0, nothing, words, offsets=offsets)
        found["body"].append(spot)
    for name, unit in channels:
        _, _, of = name.partition(".")
        coordinate = numbers.get(of) if name.startswith(("q.", "qd.", "tau.")) else None
        on = found["joint"][coordinate] if coordinate is not None else None
        kind, size = (on.kind, on.size) if on else ("hinge", 1.0)
        words = f"channel {name}"
        found["channel"].append(Spot(name, kind, coordinate, name, unit, size, 1.0, {}, words))
    return found


def _control_unit(kind: str, on: Spot) -> str:
    """The unit of an actuator's control."""
    length = "rad" if on.kind == "hinge" else "m"
    force = "N*m" if on.kind == "hinge" else "N"
    return {"position": length, "velocity": f"{length}/s", "motor": force}.get(kind, "1")


def _gains(robot: Robot, actuator: int) -> dict[str, float]:
    """What a servo's file states of its gains; zero where it is no servo."""
    bias = robot.compiled.actuator_biasprm[actuator]
    return {"actuator.stiffness": float(bias[1]), "actuator.damping": float(bias[2])}


def _stated(robot: Robot, dof: int, joint: int) -> dict[str, float]:
    model = robot.compiled
    return {
        "drag.linear": float(model.dof_damping[dof]),
        "friction.coulomb": float(model.dof_frictionloss[dof]),
        "inertia.armature": float(model.dof_armature[dof]),
        "spring.linear": float(model.jnt_stiffness[joint]),
        "drag.quadratic": float(np.ravel(model.dof_dampingpoly[dof])[0]),
    }
