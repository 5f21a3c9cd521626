"""What a robot's model file says, once it is read: its joints, actuators, bodies and sensors, from
the compiled model.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property, wraps
from pathlib import Path
from typing import Any, Concatenate, Literal, ParamSpec, TypeVar

import numpy as np

from sims.base import InputError, unknown
from sims.robot.collision_hulls import CollisionShapes
from sims.robot.friction_form import FrictionForm
from sims.robot.quiet import quiet

Format = Literal["mjcf", "urdf"]
Kind = Literal["hinge", "slide", "ball", "free"]
Drive = Literal["motor", "position", "velocity", "pid", "other"]
KINDS: tuple[Kind, ...] = ("free", "ball", "slide", "hinge")
"""In the order of MuJoCo's mjtJoint."""


TENDON = "_coupling"
"""What the tendon of a drive that is coupled to two joints is called, behind its own joint's
name.
"""


@dataclass(frozen=True)
class Joint:
    """A joint.

    Attributes:
        name: of the model; ``joint3`` where it has none.
        kind: as MuJoCo calls it.
        id: its number.
        position: address of its first position.
        velocity: address of its first velocity.
        range: lowest and highest position, rad or m; None where it is not limited.
        effort: largest force of its actuators, N or N m; None where it is not limited.
    """

    name: str
    kind: Kind
    id: int
    position: int
    velocity: int
    range: tuple[float, float] | None
    effort: float | None

    @property
    def single(self) -> bool:
        """Whether it has one coordinate."""
        return self.kind in ("hinge", "slide")

    @property
    def unit(self) -> str:
        """Of its position."""
        return "rad" if self.kind == "hinge" else "m"

    @property
    def force_unit(self) -> str:
        """Of the force along it."""
        return "N*m" if self.kind == "hinge" else "N"


@dataclass(frozen=True)
class Actuator:
    """An actuator.

    Attributes:
        name: of the model; ``actuator3`` where it has none.
        id: its number.
        joint: the joint that it drives; None where it drives something else.
        kind: ``motor`` (its control is a force, by its gear), ``position``, ``velocity``, ``pid``,
            or ``other``.
        range: of its (first) control; None where it is not limited.
        force: lowest and highest force; None where it is not limited.
        control: address of its first control.
        controls: how many it has: a pid may have, in this order, a position, a velocity, a force.
    """

    name: str
    id: int
    joint: str | None
    kind: Drive
    range: tuple[float, float] | None
    force: tuple[float, float] | None
    control: int = -1
    controls: int = 1


@dataclass(frozen=True)
class Body:
    """A body that moves, with its number, its mass in kg, and the links that are fused to it."""

    name: str
    id: int
    mass: float
    aliases: tuple[str, ...] = ()


@dataclass(frozen=True)
class SensorRow:
    """A row of a sensor: its name (``force.x`` of a sensor with three rows), where it stands in
    ``sensordata``, and its unit.
    """

    name: str
    address: int
    unit: str


