"""Robots as their files describe them: URDF, actuators, engine settings; also in plain MuJoCo."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass
from functools import cached_property

import numpy as np


@dataclass(frozen=True)
class Drive:
    """An actuator of one joint.

    Attributes:
        joint: name of the joint.
        kind: motor (the control is a force) or position (force kp (u - q) - kv v).
        kp, kv: gains of a position servo.
        force: largest force, N m or N; infinite without a limit.
        called: name of the actuator; m_JOINT if empty.
    """

    joint: str
    kind: str
    kp: float
    kv: float
    force: float
    called: str = ""

    @property
    def name(self):
        return self.called or f"m_{self.joint}"

    @property
    def description(self):
        """Table of the actuator in a recording's description."""
        gains = {"kp": self.kp, "kv": self.kv} if self.kp else {}
        limits = {"force_range": [-self.force, self.force]} if np.isfinite(self.force) else {}
        return {"joint": self.joint, "kind": self.kind} | gains | limits


@dataclass(frozen=True)
class Machine:
    """A robot with its actuators and engine settings.

    Attributes:
        name: model and drive, as in `robot_models.NAMES`.
        urdf: text of the URDF file.
        drives: one actuator for each driven joint.
        pose: positions around which the robot moves, (N,), rad or m.
        step, integrator: MuJoCo settings that the recording specifies.
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
        """Joint names in Pinocchio's order."""
        return tuple(self.model().names)[1:]

    @cached_property
    def bodies(self):
        """The link that each joint moves, in the order of `joints`."""
        child = {j.get("name"): j.find("child").get("link") for j in self._tree.findall("joint")}
        return tuple(child[name] for name in self.joints)

    floats = False

    @property
    def hinges(self):
        """Names of the joints with one coordinate."""
        return self.joints

    @property
    def model_file(self):
        """Name and text of the model file."""
        return "robot.urdf", self.urdf

    @property
    def description(self):
        """Tables of a recording's description that say what the model file does not."""
        engine = {"timestep": self.step, "integrator": self.integrator}
        return {"engine": engine, "actuators": {d.name: d.description for d in self.drives}}

    def stated_initial_state(self, run):
        """Return the initial state of a run that its description states: none."""
        return {}

    @property
    def driven(self):
        """Indices of the joints with an actuator, in the order of the actuators."""
        return [self.joints.index(drive.joint) for drive in self.drives]

    def before(self, joint):
        """Return the index of the parent joint; -1 if there is none of the same unit."""
        index = int(self.model().parents[joint + 1]) - 1
        kinds = [self.unit(self.joints[k]) for k in (index, joint)] if index >= 0 else [0, 1]
        return index if kinds[0] == kinds[1] else -1

    def unit(self, joint):
        """Return the unit of the position of a joint."""
        return "m" if self._joint(joint).get("type") == "prismatic" else "rad"

    def range(self, joint):
        """Return the lowest and the highest position of a joint."""
        limit = self._joint(joint).find("limit")
        if limit is None or self._joint(joint).get("type") == "continuous":
            return -np.inf, np.inf
        low, high = float(limit.get("lower", 0)), float(limit.get("upper", 0))
        return (low, high) if high > low else (-np.inf, np.inf)

    def stated(self):
        """Return (damping, dry friction) of every joint as the file specifies them."""
        found = [self._joint(name).find("dynamics") for name in self.joints]
        return [
            (0.0, 0.0) if d is None else (float(d.get("damping", 0)), float(d.get("friction", 0)))
            for d in found
        ]

    def index(self, place):
        """Return the index of the joint to which a place belongs.

        A place is the name of a joint, a body, an actuator or a channel.
        """
        for name in (place, place.removeprefix("m_"), place.partition(".")[2]):
            if name in self.joints:
                return self.joints.index(name)
            if name in self.bodies:
                return self.bodies.index(name)
        raise KeyError(place)

    def number(self, place):
        """Return Pinocchio's number of the joint of a place."""
        return self.index(place) + 1

    def model(self):
        """Build a new Pinocchio model with gravity downwards.

        Continuous joints become revolute joints with unwrapped angles.
        """
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
    """Return a URDF without geometry, with some joints locked and the root rotated.

    Args:
        text: text of the file.
        locked: names of joints that become fixed.
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


def compile_urdf(text, drives, step, integrator):
    """Compile a MuJoCo model of a URDF with actuators.

    Args:
        text: text of the file.
        drives: actuators.
        step: time step, s.
        integrator: name of the integrator.
    """
    import mujoco

    spec = mujoco.MjSpec.from_string(text)
    spec.option.timestep = step
    spec.option.integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{integrator.upper()}")
    for drive in drives:
        actuator = spec.add_actuator(name=drive.name, target=drive.joint)
        actuator.trntype = mujoco.mjtTrn.mjTRN_JOINT
        if drive.kind == "position":
            actuator.set_to_position(kp=drive.kp, kv=drive.kv)
        else:
            actuator.set_to_motor()
        if np.isfinite(drive.force):
            actuator.forcerange, actuator.forcelimited = [-drive.force, drive.force], True
    return spec.compile()


def moved(machine, run, step=None, integrator=None):
    """Return positions and velocities (T, N) at the run's time stamps, multiples of the step."""
    import mujoco

    model = compile_urdf(
        machine.urdf, machine.drives, step or machine.step, integrator or machine.integrator
    )
    data = mujoco.MjData(model)
    places = [model.joint(name).qposadr[0] for name in machine.joints]
    rates = [model.joint(name).dofadr[0] for name in machine.joints]
    data.qpos[places], data.qvel[rates] = run.q, run.v
    commands = np.array([run.commands[model.actuator(i).name] for i in range(model.nu)])
    rows, number = [], 0
    for k, t in enumerate(run.times.tolist()):
        while number < round(t / model.opt.timestep):
            mujoco.mj_step(model, data)
            number += 1
        rows.append((data.qpos[places].copy(), data.qvel[rates].copy()))
        data.ctrl[:] = commands[:, k]
    q, v = (np.array(part) for part in zip(*rows, strict=True))
    return q, v
