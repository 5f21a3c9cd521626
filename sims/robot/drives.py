"""What a sensor of the drives' forces shows, where MuJoCo does not know it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sims.base import Array
from sims.robot.acting import lanes_with, part_of
from sims.robot.activation_filters import activation_filters
from sims.robot.coupled import before as joint_before
from sims.robot.forces import exerted, is_in_drive, moment_of
from sims.robot.lanes import Bench
from sims.robot.model import Actuator, Robot
from sims.robot.native import COUPLING, arm_of
from sims.robot.switched_off import working_servos
from sims.robot.system import RobotSystem
from sims.robot.work import Given
from sims.system import Acting


@dataclass(frozen=True)
class Shown:
    """Readings of what drives exert, of the lanes of a bench.

    Attributes:
        robot: whose.
        system: of it.
        bench: the lanes.
        given: what they were given.
        step: seconds.
    """

    robot: Robot
    system: RobotSystem
    bench: Bench
    given: Given
    step: float

    def as_given(self, readings: Array) -> None:
        """Let what actuators exert (n, S, k) be that of the command when each step begins, in place
        of its mean over the step.
        """
        given, bench = self.given, self.bench
        n = len(readings)
        for actuator in self.robot.actuators:
            apart = given.instant[:, :, actuator.control] - given.controls[:, :, actuator.control]
            apart = np.where(given.off[:, :, actuator.id], 0.0, apart)
            if actuator.joint not in bench.drives or not apart.any():
                continue
            column = readings[:, :, bench.drives[actuator.joint]]
            before = column.copy()
            column += apart * self._by_control(actuator)[:n, None]
            np.clip(column, *self._limits(actuator), out=column)
            if actuator.joint in bench.robot.coupled:
                first = joint_before(self.robot, actuator.joint)
                assert first is not None
                arms: Array = bench.fields[COUPLING][:n, arm_of(bench.robot, actuator.joint)]
                readings[:, :, bench.drives[first.name]] += arms[:, None] * (column - before)

    def as_exerted(self, readings: Array, x: Array, v: Array, acting: Acting) -> None:
        """Let it have what effects in the drives add, a dead zone of a servo or a supply that sags,
        which act as forces from outside; at positions and velocities (n, S + 1, D).
        """
        lanes = np.flatnonzero(lanes_with(acting, len(x), is_in_drive))
        if not lanes.size:
            return
        bench, given, steps = self.bench, self.given, readings.shape[1]
        columns = [bench.drives[name.removeprefix("q.")] for name in self.system.coordinates]
        shown = readings[lanes][:, :, columns]

        def flat(values: Array) -> Array:
            """All instants of these lanes below each other."""
            return values[lanes, :steps].reshape(lanes.size * steps, -1)

        inputs = {name: flat(u) for name, u in given.felt.items()}
        for one in self.robot.actuators:
            # What is behind a filter does not change within a step.
            if not self._is_filtered(one):
                inputs[f"u.{one.name}"] = flat(given.instant[:, :, one.control])
        t = np.tile(self.step * np.arange(float(steps)), lanes.size)[:, None]
        drive = shown.reshape(lanes.size * steps, -1)
        carried = np.stack([drive, np.zeros_like(drive)])
        stiffness = np.repeat(bench.stiffness(bench.places)[lanes], steps, axis=0)
        if given.off.any():
            on = working_servos(bench.robot, bench.places.velocities, given.off[lanes, :steps])
            stiffness = stiffness * on.reshape(stiffness.shape)
        moment = moment_of(self.system, t, flat(x), flat(v), inputs, carried, stiffness)
        own = part_of(tuple((e, c) for e, c in acting if is_in_drive(e)), lanes)
        every = tuple((e, np.repeat(c, steps, axis=1)) for e, c in own)
        shown += exerted(every, moment).reshape(shown.shape)
        readings[lanes[:, None, None], np.arange(steps)[:, None], columns] = shown

    def _by_control(self, actuator: Actuator) -> Array:
        """(LANES,) what one unit of an actuator's control exerts on its joint at once."""
        gear = float(self.robot.compiled.actuator_gear[actuator.id, 0])
        gain: Array = self.bench.fields["actuator_gainprm"][:, actuator.id, 0]
        direct = actuator.kind in ("motor", "position", "velocity")
        direct = direct and not self._is_filtered(actuator)
        return gear * gain if direct else np.zeros_like(gain)

    def _is_filtered(self, actuator: Actuator) -> bool:
        """Whether a filter stands before it, so that a control has no effect at once."""
        return any(one.actuator == actuator for one in activation_filters(self.robot))

    def _limits(self, actuator: Actuator) -> tuple[float, float]:
        """Of what it exerts on its joint, as far as the file states them."""
        gear = abs(float(self.robot.compiled.actuator_gear[actuator.id, 0]))
        low, high = actuator.force or (-np.inf, np.inf)
        assert actuator.joint is not None
        effort = self.robot.joint(actuator.joint).effort or np.inf
        return max(gear * low, -effort), min(gear * high, effort)
