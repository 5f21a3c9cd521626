"""Floating-base robots, drawn from a seed.

The same numbers give the MJCF text for simgap and, without any file, Pinocchio's model.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial.transform import Rotation

from tests.exams.robots.exam_robots import Drive

PADS = {"free": 7, "ball": 4}
"""Count of numbers in a pose of the floating base; a velocity has one less."""


@dataclass(frozen=True)
class Link:
    """A body and the joint that moves it.

    Attributes:
        name: name of the body.
        joint: name of its joint.
        parent: parent body; "" for the floating base.
        at: (3,) m, position of the joint in the parent.
        axis: (3,) axis of a hinge; unused for the floating base.
        mass: kg.
        com: (3,) m, centre of mass in the body frame.
        moments: (3,) kg m^2 about the centre of mass, along the body's axes.
        damping: damping of a hinge, N m s/rad.
    """

    name: str
    joint: str
    parent: str
    at: tuple[float, ...]
    axis: tuple[float, ...]
    mass: float
    com: tuple[float, ...]
    moments: tuple[float, ...]
    damping: float = 0.0


@dataclass(frozen=True)
class Floater:
    """A robot whose first link has a free joint or a ball joint.

    The coordinates in this folder are those of the hinges, followed by those of the floating base.
    The latter are padded so that there are as many velocities as positions: a pose (x, y, z and)
    qx, qy, qz, qw, a velocity in the body's axes, and a zero.

    Attributes:
        name: name of the model.
        root: free or ball.
        gravity: m/s^2 downwards.
        links: the floating base first, the others in the order of their joints.
        drives: one actuator for each driven joint.
        step, integrator: MuJoCo settings that the file specifies.
    """

    name: str
    root: str
    gravity: float
    links: tuple[Link, ...]
    drives: tuple[Drive, ...]
    step: float = 0.002
    integrator: str = "RK4"

    floats = True

    @property
    def model_file(self):
        """Name and text of the model file."""
        return "robot.xml", self.mjcf()

    @property
    def description(self):
        """Tables of a recording's description that say what the model file does not: none."""
        return {}

    @property
    def hinges(self):
        """Names of the joints with one coordinate."""
        return tuple(link.joint for link in self.links[1:])

    @cached_property
    def joints(self):
        """Names of all coordinates; those of the floating base are not effect places."""
        return (*self.hinges, *(f"~{k}" for k in range(PADS[self.root])))

    @property
    def bodies(self):
        """By coordinate, the link that a hinge moves, or the floating base."""
        rest = (self.links[0].name,) * PADS[self.root]
        return (*(link.name for link in self.links[1:]), *rest)

    @property
    def driven(self):
        """Coordinates with an actuator, in the order of the actuators."""
        return [self.joints.index(drive.joint) for drive in self.drives]

    def unit(self, joint):
        """Return the unit of a hinge coordinate."""
        return "rad"

    def stated(self):
        """Return (damping, dry friction) of every coordinate."""
        rest = [(0.0, 0.0)] * PADS[self.root]
        return [(link.damping, 0.0) for link in self.links[1:]] + rest

    def index(self, place):
        """Return the coordinate to which a place belongs."""
        for name in (place, place.removeprefix("m_"), place.partition(".")[2]):
            if name in self.joints:
                return self.joints.index(name)
        return self.bodies.index(place)

    def stated_initial_state(self, run):
        """Return the initial base state of a run by simgap's names.

        Position and velocity are in world axes, the rotation rate is in body axes.
        """
        base, hinges = self.links[0].joint, len(self.hinges)
        pose, rate = run.q[hinges:], run.v[hinges:-1]
        x, y, z, w = pose[-4:]
        state = dict(zip((f"q.{base}.q{axis}" for axis in "wxyz"), (w, x, y, z), strict=True))
        state |= dict(zip((f"qd.{base}.w{axis}" for axis in "xyz"), rate[-3:], strict=True))
        if self.root == "free":
            drift = Rotation.from_quat(pose[3:]).apply(rate[:3])
            state |= dict(zip((f"q.{base}.{axis}" for axis in "xyz"), pose[:3], strict=True))
            state |= dict(zip((f"qd.{base}.{axis}" for axis in "xyz"), drift, strict=True))
        return {name: float(value) for name, value in state.items()}

    def number(self, place):
        """Return Pinocchio's number of the joint of a place; the floating base has number 1."""
        at = self.index(place)
        return 1 if at >= len(self.hinges) else at + 2

    def model(self):
        """Build a new Pinocchio model."""
        import pinocchio as pin

        model = pin.Model()
        model.gravity.linear = np.array([0.0, 0.0, -self.gravity])
        roots = {"free": pin.JointModelFreeFlyer, "ball": pin.JointModelSpherical}
        numbers = {"": 0}
        for link in self.links:
            joint = pin.JointModelRevoluteUnaligned(*link.axis) if link.parent else None
            joint = joint or roots[self.root]()
            place = pin.SE3(np.eye(3), np.array(link.at if link.parent else self.mount))
            numbers[link.name] = model.addJoint(numbers[link.parent], joint, place, link.joint)
            body = pin.Inertia(link.mass, np.array(link.com), np.diag(link.moments))
            model.appendBodyToJoint(numbers[link.name], body, pin.SE3.Identity())
        model.damping = np.zeros(model.nv)
        return model

    @property
    def mount(self):
        """Position of a ball joint in the world; zero for a free joint."""
        return self.links[0].at if self.root == "ball" else (0.0, 0.0, 0.0)

    def mjcf(self):
        """Return the MJCF text of the robot."""
        lines = [f'<mujoco model="{self.name}">']
        lines.append(
            f'  <option timestep="{self.step}" integrator="{self.integrator}" '
            f'gravity="0 0 {-self.gravity:.6g}"/>'
        )
        lines += ["  <worldbody>", *self._body(self.links[0], "    "), "  </worldbody>"]
        lines.append("  <actuator>")
        for drive in self.drives:
            kind = f'position kp="{drive.kp:.6g}" kv="{drive.kv:.6g}"' if drive.kp else "motor"
            tag, _, gains = kind.partition(" ")
            limits = f'forcelimited="true" forcerange="{-drive.force:.6g} {drive.force:.6g}"'
            lines.append(f'    <{tag} name="{drive.name}" joint="{drive.joint}" {gains} {limits}/>')
        return "\n".join([*lines, "  </actuator>", "</mujoco>"]) + "\n"

    def _body(self, link, indent):
        """Return the MJCF lines of a body and its children."""

        def text(numbers):
            return " ".join(f"{number:.17g}" for number in numbers)

        lines = [f'{indent}<body name="{link.name}" pos="{text(link.at)}">']
        if link.parent:
            lines.append(
                f'{indent}  <joint name="{link.joint}" type="hinge" axis="{text(link.axis)}" '
                f'damping="{link.damping:.17g}"/>'
            )
        else:
            lines.append(f'{indent}  <joint name="{link.joint}" type="{self.root}"/>')
        lines.append(
            f'{indent}  <inertial pos="{text(link.com)}" mass="{link.mass:.17g}" '
            f'diaginertia="{text(link.moments)}"/>'
        )
        for other in self.links:
            if other.parent == link.name:
                lines += self._body(other, indent + "  ")
        return [*lines, f"{indent}</body>"]


