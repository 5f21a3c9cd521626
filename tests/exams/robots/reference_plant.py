"""The true plant: a robot in Pinocchio with its hidden effects.

Equations of motion: M(q) a + n(q, v) = drive - damping v - quadratic |v| v - spring q + bias +
ripple + friction, with M and n from Pinocchio (J. Carpentier et al., The Pinocchio C++ library, SII
2019; R. Featherstone, Rigid Body Dynamics Algorithms, 2008). This module defines the other terms.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property, partial

import numpy as np

GRAVITY = 9.81


@dataclass(frozen=True)
class Binding:
    """Dry friction in a part of a joint's travel: an unmodelled cause."""

    joint: int
    force: float
    centre: float
    half: float

    def limit(self, q):
        """Return the friction limit; it rises over a tenth of the half width."""
        inside = (self.half - abs(q[self.joint] - self.centre)) / (0.1 * self.half)
        return self.force * min(max(inside, 0.0), 1.0)


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
        damping, quadratic, spring, bias: by joint, (N,).
        coulomb, extra, speed: dry friction `coulomb + extra exp(-(v / speed)^2)`, (N,).
        ahead, back: damping of positive and of negative motion, (N,).
        ripples: (joint, sine, cosine, period).
        stops: (joint, stiffness at a depth of 0.01, position, loss); a positive stiffness is a stop
            above the position.
        uneven: (joint, minimum, sine, cosine, period) of dry friction over the joint.
        loads: (joint, motor, external, quadratic) of friction by the load of the drive.
        cold: (joint, dry, viscous, time) of friction that decays.
        memory: (joint, force, distance) of friction with hysteresis (Dahl).
        binding, elastic, heated, cogging: objects of these classes, or None.
    """

    model: object
    data: object
    damping: np.ndarray
    coulomb: np.ndarray
    quadratic: np.ndarray
    spring: np.ndarray
    bias: np.ndarray
    extra: np.ndarray
    speed: np.ndarray
    forward: np.ndarray
    back: np.ndarray
    ripples: list = field(default_factory=list)
    stops: list = field(default_factory=list)
    uneven: list = field(default_factory=list)
    cold: list = field(default_factory=list)
    loads: list = field(default_factory=list)
    memory: list = field(default_factory=list)
    binding: Binding | None = None
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

    # These properties are read in every stage of every step, therefore they are cached.
    @cached_property
    def springs(self):
        return bool(self.spring.any())

    @cached_property
    def drags(self):
        return bool(self.quadratic.any())

    @cached_property
    def lopsided(self):
        return bool((self.forward != self.back).any())

    @cached_property
    def stribeck(self):
        return bool(self.extra.any())

    @property
    def has_friction(self):
        """Mask (N,) of the joints with dry friction."""
        has_friction = (self.coulomb > 0) | (self.extra > 0)
        if self.binding:
            has_friction[self.binding.joint] = True
        if self.heated:
            has_friction[self.heated.joint] = True
        for joint, *_ in self.uneven + self.cold + self.loads:
            has_friction[joint] = True
        return has_friction

    def limit(self, t, q, v, drive=None, heat=0.0):
        """Return the largest dry friction of every joint, (N,).

        Args:
            t: time, s.
            q, v: positions and velocities, (N,).
            drive: actuator forces (N,), needed if there are `loads`.
            heat: heat of `heated`.
        """
        limit = self.coulomb
        if self.stribeck:
            limit = limit + self.extra * np.exp(-((v / self.speed) ** 2))
        if self.binding:
            limit = limit.copy()
            limit[self.binding.joint] += self.binding.limit(q)
        if self.heated:
            limit = limit.copy()
            limit[self.heated.joint] += self.heated.force * heat
        if self.uneven or self.cold or self.loads:
            limit = limit.copy()
        against = self.needed(q, v) if self.loads else None
        for joint, motor, external, quadratic in self.loads:
            one, other = drive[joint], against[joint]
            through = min(abs(one), abs(other)) if one * other > 0 else 0.0
            limit[joint] += abs(motor * one + external * other) + quadratic * through**2
        for joint, least, sine, cosine, period in self.uneven:
            angle = 2 * np.pi * q[joint] / period
            limit[joint] += least + np.hypot(sine, cosine)
            limit[joint] += sine * np.sin(angle) + cosine * np.cos(angle)
        for joint, dry, viscous, time in self.cold:
            limit[joint] += (dry + viscous * abs(v[joint])) * np.exp(-t / time)
        return limit

    def passive(self, q, v):
        """Return joint forces that depend on position and velocity, without dry friction, (N,)."""
        force = self.bias - self.damping * v
        if self.springs:
            force -= self.spring * q
        if self.drags:
            force -= self.quadratic * np.abs(v) * v
        if self.lopsided:
            force -= self.forward * np.maximum(v, 0.0) + self.back * np.minimum(v, 0.0)
        for joint, sine, cosine, period in self.ripples:
            angle = 2 * np.pi * q[joint] / period
            force[joint] += sine * np.sin(angle) + cosine * np.cos(angle)
        for joint, stiffness, place, loss in self.stops:
            side = 1.0 if stiffness > 0 else -1.0
            depth = max(side * (q[joint] - place), 0.0)
            force[joint] -= stiffness * depth**1.5 / 0.1 * max(1 + loss * side * v[joint], 0.0)
        return force

    def accelerations(self, q, v, force):
        """Return accelerations (N,) by the articulated-body algorithm."""
        return self.aba(self.model, self.data, q, v, force)

    def inertia(self, q):
        """Return the mass matrix M(q), (N, N)."""
        import pinocchio

        mass = pinocchio.crba(self.model, self.data, q)
        return np.triu(mass) + np.triu(mass, 1).T

    def needed(self, q, v):
        """Return n(q, v): forces at which all accelerations are zero, (N,)."""
        import pinocchio

        return pinocchio.nonLinearEffects(self.model, self.data, q, v).copy()

    def torque(self, q, v, a):
        """Return the joint forces (N,) for given accelerations (inverse dynamics)."""
        import pinocchio

        return pinocchio.rnea(self.model, self.data, q, v, a).copy()

    def energy(self, q, v):
        """Return the sum of kinetic and potential energy, J."""
        import pinocchio

        kinetic = pinocchio.computeKineticEnergy(self.model, self.data, q, v)
        return kinetic + pinocchio.computePotentialEnergy(self.model, self.data, q)


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

    def needed(self, q, v):
        return self._padded(super().needed(*self._reordered(q, v)))

    def torque(self, q, v, a):
        return self._padded(super().torque(*self._reordered(q, v, a)))

    def energy(self, q, v):
        return super().energy(*self._reordered(q, v))

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


def plant(machine, effects=None, foreign=None):
    """Build the plant of a machine.

    Args:
        machine: `exam_robots.Machine` or `floating_robots.Floater`.
        effects: coefficients by effect@place; effects on signals are ignored.
        foreign: `Binding`, `Heated`, `Cogging` or None.
    """
    model = machine.model()
    damping, coulomb = (np.array(values) for values in zip(*machine.stated(), strict=True))
    count = damping.size
    zeros = np.zeros((6, count))
    kind = partial(FloatingPlant, hinges=len(machine.hinges)) if machine.floats else Plant
    made = kind(model, None, damping, coulomb, *zeros[:4], np.ones(count), *zeros[4:])
    for name, c in (effects or {}).items():
        effect, _, place = name.partition("@")
        if effect in FORCES:
            FORCES[effect](made, machine.index(place), c)
        elif effect in INERTIAS:
            INERTIAS[effect](made, machine.number(place), c)
        elif effect.startswith("gravity."):
            _gravity(model, effect, c)
    made.data = made.model.createData()
    made.binding = foreign if isinstance(foreign, Binding) else None
    made.heated = foreign if isinstance(foreign, Heated) else None
    made.cogging = foreign if isinstance(foreign, Cogging) else None
    return made


def _gravity(model, effect, c):
    linear = model.gravity.linear.copy()
    if effect == "gravity.scale":
        linear *= 1 + c[0]
    else:
        linear += GRAVITY * np.array([c[0], c[1] if len(c) > 1 else 0.0, 0.0])
    model.gravity.linear = linear


def _adds(attribute):
    def change(plant, joint, c):
        getattr(plant, attribute)[joint] += c[0]

    return change


def _stribeck(plant, joint, c):
    plant.coulomb[joint] += c[0]
    plant.extra[joint] += c[1]
    plant.speed[joint] = c[2]


def _direction(plant, joint, c):
    plant.forward[joint] += c[0]
    plant.back[joint] += c[1]


def _ripple(plant, joint, c):
    plant.ripples.append((joint, *c))


def _stop(plant, joint, c):
    plant.stops.append((joint, *c))


def _uneven(plant, joint, c):
    plant.uneven.append((joint, *c))


def _load(plant, joint, c):
    plant.loads.append((joint, c[0], c[0], c[1] if len(c) > 1 else 0.0))


def _by_side(plant, joint, c):
    plant.loads.append((joint, *c, 0.0))


def _cold(plant, joint, c):
    plant.cold.append((joint, *c))


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


FORCES = {
    "joint.flexibility": _flexible,
    "joint.backlash": _play,
    "friction.hysteresis": _memory,
    "friction.coulomb": _adds("coulomb"),
    "friction.load": _load,
    "friction.load_direction": _by_side,
    "friction.load_quadratic": _load,
    "friction.position": _uneven,
    "friction.warming": _cold,
    "friction.direction": _direction,
    "friction.stribeck": _stribeck,
    "drag.linear": _adds("damping"),
    "drag.quadratic": _adds("quadratic"),
    "spring.linear": _adds("spring"),
    "force.bias": _adds("bias"),
    "force.ripple": _ripple,
    "state.limit": _stop,
}


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
