"""What the actuators of a robot exert, as it was at the beginning of each step."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from sims.base import Array
from sims.robot.model import Robot


class Drives:
    """What the actuators exert at the beginning of each step.

    An integrator of several stages leaves in ``qfrc_actuator`` what they exert at its last one, all
    but a step later; sensors are read at the beginning alone, so there a sensor is added to every
    joint.

    Args:
        robot: whose.
        spec: a mujoco.MjSpec; changed.
        settings: of the options, with the integrator's number.
    """

    def __init__(self, robot: Robot, spec: Any, settings: Mapping[str, float]) -> None:
        import mujoco

        integrator = settings.get("integrator", robot.compiled.opt.integrator)
        self._joints = [joint for joint in robot.joints if joint.single]
        self._own = int(robot.compiled.nsensordata)
        self._added = int(integrator) == int(mujoco.mjtIntegrator.mjINT_RK4)
        if not self._added:
            return
        # A name is what a sensor knows its joint by.
        for number, named in enumerate(spec.joints):
            named.name = named.name or f"simgap {number}"
        names = {named.id: named.name for named in spec.joints}
        for joint in self._joints:
            spec.add_sensor(
                type=mujoco.mjtSensor.mjSENS_JOINTACTFRC,
                objtype=mujoco.mjtObj.mjOBJ_JOINT,
                objname=names[joint.id],
            )

    def fields(self, record: Sequence[str]) -> tuple[str, ...]:
        """The fields of MuJoCo's data that have to be recorded to know those of `record`."""
        more = ("sensordata",) if self._added and "qfrc_actuator" in record else ()
        return tuple(dict.fromkeys((*record, *more)))

    def told(self, recorded: dict[str, Array]) -> dict[str, Array]:
        """The recorded fields as they were at the beginnings of steps."""
        if self._added and "sensordata" in recorded:
            sensed = recorded["sensordata"]
            recorded["sensordata"] = sensed[..., : self._own]
            if "qfrc_actuator" in recorded:
                dofs = [joint.velocity for joint in self._joints]
                recorded["qfrc_actuator"][..., dofs] = sensed[..., self._own :]
        return recorded