NAMES = ("satellite-motor", "dropped-servo", "hung-motor")
"""A hull in space with an arm; a falling trunk with two legs; a body on a ball joint with an arm.
"""


def machine(name, rng):
    """Draw a robot of `NAMES`."""
    return {"satellite": _satellite, "dropped": _dropped, "hung": _hung}[name.partition("-")[0]](
        rng
    )


def _rod(name, joint, parent, at, axis, mass, length, damping):
    """Return a rod that hangs from its joint."""
    thick = 0.04
    across = mass * (3 * thick**2 + length**2) / 12
    along = mass * thick**2 / 2
    com = (0.0, 0.0, -length / 2)
    return Link(name, joint, parent, at, axis, mass, com, (across, across, along), damping)


def _axis(rng):
    """Draw a hinge axis, mostly across a rod."""
    way = np.array([rng.normal(), rng.normal(), 0.3 * rng.normal()])
    return tuple((way / np.linalg.norm(way)).tolist())


def _hull(name, joint, at, rng, heavy):
    mass = float(rng.uniform(*heavy))
    sides = rng.uniform(0.2, 0.5, 3)
    moments = mass / 12 * np.array([sides[[1, 2]] @ sides[[1, 2]], sides[[0, 2]] @ sides[[0, 2]],
                                    sides[[0, 1]] @ sides[[0, 1]]])  # fmt: skip
    com = tuple(rng.uniform(-0.05, 0.05, 3).tolist())
    return Link(name, joint, "", at, (), mass, com, tuple(moments.tolist()))


