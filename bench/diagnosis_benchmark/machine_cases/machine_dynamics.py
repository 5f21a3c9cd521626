"""Equations of motion of a servo with a pendulum, and of an arm of two links, for batches of runs.

Every law is written here in plain numbers. Nothing is shared with the simulators and the effect
library that the cases test. Arrays are (L, N) for L batch elements and N joints; parameters of a
machine are scalars, or (L,) if they differ between batch elements.

Servo, with the angle q from hanging down and gravity g (R. Krishnan, Electric Motor Drives, 2001,
chapter 2, for the motor):

    (J + m l^2) q'' = k (d V - k q') / R - m g l sin q,   d = clip(p e (goal - q), -1, 1)     (1)

Arm in a vertical plane, with q2 measured from the line of the first link (M. W. Spong, S.
Hutchinson, M. Vidyasagar, Robot Modeling and Control, 2006, section 7.4), and with the inertias A
of the rotors:

    M11 = I1 + m1 c1^2 + I2 + m2 (l^2 + c2^2 + 2 l c2 cos q2) + A1                             (2)
    M12 = I2 + m2 (c2^2 + l c2 cos q2),   M22 = I2 + m2 c2^2 + A2                              (3)
    M q'' = u - damping q' - g(q) + m2 l c2 sin q2 (2 q1' q2' + q2'^2, -q1'^2)                 (4)
    g1 = (m1 c1 + m2 l) g sin q1 + m2 c2 g sin(q1 + q2),   g2 = m2 c2 g sin(q1 + q2)           (5)
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from sims.core.simulator import Array

MachineParameters = Mapping[str, Any]
"""Parameters of a machine by name; each is a scalar or (L,)."""
Effects = Mapping[str, Sequence[float]]
"""Coefficients by ``effect@place``, or by ``effect`` if a machine has only one place for it."""
ForceLaw = Callable[[float, Array, Array, Array], Array]
"""Function from (t, q, v, u) to generalised forces (L, N)."""
GRAVITY = 9.81


class MachineDynamics(ABC):
    """Machine with hidden causes.

    Attributes:
        joints: names of the joints; one empty name if the machine has one place per effect.
        channels: sensor channel of each joint.
        motors: input of each joint.
        acts: additional force laws.
        dry: Coulomb friction, (N,).
        extra: additional Stribeck friction at rest, (N,).
        speed: Stribeck velocity, (N,).
        has_dry_friction: whether each joint has dry friction, (N,).
    """

    joints: ClassVar[tuple[str, ...]]
    bodies: ClassVar[tuple[str, ...]] = ()
    channels: ClassVar[tuple[str, ...]]
    motors: ClassVar[tuple[str, ...]]

    def __init__(self, numbers: MachineParameters, effects: Effects) -> None:
        """Store the parameters and add the hidden causes.

        Further attributes are `added`, additional rotor inertia (N,); `patch`, (joint, friction
        limit, centre, half width) of dry friction in a region; and `dull`, the dead band of a servo
        in rad. Effects on commands and sensors stay in `effects`; `machine_simulation` applies
        them.

        Shapes: N joints.

        Args:
            numbers: parameters, see `MachineParameters`.
            effects: hidden causes, with those that the library does not contain.
        """
        self.numbers = {name: np.asarray(value, dtype=float) for name, value in numbers.items()}
        self.effects = effects
        count = len(self.joints)
        self.dry, self.extra, self.speed = np.zeros(count), np.zeros(count), np.ones(count)
        self.added = np.zeros(count)
        self.patch: tuple[int, float, float, float] | None = None
        self.dull = 0.0
        self.acts: list[ForceLaw] = []
        for name, coefficients in effects.items():
            effect, _, place = name.partition("@")
            self._add_effect(effect, place, list(coefficients))

    @property
    def has_dry_friction(self) -> NDArray[np.bool_]:
        """For each joint, true if it has dry friction anywhere, (N,)."""
        has_friction = (self.dry > 0) | (self.extra > 0)
        if self.patch:
            joint, *_ = self.patch
            has_friction[joint] = True
        return has_friction

    def compute_friction_limit(self, q: Array, v: Array) -> Array:
        """Compute the dry friction limit: friction of a moving joint, maximum of a resting one.

        It is the sum of Coulomb friction, the Stribeck part that vanishes at speed, and a patch of
        friction in a region of one joint.

        Shapes: L batch elements, N joints.

        Args:
            q: positions, (L, N).
            v: velocities, (L, N).

        Returns:
            Friction limits, (L, N).
        """
        limit = np.tile(self.dry, (len(q), 1))  # Coulomb friction, (L, N)
        if self.extra.any():  # Stribeck friction
            limit += self.extra * np.exp(-((v / self.speed) ** 2))
        if self.patch:
            joint, max_friction, centre, half_width = self.patch
            # Friction rises linearly over a tenth of the half width at each border.
            patch_weight = (half_width - np.abs(q[:, joint] - centre)) / (0.1 * half_width)
            limit[:, joint] += max_friction * np.clip(patch_weight, 0.0, 1.0)
        return limit

    def compute_force(self, t: float, q: Array, v: Array, u: Array) -> Array:
        """Compute the force of drives, gravity and effects, without dry friction.

        Shapes: L batch elements, N joints.

        Args:
            t: time.
            q: positions, (L, N).
            v: velocities, (L, N).
            u: applied inputs, (L, N).

        Returns:
            Forces, (L, N).
        """
        total = self.compute_own_force(q, v, u)
        # The force laws of the hidden effects.
        for compute_effect_force in self.acts:
            total = total + compute_effect_force(t, q, v, u)
        return total

    @abstractmethod
    def compute_mass_matrix(self, q: Array) -> Array:
        """Compute the mass matrices, (L, N, N)."""

    @abstractmethod
    def compute_own_force(self, q: Array, v: Array, u: Array) -> Array:
        """Compute all other terms of the equations of motion of the machine without effects.

        Shapes: L batch elements, N joints.

        Args:
            q: positions, (L, N).
            v: velocities, (L, N).
            u: applied inputs, (L, N).

        Returns:
            Forces, (L, N).
        """

    @abstractmethod
    def compute_base_acceleration_force(self, q: Array) -> Array:
        """Compute the generalised forces (L, N) of a unit acceleration along x.

        Multiplied by a horizontal part of gravity, they give the effect of a tilted machine.

        Args:
            q: positions, (L, N).
        """

    @abstractmethod
    def compute_gravity_force(self, q: Array) -> Array:
        """Compute the generalised forces (L, N) of gravity."""

    def _add_effect(self, effect: str, place: str, c: list[float]) -> None:
        """Add a hidden cause to the equations of motion.

        A force law or a tilt becomes a function in `acts`. Other effects change an attribute:
        Coulomb friction (`dry`), Stribeck friction at rest and its speed (`extra`, `speed`), the
        inertia of a rotor (`added`), the dead band of a servo (`dull`), or a mass. Effects on
        commands (``input.``) and sensors (``sensor.``) are ignored here; `machine_simulation`
        applies them.

        Args:
            effect: name of the effect or unmodelled cause; a patch is dry friction in a region of a
                joint angle.
            place: joint or body on which it acts; empty if the machine has only one place.
            c: coefficients; of a patch its friction limit, centre and half width.
        """
        if effect in JOINT_FORCE_LAWS:
            joint, law = self.joints.index(place), JOINT_FORCE_LAWS[effect]

            def act(t: float, q: Array, v: Array, u: Array) -> Array:
                """Return the generalised forces (L, N) of the effect on its joint."""
                force = np.zeros_like(q)
                force[:, joint] = law(c, t, q[:, joint], v[:, joint])
                return force

            self.acts.append(act)
        elif effect == "friction.coulomb":
            self.dry[self.joints.index(place)] = c[0]
        elif effect == "friction.stribeck":
            joint = self.joints.index(place)
            self.dry[joint], self.extra[joint], self.speed[joint] = c
        elif effect == "patch":
            max_friction, centre, half_width = c
            self.patch = self.joints.index(place), max_friction, centre, half_width
        elif effect == "inertia.armature":
            self.added[self.joints.index(place)] = c[0]
        elif effect == "gravity.tilt":
            self.acts.append(
                lambda t, q, v, u: c[0] * GRAVITY * self.compute_base_acceleration_force(q)
            )
        elif effect == "gravity.scale":
            self.acts.append(lambda t, q, v, u: c[0] * self.compute_gravity_force(q))
        elif effect == "servo.deadband":
            self.dull = c[0]
        elif effect == "mass.scale":
            self._scale_mass(self.bodies.index(place), 1.0 + c[0])

    def _scale_mass(self, body: int, factor: float) -> None:
        """Multiply the mass and inertia of a body by a factor.

        Args:
            body: index of the body.
            factor: the factor.
        """
        # The names of the parameters count bodies from 1.
        for name in (f"mass{body + 1}", f"inertia{body + 1}"):
            self.numbers[name] = factor * self.numbers[name]


JOINT_FORCE_LAWS: dict[str, Callable[[list[float], float, Array, Array], Array]] = {
    "drag.linear": lambda c, t, q, v: -c[0] * v,
    "drag.quadratic": lambda c, t, q, v: -c[0] * np.abs(v) * v,
    "spring.linear": lambda c, t, q, v: -c[0] * q,
    "force.bias": lambda c, t, q, v: c[0] + 0.0 * q,
    "force.ripple": lambda c, t, q, v: (
        c[0] * np.sin(2 * np.pi * q / c[2]) + c[1] * np.cos(2 * np.pi * q / c[2])
    ),
    "gust": lambda c, t, q, v: c[0] * (c[1] <= t < c[1] + c[2]) + 0.0 * q,
}
"""Forces at a joint as functions of coefficients, time, positions (L,) and velocities (L,).

