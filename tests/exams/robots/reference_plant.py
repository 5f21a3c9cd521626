"""The true plant: a robot in Pinocchio with its hidden effects.

Equations of motion: M(q) a + n(q, v) = drive - damping v + forces of effects + dry friction, with M
and n from Pinocchio (J. Carpentier et al., The Pinocchio C++ library, SII 2019; R. Featherstone,
Rigid Body Dynamics Algorithms, 2008). The laws of forces and friction at a joint are those of the
reference simulation of pendulum and slider; this module adds elastic joints, effects on inertias,
and unmodelled causes of robots.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property, partial

import numpy as np

from bench.diagnosis_benchmark.case_generation.joint_reference import (
    DRY_FRICTION_EFFECTS,
    FORCE_EFFECTS,
)

GRAVITY = 9.81


class JointLoad:
    """Drive force and load of a joint, on which some laws of friction depend."""

    driving = against = 0.0

    def drive(self, t):
        """Return the force of the actuator."""
        return self.driving

    def weight(self, q):
        """Return the force of gravity and motion that acts against the actuator."""
        return -self.against


@dataclass(frozen=True)
class Heated:
    """Dry friction of a joint that grows with the work of another joint's drive.

    This is an unmodelled cause. The heat h follows h' = |power| / `power` - h / `time`.
    """

    joint: int
    other: int
    force: float
    power: float
    time: float


@dataclass(frozen=True)
class Cogging:
    """A ripple along a joint that lags by half a tooth in both directions: an unmodelled cause."""

    joint: int
    force: float
    tooth: float

    def caught(self, tooth, q):
        """Return the position of the teeth, which follow the joint with backlash of one tooth."""
        return min(max(tooth, q[self.joint] - 0.5 * self.tooth), q[self.joint] + 0.5 * self.tooth)

    def push(self, tooth, q):
        return self.force * np.sin(2 * np.pi * self.caught(tooth, q) / self.tooth)


@dataclass(frozen=True)
class Elastic:
    """A joint with a spring or backlash between motor and link. The encoder is on the motor."""

    joint: int
    rotor: float
    stiffness: float
    damping: float
    gap: float = 0.0

    @property
    def fastest(self):
        """Bound on the fastest rate of the rotor on its spring and damper, rad/s."""
        return np.sqrt(self.stiffness / self.rotor) + self.damping / self.rotor

    def through(self, deflection, speed):
        """Return the force from the motor to the link; flanks of a backlash only push."""
        beyond = deflection - min(max(deflection, -0.5 * self.gap), 0.5 * self.gap)
        force = self.stiffness * beyond + self.damping * speed
        if not self.gap:
            return force
        return max(force, 0.0) if beyond > 0 else min(force, 0.0) if beyond < 0 else 0.0

    def rests(self, load):
        """Return how far the link is ahead of the fixed motor under the force `load`."""
        stretch = load / self.stiffness
        return stretch + 0.5 * self.gap * np.sign(load) * (abs(load) > 1e-9)


@dataclass
class Plant:
    """Forces and inertias of a machine.

    Attributes:
        model, data: of Pinocchio.
        damping, coulomb: damping and dry friction that the file states, by joint, (N,).
        forces: (joint, law) of forces; a law is a function of time, position and velocity.
        limits: (joint, law) of dry friction.
        loads: by joint, the `JointLoad` of its laws of friction by the load of the drive.
        memory: (joint, force, distance) of friction with hysteresis (Dahl).
        elastic, heated, cogging: objects of these classes, or None.
    """

    model: object
    damping: np.ndarray
    coulomb: np.ndarray
    data: object = None
    forces: list = field(default_factory=list)
    limits: list = field(default_factory=list)
    loads: dict = field(default_factory=dict)
    memory: list = field(default_factory=list)
    elastic: Elastic | None = None
    heated: Heated | None = None
    cogging: Cogging | None = None

    @cached_property
    def aba(self):
        import pinocchio

        return pinocchio.aba

    @property
    def size(self):
        return self.damping.size

    @property
    def has_friction(self):
        """Mask (N,) of the joints with dry friction."""
        has_friction = self.coulomb > 0
        has_friction[[joint for joint, _ in self.limits]] = True
        if self.heated:
            has_friction[self.heated.joint] = True
        return has_friction

    def limit(self, t, q, v, drive=None, heat=0.0):
        """Return the largest dry friction of every joint, (N,).

        Args:
            t: time, s.
            q, v: positions and velocities, (N,).
            drive: actuator forces (N,), needed if there are `loads`.
            heat: heat of `heated`.
        """
        limit = self.coulomb.copy()
        if self.loads:
            against = self.needed(q, v)
            for joint, load in self.loads.items():
                load.driving, load.against = drive[joint], against[joint]
        for joint, law in self.limits:
            limit[joint] += law(t, q[joint], v[joint])
        if self.heated:
            limit[self.heated.joint] += self.heated.force * heat
        return np.maximum(limit, 0.0)

    def passive(self, t, q, v):
        """Return joint forces that depend on position and velocity, without dry friction, (N,)."""
        force = -self.damping * v
        for joint, law in self.forces:
            force[joint] += law(t, q[joint], v[joint])
        return force

    def accelerations(self, q, v, force):
        """Return accelerations (N,) by the articulated-body algorithm."""
        return self.aba(self.model, self.data, q, v, force)

    def inertia(self, q):
        """Return the mass matrix M(q), (N, N)."""
        import pinocchio

        mass = pinocchio.crba(self.model, self.data, q)
        return np.triu(mass) + np.triu(mass, 1).T

    def moved_inertia(self, q):
        """Return the inertia that each joint moves while the others are locked, (N,)."""
        return np.diag(self.inertia(np.asarray(q)))

    def needed(self, q, v):
        """Return n(q, v): forces at which all accelerations are zero, (N,)."""
        import pinocchio

        return pinocchio.nonLinearEffects(self.model, self.data, q, v).copy()

    def torque(self, q, v, a):
        """Return the joint forces (N,) for given accelerations (inverse dynamics)."""
        import pinocchio

        return pinocchio.rnea(self.model, self.data, q, v, a).copy()


@dataclass
class FloatingPlant(Plant):
    """Forces and inertias of a floating-base robot by coordinate; the last coordinate is padding.

    Coordinates are those of the hinges, followed by those of the floating base; Pinocchio has the
    floating base first.
    """

    hinges: int = 0

    def accelerations(self, q, v, force):
        return self._padded(super().accelerations(*self._reordered(q, v, force)))

    def inertia(self, q):
        order, whole = self._order(), np.eye(self.size)
        whole[:-1, :-1] = super().inertia(self._pose(q))[np.ix_(order, order)]
        return whole

    def moved_inertia(self, q):
        """Return the inertia that each joint moves while the others are free, (N,)."""
        return 1.0 / np.diag(np.linalg.inv(self.inertia(q)))

    def needed(self, q, v):
        return self._padded(super().needed(*self._reordered(q, v)))

    def torque(self, q, v, a):
        return self._padded(super().torque(*self._reordered(q, v, a)))

    def _pose(self, q):
        """Return positions in Pinocchio's order."""
        return np.concatenate([q[self.hinges :], q[: self.hinges]])

    def _reordered(self, q, *rates):
        """Return positions and rates in Pinocchio's order, without padding."""
        n = self.hinges
        return self._pose(q), *(np.concatenate([rate[n:-1], rate[:n]]) for rate in rates)

    def _order(self):
        count = self.model.nv
        return [*range(count - self.hinges, count), *range(count - self.hinges)]

    def _padded(self, values):
        """Convert values from Pinocchio's order and append the padding."""
        return np.append(np.asarray(values)[self._order()], 0.0)