@dataclass(frozen=True, eq=False)
class Robot:
    """A model file that has been read.

    Attributes:
        path: of the file.
        format: mjcf or urdf.
        spec: what was read and mended, a mujoco.MjSpec; compile a copy of it and leave it as it is.
        notes: what was mended or left out, one line each.
        aliases: by link that is fused into another, the body that MuJoCo compiles.
        digest: of all that was read, in hexadecimal digits.
        rated: actuators whose second control is the rate of their first, to be put in with it.
        actuator_tables: actuators that a recording added, by name, as it states them.
        engine_table: step and integrator in place of the file's, as it states them.
        speeds: of joints, the fastest that a URDF allows, rad/s or m/s; an MJCF states none.
        series: of joints that were put in series with others (`sims.robot.series`), by name, the
            inertia about them, kg or kg m^2; no other joint is in this model alone.
        coupled: joints whose drives turn the joint before as well (`sims.robot.coupled`).
        friction_form: of dry friction that effects add to the file's; the friction that the file
            states alone keeps the file's solver parameters.
        shapes: what is written into its compiled models, where their meshes are convex hulls.
        kept: what functions `kept_with_robot` found of it.
    """

    path: Path
    format: Format
    spec: Any
    notes: tuple[str, ...] = ()
    aliases: Mapping[str, str] | None = None
    digest: str = ""
    rated: tuple[str, ...] = ()
    actuator_tables: Mapping[str, Any] = field(default_factory=dict)
    engine_table: Mapping[str, Any] = field(default_factory=dict)
    speeds: Mapping[str, float] = field(default_factory=dict)
    series: Mapping[str, float] = field(default_factory=dict)
    coupled: tuple[str, ...] = ()
    friction_form: FrictionForm = "stiff"
    shapes: CollisionShapes | None = None
    kept: dict[tuple[Any, ...], Any] = field(default_factory=dict, init=False, repr=False)

    @cached_property
    def compiled(self) -> Any:
        """The mujoco.MjModel; nobody writes into it."""
        # A spec that has been compiled holds all meshes once more.
        return self.compile(self.spec.copy())

    def compile(self, spec: Any) -> Any:
        """Compile a spec of this robot, a mujoco.MjSpec."""
        with quiet():
            model = spec.compile()
        if self.shapes is not None:
            self.shapes.write(model)
        return model

    def with_friction_form(self, form: FrictionForm) -> Robot:
        """The same robot, to which effects add dry friction in this form."""
        other = replace(self, friction_form=form)
        # The form is no part of the compiled model, so that it need not be compiled again.
        other.__dict__["compiled"] = self.compiled
        return other

    @property
    def name(self) -> str:
        """Of the model, by its file."""
        return self.path.stem

    @cached_property
    def joints(self) -> tuple[Joint, ...]:
        """All joints, in the order of their velocities."""
        model = self.compiled
        joints = []
        for i in range(model.njnt):
            kind = KINDS[int(model.jnt_type[i])]
            low, high = (float(v) for v in model.jnt_range[i])
            effort = _limit(model.jnt_actfrcrange[i], bool(model.jnt_actfrclimited[i]))
            joints.append(
                Joint(
                    name=model.joint(i).name or f"joint{i}",
                    kind=kind,
                    id=i,
                    position=int(model.jnt_qposadr[i]),
                    velocity=int(model.jnt_dofadr[i]),
                    range=(low, high) if model.jnt_limited[i] else None,
                    effort=effort[1] if effort else None,
                )
            )
        return tuple(joints)

    @cached_property
    def actuators(self) -> tuple[Actuator, ...]:
        """All actuators."""
        model = self.compiled
        # Before MuJoCo 4 each actuator had one control.
        return tuple(self._actuator(i) for i in range(getattr(model, "nactuator", model.nu)))

    def _actuator(self, i: int) -> Actuator:
        import mujoco

        model = self.compiled
        joint = None
        drives = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))
        if int(model.actuator_trntype[i]) in drives:
            joint = self.joints[int(model.actuator_trnid[i, 0])].name
        if self.coupled and int(model.actuator_trntype[i]) == int(mujoco.mjtTrn.mjTRN_TENDON):
            tendon = model.tendon(int(model.actuator_trnid[i, 0])).name
            own = tendon.removesuffix(TENDON)
            joint = own if own in self.coupled else None
        control, controls = i, 1
        if hasattr(model, "actuator_ctrladr"):
            control, controls = int(model.actuator_ctrladr[i]), int(model.actuator_ctrlnum[i])
        limited = controls > 0 and bool(model.actuator_ctrllimited[control])
        return Actuator(
            name=model.actuator(i).name or f"actuator{i}",
            id=i,
            joint=joint,
            kind=_kind(model, i),
            range=_limit(model.actuator_ctrlrange[control], True) if limited else None,
            force=_limit(model.actuator_forcerange[i], bool(model.actuator_forcelimited[i])),
            control=control,
            controls=controls,
        )

    @cached_property
    def bodies(self) -> tuple[Body, ...]:
        """The bodies that joints move, directly or through others."""
        model = self.compiled
        fused: dict[str, list[str]] = {}
        for alias, name in (self.aliases or {}).items():
            fused.setdefault(name, []).append(alias)
        moving = []
        for i in range(1, model.nbody):
            # Bodies welded to the world are part of it; those welded to others move with them.
            if int(model.body_weldid[i]) == 0:
                continue
            name = model.body(i).name or f"body{i}"
            aliases = tuple(fused.get(name, ()))
            moving.append(Body(name, i, float(model.body_mass[i]), aliases))
        return tuple(moving)

    @cached_property
    def sensors(self) -> tuple[SensorRow, ...]:
        """Rows of all sensors."""
        model = self.compiled
        rows = []
        for i in range(model.nsensor):
            name = model.sensor(i).name or f"sensor{i}"
            begin, count = int(model.sensor_adr[i]), int(model.sensor_dim[i])
            ends = [""] if count == 1 else [f".{axis}" for axis in _axes(count)]
            unit = self._unit(i)
            rows += [SensorRow(name + end, begin + k, unit) for k, end in enumerate(ends)]
        return tuple(rows)

    def _unit(self, sensor: int) -> str:
        """Of what a sensor shows; 1 where it is not known."""
        import mujoco

        model, of = self.compiled, mujoco.mjtSensor
        kind, on = int(model.sensor_type[sensor]), int(model.sensor_objid[sensor])
        if kind == int(of.mjSENS_JOINTPOS):
            return self.joints[on].unit
        if kind == int(of.mjSENS_JOINTVEL):
            return f"{self.joints[on].unit}/s"
        if kind in (int(of.mjSENS_JOINTACTFRC), int(of.mjSENS_JOINTLIMITFRC)):
            return self.joints[on].force_unit
        return _UNITS.get(kind, "1")

    def integrates(self, actuator: Actuator) -> bool:
        """Whether an actuator's force follows the integral of its control, as ``intvelocity``."""
        import mujoco

        integrator = int(mujoco.mjtDyn.mjDYN_INTEGRATOR)
        return int(self.compiled.actuator_dyntype[actuator.id]) == integrator

    def joint(self, name: str) -> Joint:
        """The joint of this name.

        Raises:
            InputError: there is none; the message lists those that there are.
        """
        found: Joint = self._named("joint", name, {joint.name: joint for joint in self.joints})
        return found

    def actuator(self, name: str) -> Actuator:
        """The actuator of this name; errors as in `joint`."""
        found: Actuator = self._named("actuator", name, {a.name: a for a in self.actuators})
        return found

    def body(self, name: str) -> Body:
        """The body of this name, or into which the link of this name is fused; errors as in
        `joint`.
        """
        bodies = {body.name: body for body in self.bodies}
        fused = (self.aliases or {}).get(name, name)
        found: Body = self._named("body", fused if fused in bodies else name, bodies)
        return found

    def _named(self, kind: str, name: str, known: Mapping[str, Any]) -> Any:
        if name not in known:
            error = unknown(f"{kind} of {self.path.name}", name, list(known) or ["none"])
            raise InputError(str(error))
        return known[name]