A gust is a temporary force: the coefficients are force, begin and duration.
"""


class ServoDynamics(MachineDynamics):
    """Servo with a pendulum, equation (1)."""

    joints = ("",)
    channels = ("q",)
    motors = ("goal",)

    def compute_mass_matrix(self, q: Array) -> Array:
        """Compute the inertia J + m l^2 (L, 1, 1) about the joint, with that of hidden causes.

        J is the inertia of the rotor, and the mass m is at the distance l from the joint.

        Shapes: L batch elements.

        Args:
            q: positions, (L, 1); only their number is used.
        """
        n = self.numbers
        inertia = np.empty((len(q), 1, 1))
        # `added` is the inertia of a hidden cause.
        inertia[:, 0, 0] = n["armature"] + n["mass"] * n["length"] ** 2 + self.added[0]
        return inertia

    def compute_own_force(self, q: Array, v: Array, u: Array) -> Array:
        """Compute motor torque k (d V - k q') / R and gravity, the right-hand side of equation (1).

        The position controller sets the duty d from the error of the goal; the motor's back EMF, k
        q', reduces the torque. The motor has the torque constant k, the resistance R and the
        voltage V.

        Shapes: L batch elements.

        Args:
            q: positions, (L, 1).
            v: velocities, (L, 1).
            u: goal positions, (L, 1).
        """
        n = self.numbers
        error = u[:, 0] - q[:, 0]
        if self.dull:  # hidden cause: the controller ignores errors within the dead band, rad
            error = error - np.clip(error, -self.dull, self.dull)
        duty = np.clip(n["kp"] * n["error_gain"] * error, -1.0, 1.0)
        k = n["torque_constant"]
        torque = k * (duty * n["voltage"] - k * v[:, 0]) / n["resistance"]
        total: Array = torque[:, None] + self.compute_gravity_force(q)
        return total

    def compute_gravity_force(self, q: Array) -> Array:
        """Compute the gravity force -m g l sin q of equation (1), N m, (L, 1).

        The mass m is at the distance l from the joint.

        Shapes: L batch elements.

        Args:
            q: angle from hanging down, rad, (L, 1).
        """
        n = self.numbers
        weight: Array = -n["mass"] * n["gravity"] * n["length"] * np.sin(q[:, 0])
        return weight[:, None]

    def compute_base_acceleration_force(self, q: Array) -> Array:
        """Compute the force m l cos q of a unit acceleration along x, (L, 1).

        The mass m is at the distance l from the joint. The force is positive where a mass at
        positive q is on the right.

        Shapes: L batch elements.

        Args:
            q: angle from hanging down, rad, (L, 1).
        """
        n = self.numbers
        sideways: Array = n["mass"] * n["length"] * np.cos(q[:, 0])
        return sideways[:, None]


class ArmDynamics(MachineDynamics):
    """Arm of two links, equations (2) to (5).

    Both joints turn about y, so that a positive angle is on the negative side of x.
    """

    joints = ("shoulder", "elbow")
    bodies = ("upper_arm", "forearm")
    channels = ("q.shoulder", "q.elbow")
    motors = ("m_shoulder", "m_elbow")

    def compute_mass_matrix(self, q: Array) -> Array:
        """Compute the mass matrices (L, 2, 2) of the arm, equations (2) and (3).

            M11 = I1 + m1 c1^2 + I2 + m2 (l^2 + c2^2 + 2 l c2 cos q2) + A1                     (2)
            M12 = I2 + m2 (c2^2 + l c2 cos q2),   M22 = I2 + m2 c2^2 + A2                      (3)

        with masses m, distances c of the centres of mass, inertias I, length l of the first link
        and inertias A of the rotors.

        Shapes: L batch elements.

        Args:
            q: positions, (L, 2).
        """
        n = self.numbers
        coupling = n["mass2"] * n["length"] * n["centre2"] * np.cos(q[:, 1])
        outer_inertia = n["inertia2"] + n["mass2"] * n["centre2"] ** 2
        inner_inertia = (
            n["inertia1"] + n["mass1"] * n["centre1"] ** 2 + n["mass2"] * n["length"] ** 2
        )
        inertia = np.empty((len(q), 2, 2))
        # `added` is the rotor inertia of a hidden cause, at either joint.
        inertia[:, 0, 0] = (
            inner_inertia + outer_inertia + 2 * coupling + n["armature1"] + self.added[0]
        )
        inertia[:, 0, 1] = inertia[:, 1, 0] = outer_inertia + coupling
        inertia[:, 1, 1] = outer_inertia + n["armature2"] + self.added[1]
        return inertia

    def compute_own_force(self, q: Array, v: Array, u: Array) -> Array:
        """Compute the forces (L, 2) of inputs, gravity, Coriolis effects and damping.

        They are the right-hand side of equation (4),

            u - damping q' - g(q) + m2 l c2 sin q2 (2 q1' q2' + q2'^2, -q1'^2),

        with the mass m2 of the second link, the distance c2 of its centre of mass from its joint,
        and the length l of the first link.

        Shapes: L batch elements.

        Args:
            q: positions, (L, 2).
            v: velocities, (L, 2).
            u: joint torques, (L, 2).
        """
        n = self.numbers
        turning = n["mass2"] * n["length"] * n["centre2"] * np.sin(q[:, 1])
        total = u + self.compute_gravity_force(q)
        total[:, 0] += turning * (2 * v[:, 0] * v[:, 1] + v[:, 1] ** 2) - n["damping1"] * v[:, 0]
        total[:, 1] += -turning * v[:, 0] ** 2 - n["damping2"] * v[:, 1]
        return total

    def compute_gravity_force(self, q: Array) -> Array:
        """Compute the gravity forces -g(q) of equation (5), (L, 2)."""
        return -GRAVITY * self._compute_mass_moment(np.sin, q)

    def compute_base_acceleration_force(self, q: Array) -> Array:
        """Compute the forces of a unit acceleration along x; see `MachineDynamics`."""
        return -self._compute_mass_moment(np.cos, q)

    def _compute_mass_moment(self, function: Callable[[Array], Array], q: Array) -> Array:
        """Sum mass times lever arm of both links for each joint, as in equation (5), kg m, (L, N).

        A lever arm is a length along a link times the sine or cosine of its angle. The second link
        has the angle q1 + q2.

        Shapes: L batch elements, N joints.

        Args:
            function: sine for the lever arm of gravity, cosine for that of a horizontal
                acceleration.
            q: positions, (L, N).
        """
        n = self.numbers
        outer_moment = n["mass2"] * n["centre2"] * function(q[:, 0] + q[:, 1])
        inner_moment = (n["mass1"] * n["centre1"] + n["mass2"] * n["length"]) * function(q[:, 0])
        return np.stack([inner_moment + outer_moment, outer_moment], axis=1)


MACHINES: dict[str, type[MachineDynamics]] = {"servo": ServoDynamics, "arm2": ArmDynamics}
"""Classes of machines by the name of their system."""
