"""Robots as their files describe them: a URDF, actuators, the engine's settings."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass
from functools import cached_property

import numpy as np


@dataclass(frozen=True)
class Drive:
    """An actuator of one joint.

    Attributes:
        joint: its name.
        kind: motor (the control is a force) or position (kp (u - q) - kv v).
        kp, kv: of a position servo.
        force: the largest force.
    """

    joint: str
    kind: str
    kp: float
    kv: float
    force: float

    @property
    def name(self):
        return f"m_{self.joint}"


@dataclass(frozen=True)
class Machine:
    """A robot.

    Attributes:
        name: says where it comes from and how it is driven.
        urdf: the text of its file.
        drives: an actuator for each joint that has one.
        pose: positions about which it moves, (N,), rad or m.
        step, integrator: of MuJoCo, as the recording states them.
    """

    name: str
    urdf: str
    drives: tuple[Drive, ...]
    pose: tuple[float, ...]
    step: float = 0.002
    integrator: str = "RK4"

    @cached_property
    def _tree(self):
        return ElementTree.fromstring(self.urdf)

    @cached_property
    def joints(self):
        """Names in Pinocchio's order."""
        return tuple(self.model().names)[1:]

    @cached_property
    def bodies(self):
        """The link that each joint moves, in the same order."""
        child = {j.get("name"): j.find("child").get("link") for j in self._tree.findall("joint")}
        return tuple(child[name] for name in self.joints)

    @property
    def driven(self):
        """Indices of the joints that have an actuator, in the actuators' order."""
        return [self.joints.index(drive.joint) for drive in self.drives]

    def before(self, joint):
        """Index of the joint that carries the one of this index; -1 where none of its kind does."""
        index = int(self.model().parents[joint + 1]) - 1
        kinds = [self.unit(self.joints[k]) for k in (index, joint)] if index >= 0 else [0, 1]
        return index if kinds[0] == kinds[1] else -1

    def unit(self, joint):
        """Of a joint's position."""
        return "m" if self._joint(joint).get("type") == "prismatic" else "rad"

    def range(self, joint):
        """Lowest and highest position."""
        limit = self._joint(joint).find("limit")
        if limit is None or self._joint(joint).get("type") == "continuous":
            return -np.inf, np.inf
        low, high = float(limit.get("lower", 0)), float(limit.get("upper", 0))
        return (low, high) if high > low else (-np.inf, np.inf)

    def stated(self):
        """(damping, dry friction) of every joint, as the file says."""
        found = [self._joint(name).find("dynamics") for name in self.joints]
        return [
            (0.0, 0.0) if d is None else (float(d.get("damping", 0)), float(d.get("friction", 0)))
            for d in found
        ]

    def index(self, place):
        """The joint that a place belongs to: its own name, its body's, its actuator's, a
        channel's.
        """
        for name in (place, place.removeprefix("m_"), place.partition(".")[2]):
            if name in self.joints:
                return self.joints.index(name)
            if name in self.bodies:
                return self.bodies.index(name)
        raise KeyError(place)

    def model(self):
        """A new model of Pinocchio, gravity downwards; joints without end are unwrapped angles."""
        import pinocchio

        text = self.urdf.replace('type="continuous"', 'type="revolute"')
        tree = ElementTree.fromstring(text)
        for joint in tree.findall("joint"):
            if joint.get("type") == "revolute" and joint.find("limit") is None:
                limits = {"lower": "-1e3", "upper": "1e3", "effort": "1e6", "velocity": "1e6"}
                ElementTree.SubElement(joint, "limit", limits)
        model = pinocchio.buildModelFromXML(ElementTree.tostring(tree, encoding="unicode"))
        model.gravity.linear = np.array([0.0, 0.0, -9.81])
        model.damping = np.zeros(model.nv)
        return model

    def _joint(self, name):
        return next(j for j in self._tree.findall("joint") if j.get("name") == name)


def plain(text, locked=(), mount=None):
    """A URDF without shapes, some joints locked, its root turned.

    Args:
        text: of the file.
        locked: joints that become fixed.
        mount: roll, pitch and yaw of the root, rad.
    """
    tree = ElementTree.fromstring(text)
    for parent in list(tree):
        if parent.tag not in ("link", "joint"):
            tree.remove(parent)
            continue
        for tag in ("visual", "collision", "safety_controller", "calibration", "mimic"):
            for found in parent.findall(tag):
                parent.remove(found)
    for joint in tree.findall("joint"):
        if joint.get("name") in locked:
            joint.set("type", "fixed")
    if mount is not None:
        _mounted(tree, mount)
    ElementTree.indent(tree)
    return ElementTree.tostring(tree, encoding="unicode") + "\n"


def _mounted(tree, mount):
    children = {joint.find("child").get("link") for joint in tree.findall("joint")}
    root = next(link for link in tree.findall("link") if link.get("name") not in children)
    old, new = root.get("name"), "ground" if root.get("name") == "world" else root.get("name")
    root.set("name", new)
    for joint in tree.findall("joint"):
        if joint.find("parent").get("link") == old:
            joint.find("parent").set("link", new)
    tree.insert(0, ElementTree.Element("link", {"name": "stand"}))
    fixed = ElementTree.SubElement(tree, "joint", {"name": "mount", "type": "fixed"})
    ElementTree.SubElement(fixed, "parent", {"link": "stand"})
    ElementTree.SubElement(fixed, "child", {"link": new})
    angles = " ".join(f"{angle:.6f}" for angle in mount)
    ElementTree.SubElement(fixed, "origin", {"xyz": "0 0 0", "rpy": angles})