_P = ParamSpec("_P")
_T = TypeVar("_T")


def kept_with_robot(
    function: Callable[Concatenate[Robot, _P], _T],
) -> Callable[Concatenate[Robot, _P], _T]:
    """A function of a robot that is asked once for each robot and arguments: what it finds goes
    with the robot. A cache of the module would hold every model that a process has read.
    """

    @wraps(function)
    def asked(robot: Robot, /, *args: _P.args, **kwargs: _P.kwargs) -> _T:
        key = (function, *args, *kwargs.items())
        if key not in robot.kept:
            robot.kept[key] = function(robot, *args, **kwargs)
        found: _T = robot.kept[key]
        return found

    return asked


def _limit(values: Any, limited: bool) -> tuple[float, float] | None:
    return (float(values[0]), float(values[1])) if limited else None


def _kind(model: Any, i: int) -> Drive:
    """What an actuator's control means, by its gain and its bias (MuJoCo's shortcuts)."""
    import mujoco

    gain, bias = model.actuator_gainprm[i], model.actuator_biasprm[i]
    fixed = int(model.actuator_gaintype[i]) == int(mujoco.mjtGain.mjGAIN_FIXED)
    affine = int(model.actuator_biastype[i]) == int(mujoco.mjtBias.mjBIAS_AFFINE)
    dynamics = int(model.actuator_dyntype[i])
    # A filter changes when a control acts, not what it means.
    direct = dynamics == int(mujoco.mjtDyn.mjDYN_NONE) or dynamics in filters()
    pid = getattr(mujoco.mjtGain, "mjGAIN_PID", None)  # since MuJoCo 4
    if pid is not None and int(model.actuator_gaintype[i]) == int(pid):
        return "pid"
    if not fixed or not direct:
        return "other"
    if not affine or not np.any(bias[:3]):
        return "motor"
    if bias[0] == 0 and bias[1] == -gain[0] and gain[0] != 0:
        return "position"
    if bias[0] == 0 and bias[1] == 0 and bias[2] == -gain[0]:
        return "velocity"
    return "other"


def filters() -> tuple[int, int]:
    """Return MuJoCo's numbers of first-order filters before an actuator (mjtDyn)."""
    import mujoco

    return int(mujoco.mjtDyn.mjDYN_FILTER), int(mujoco.mjtDyn.mjDYN_FILTEREXACT)


def _axes(count: int) -> list[str]:
    named = {3: "xyz", 4: "wxyz"}
    return list(named[count]) if count in named else [str(k) for k in range(count)]


_UNITS: Mapping[int, str] = {
    0: "N",  # touch
    1: "m/s^2",  # accelerometer
    2: "m/s",  # velocimeter
    3: "rad/s",  # gyro
    4: "N",  # force
    5: "N*m",  # torque
    26: "m",  # position of a frame
    31: "m/s",  # its velocity
    32: "rad/s",
    33: "m/s^2",
    34: "rad/s^2",
    35: "m",  # centre of mass of a subtree
    36: "m/s",
}
"""Units of sensors, by the number of MuJoCo's mjtSensor; those of joints and actuators hang on what
they are of.
"""
