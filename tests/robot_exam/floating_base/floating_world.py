"""One run of a robot that floats: the world of `reference_world`, with a pose and its velocity
behind the hinges' coordinates.

Positions of all coordinates are q = (hinges, pose), speeds v = (hinges, velocity in the body's
axes, 0); with a pose (p, r) of a place and a unit quaternion, a velocity (u, w) has

    p' = r u r*,    r' = r (0, w) / 2,                                                        (1)

and Pinocchio says what a hinge and what floats is accelerated by (a free flyer and a spherical
joint of its own; nothing here is MuJoCo's).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tests.robot_exam import reference_plant as shapes
from tests.robot_exam.excitation_signals import Drives
from tests.robot_exam.reference_world import FINE, World, _Course


@dataclass
class FloatPlant(shapes.Plant):
    """Forces and inertias of a robot that floats, by coordinate; the last one is nobody's.

    Attributes:
        hinges: how many coordinates come before those of what floats.
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
        """As Pinocchio has it: what floats comes first."""
        return np.concatenate([q[self.hinges :], q[: self.hinges]])

    def _of(self, q, v, other):
        n = self.hinges
        rates = [np.concatenate([part[n:-1], part[:n]]) for part in (v, other)]
        return self._pose(q), *rates

    def _order(self):
        count = self.model.nv
        return [*range(count - self.hinges, count), *range(count - self.hinges)]

    def _padded(self, values):
        """From Pinocchio's order."""
        return np.append(np.asarray(values)[self._order()], 0.0)


def plant(machine, effects=None, foreign=None):
    """A machine's plant; arguments as of `tests.robot_exam.reference_plant.plant`."""
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
    """A machine that floats with what is hidden in it; arguments as of `World`."""

    def __init__(self, machine, effects=None, foreign=None, step=FINE):
        self.machine, self.effects, self.step = machine, dict(effects or {}), step
        self.plant = plant(machine, self.effects, foreign)
        self.drives = Drives.of(machine, self.effects)
        self.rubs = self.plant.rubs
        self.dry = bool(self.rubs.any())

    def move(self, run, instants):
        """The motion at instants that increase, (K,)."""
        return _FloatCourse(self, run).through(np.asarray(instants, dtype=float))


class _FloatCourse(_Course):
    """A run on its way, as (1) has it for what floats."""

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