def plant(machine, effects=None):
    """Build the plant of a machine.

    Args:
        machine: `exam_robots.Machine` or `floating_robots.Floater`.
        effects: coefficients by effect@place, or numbers of an unmodelled cause by its name;
            effects on signals and supplies are ignored.
    """
    model = machine.model()
    damping, coulomb = (np.array(values) for values in zip(*machine.stated(), strict=True))
    kind = partial(FloatingPlant, hinges=len(machine.hinges)) if machine.floats else Plant
    made = kind(model, damping, coulomb)
    for name, c in (effects or {}).items():
        effect, _, place = name.partition("@")
        if effect.startswith("gravity."):
            _gravity(model, effect, c)
        elif effect in FORCE_EFFECTS and not effect.startswith("supply."):
            made.forces.append((machine.index(place), FORCE_EFFECTS[effect](None, c)))
        elif effect in DRY_FRICTION_EFFECTS:
            joint = machine.index(place)
            load = made.loads.setdefault(joint, JointLoad()) if ".load" in effect else None
            made.limits.append((joint, DRY_FRICTION_EFFECTS[effect](load, c)))
        elif effect in CHANGES:
            CHANGES[effect](made, machine.index(place), c)
        elif effect in INERTIAS:
            INERTIAS[effect](made, machine.number(place), c)
        elif effect in UNMODELLED_CAUSES:
            UNMODELLED_CAUSES[effect](made, *c)
    made.data = made.model.createData()
    return made