def _satellite(rng):
    lengths, masses = rng.uniform(0.3, 0.5, 2), rng.uniform([0.6, 0.3], [1.5, 0.8])
    links = (
        _hull("hull", "base", (0.0, 0.0, 0.0), rng, (4.0, 9.0)),
        _rod("upper", "shoulder", "hull", (0.2, 0.05, -0.1), _axis(rng), masses[0], lengths[0],
             float(rng.uniform(0.01, 0.03))),
        _rod("lower", "elbow", "upper", (0.0, 0.0, -lengths[0]), _axis(rng), masses[1],
             lengths[1], float(rng.uniform(0.01, 0.03))),
    )  # fmt: skip
    drives = tuple(Drive(name, "motor", 0.0, 0.0, 20.0) for name in ("shoulder", "elbow"))
    return Floater("satellite", "free", 0.0, links, drives)


def _dropped(rng):
    masses, lengths = rng.uniform(0.4, 1.0, 2), rng.uniform(0.25, 0.4, 2)
    links = [_hull("trunk", "root", (0.0, 0.0, 3.0), rng, (3.0, 6.0))]
    drives = []
    for number, side in enumerate(("left", "right")):
        at = (0.0, 0.15 - 0.3 * number, -0.1)
        links.append(
            _rod(f"{side}_leg", side, "trunk", at, _axis(rng), masses[number], lengths[number],
                 float(rng.uniform(0.02, 0.08)))
        )  # fmt: skip
        swung = masses[number] * lengths[number] ** 2 / 3
        kp = float(swung * (2 * np.pi * rng.uniform(2.0, 4.0)) ** 2)
        kv = float(2 * rng.uniform(0.3, 0.8) * np.sqrt(kp * swung))
        drives.append(Drive(side, "position", kp, kv, 60.0))
    return Floater("dropped", "free", 9.81, tuple(links), tuple(drives))


def _hung(rng):
    length, mass = float(rng.uniform(0.3, 0.5)), rng.uniform(0.4, 0.9, 2)
    body = _rod("body", "socket", "", (0.0, 0.0, 2.0), (), float(rng.uniform(2, 4)), length, 0.0)
    links = (
        body,
        _rod("upper", "shoulder", "body", (0.03, 0.0, -length), _axis(rng), mass[0], 0.3,
             float(rng.uniform(0.02, 0.05))),
        _rod("lower", "elbow", "upper", (0.0, 0.0, -0.3), _axis(rng), mass[1], 0.25,
             float(rng.uniform(0.02, 0.05))),
    )  # fmt: skip
    drives = tuple(Drive(name, "motor", 0.0, 0.0, 20.0) for name in ("shoulder", "elbow"))
    return Floater("hung", "ball", 9.81, links, drives)
