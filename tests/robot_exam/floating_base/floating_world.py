"""Simulate one run of a floating-base robot.

It extends `reference_world` with a pose and its velocity after the coordinates of the hinges.
Positions are q = (hinges, pose), velocities v = (hinges, velocity in the body's axes, 0). A pose
(p, r) of a position and a unit quaternion with the velocity (u, w) follows

    p' = r u r*,    r' = r (0, w) / 2,                                                        (1)

and Pinocchio computes the accelerations of hinges and floating base with its own free-flyer and
spherical joints. MuJoCo is not used.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tests.robot_exam import reference_plant as shapes
from tests.robot_exam.excitation_signals import Drives
from tests.robot_exam.reference_world import FINE, World, _Course


@dataclass
class FloatPlant(shapes.Plant):
    """Forces and inertias of a floating-base robot by coordinate; the last coordinate is padding.

    Attributes:
        hinges: count of coordinates before those of the floating base.
    """

    hinges: int = 0

    def accelerations(self, q, v, force):
        return self._padded(self.aba(self.model, self.data, *self._of(q, v, force)))

    def inertia(self, q):
        import pinocchio

        mass = pinocchio.crba(self.model, self.data, self._pose(q))
        mass = np.triu(mass) + np.triu(mass, 1).T
        order, whole = self._order(), np.eye(self.size)
        whole[:-1, :-1] = mass[np.ix_(order, order)]
        return whole

    def needed(self, q, v):
        import pinocchio

        pose, rate, _ = self._of(q, v, v)
        return self._padded(pinocchio.nonLinearEffects(self.model, self.data, pose, rate))

    def torque(self, q, v, a):
        import pinocchio

        return self._padded(pinocchio.rnea(self.model, self.data, *self._of(q, v, a)))

    def energy(self, q, v):
        import pinocchio

        pose, rate, _ = self._of(q, v, v)
        kinetic = pinocchio.computeKineticEnergy(self.model, self.data, pose, rate)
        return kinetic + pinocchio.computePotentialEnergy(self.model, self.data, pose)

    def _pose(self, q):
        """Return positions in Pinocchio's order, floating base first."""
        return np.concatenate([q[self.hinges :], q[: self.hinges]])

    def _of(self, q, v, other):
        n = self.hinges
        rates = [np.concatenate([part[n:-1], part[:n]]) for part in (v, other)]
        return self._pose(q), *rates

    def _order(self):
        count = self.model.nv
        return [*range(count - self.hinges, count), *range(count - self.hinges)]

    def _padded(self, values):
        """Convert values from Pinocchio's order and append the padding."""
        return np.append(np.asarray(values)[self._order()], 0.0)


def plant(machine, effects=None, foreign=None):
    """Build the plant of a machine; see `tests.robot_exam.reference_plant.plant` for arguments."""
    model = machine.model()
    damping, coulomb = (np.array(values) for values in zip(*machine.stated(), strict=True))
    count = damping.size
    made = FloatPlant(
        model, None, damping, coulomb, *np.zeros((4, count)), np.ones(count), *np.zeros((2, count)),
        hinges=len(machine.hinges),
    )  # fmt: skip
    for name, c in (effects or {}).items():
        effect, _, place = name.partition("@")
        if effect in shapes.FORCES:
            shapes.FORCES[effect](made, machine.index(place), c)
        elif effect == "inertia.armature":
            armature = np.array(model.armature)
            armature[model.joints[machine.number(place)].idx_v] += c[0]
            model.armature = armature
        elif effect in shapes.INERTIAS:
            shapes.INERTIAS[effect](made, machine.number(place) - 1, c)
        elif effect.startswith("gravity."):
            shapes._gravity(model, effect, c)
    made.data = made.model.createData()
    made.binding = foreign if isinstance(foreign, shapes.Binding) else None
    made.heated = foreign if isinstance(foreign, shapes.Heated) else None
    made.cogging = foreign if isinstance(foreign, shapes.Cogging) else None
    return made


class FloatWorld(World):
    """A floating-base robot with its hidden effects; see `World` for arguments."""

    def __init__(self, machine, effects=None, foreign=None, step=FINE):
        self.machine, self.effects, self.step = machine, dict(effects or {}), step
        self.plant = plant(machine, self.effects, foreign)
        self.drives = Drives.of(machine, self.effects)
        self.rubs = self.plant.rubs
        self.dry = bool(self.rubs.any())

    def move(self, run, instants):
        """Return the motion at increasing times, (K,)."""
        return _FloatCourse(self, run).through(np.asarray(instants, dtype=float))


class _FloatCourse(_Course):
    """State of a run during its simulation, with equation (1) for the floating base."""

    def _rate(self, t, state):
        rate = super()._rate(t, state)
        n, first = self.count, self.plant.hinges
        pose, v = state[first:n], state[n + first : 2 * n - 1]
        vector, real, w = pose[-4:-1], pose[-1], v[-3:]
        if pose.size > 4:
            turned = np.cross(vector, v[:3])
            rate[first : first + 3] = v[:3] + 2 * (real * turned + np.cross(vector, turned))
        rate[n - 4 : n - 1] = 0.5 * (real * w + np.cross(vector, w))
        rate[n - 1] = -0.5 * vector @ w
        return rate

    def _moved(self, now, h):
        state = super()._moved(now, h)
        state[self.count - 4 : self.count] /= np.linalg.norm(state[self.count - 4 : self.count])
        return state