def _gravity(model, effect, c):
    linear = model.gravity.linear.copy()
    if effect == "gravity.scale":
        linear *= 1 + c[0]
    else:
        linear += GRAVITY * np.array([c[0], c[1] if len(c) > 1 else 0.0, 0.0])
    model.gravity.linear = linear


FLANKS = 2000.0  # Natural frequency of the load on a flank, rad/s; critically damped.


def _inertia(plant, joint):
    """Return the inertia at a joint with all joints at zero, as the file specifies it."""
    import pinocchio

    model = plant.model
    mass = pinocchio.crba(model, model.createData(), np.zeros(model.nq))
    return float(mass[joint, joint])


def stiff(machine, place, rotor):
    """Return the effect of the drive inertia alone, a fraction of the joint's inertia.

    This inertia exists even if the joint is rigid.
    """
    inertia = _inertia(plant(machine), machine.index(place))
    return {f"inertia.armature@{place}": (rotor * inertia,)}


def _flexible(plant, joint, c):
    compliance, ratio, rotor = c
    moved = _inertia(plant, joint)
    damping = 2 * ratio * np.sqrt(moved / compliance)
    plant.elastic = Elastic(joint, rotor * moved, 1 / compliance, damping)


def _play(plant, joint, c):
    gap, rotor = c
    moved = _inertia(plant, joint)
    both = moved * rotor / (1 + rotor)
    plant.elastic = Elastic(joint, rotor * moved, both * FLANKS**2, 2 * both * FLANKS, gap)


def _memory(plant, joint, c):
    plant.memory.append((joint, *c))


CHANGES = {
    "joint.flexibility": _flexible,
    "joint.backlash": _play,
    "friction.hysteresis": _memory,
}
"""Effects with states of their own."""


def _heat(plant, joint, other, *c):
    plant.heated = Heated(int(joint), int(other), *c)


def _cog(plant, joint, *c):
    plant.cogging = Cogging(int(joint), *c)


def _bind(plant, joint, *c):
    plant.limits.append((int(joint), DRY_FRICTION_EFFECTS["patch"](None, c)))


UNMODELLED_CAUSES = {"heated": _heat, "cogging": _cog, "binding": _bind}
"""Causes that the library does not contain: friction that the work of another joint heats, a ripple
with hysteresis, and dry friction in a part of a joint's travel.
"""


def _mass(plant, number, c):
    _reshape(plant.model, number, mass=1 + c[0], tensor=1 + c[0])


def _offset(plant, number, c):
    _reshape(plant.model, number, shift=np.array(c))


def _tensor(plant, number, c):
    _reshape(plant.model, number, tensor=1 + c[0])


def _armature(plant, number, c):
    armature = np.array(plant.model.armature)
    armature[plant.model.joints[number].idx_v] += c[0]
    plant.model.armature = armature


def _reshape(model, number, mass=1.0, tensor=1.0, shift=0.0):
    """Change the inertia of the body that a joint moves, with everything fixed to it."""
    import pinocchio

    body = model.inertias[number]
    model.inertias[number] = pinocchio.Inertia(
        body.mass * mass, body.lever + shift, body.inertia * tensor
    )


INERTIAS = {
    "mass.scale": _mass,
    "mass.offset": _offset,
    "inertia.scale": _tensor,
    "inertia.armature": _armature,
}
