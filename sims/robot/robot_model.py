"""A robot read from a model file: joints, actuators, bodies and sensors of the compiled model."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property, wraps
from pathlib import Path
from typing import Any, Concatenate, Literal, ParamSpec, TypeVar

import numpy as np

from sims.core.simulator import make_unknown_name_error
from sims.recording.recorded_poses import ANGLES, POSITION_AXES
from sims.robot.mujoco_messages import capture_mujoco_warnings
from sims.robot.parsing.collision_hulls import CollisionShapes

_P = ParamSpec("_P")
_T = TypeVar("_T")

Format = Literal["mjcf", "urdf"]
JointKind = Literal["hinge", "slide", "ball", "free"]
ActuatorKind = Literal["motor", "position", "velocity", "pid", "other"]
FrictionForm = Literal["stiff", "soft"]
"""Form in which MuJoCo's solver applies the dry friction that effects add.

``stiff`` is Coulomb friction that is as stiff as the integrator allows. ``soft`` keeps the solver
parameters of the model file (`solreffriction`, `solimpfriction`), or MuJoCo's defaults if the file
does not specify them.
"""
FRICTION_FORMS: tuple[FrictionForm, ...] = ("stiff", "soft")
"""All values of `FrictionForm`."""
KINDS: tuple[JointKind, ...] = ("free", "ball", "slide", "hinge")
"""Joint kinds, in the order of MuJoCo's mjtJoint."""


COUPLING_TENDON_SUFFIX = "_coupling"
"""Suffix of the name of a coupled drive's tendon, after the name of the drive's own joint."""


@dataclass(frozen=True)
class Joint:
    """A joint.

    Attributes:
        name: name in the model.
        kind: kind, in MuJoCo's words.
        id: number in the compiled model.
        position: address of its first position in qpos.
        velocity: address of its first velocity in qvel.
        range: lowest and highest position, rad or m; None if not limited.
        effort: largest force of its actuators, N or N m; None if not limited.
    """

    name: str
    kind: JointKind
    id: int
    position: int
    velocity: int
    range: tuple[float, float] | None
    effort: float | None

    @property
    def has_one_coordinate(self) -> bool:
        """True if the joint has one coordinate."""
        return self.motion is not None

    @property
    def motion(self) -> Literal["hinge", "slide"] | None:
        """Kind of its one coordinate, an angle or a length; None if it has several."""
        return self.kind if self.kind in ("hinge", "slide") else None

    @property
    def unit(self) -> str:
        """Unit of the position."""
        return "rad" if self.kind == "hinge" else "m"

    @property
    def force_unit(self) -> str:
        """Unit of the force along the joint."""
        return "N*m" if self.kind == "hinge" else "N"


@dataclass(frozen=True)
class Actuator:
    """An actuator.

    Attributes:
        name: name in the model.
        id: number in the compiled model.
        joint: joint that it drives; None if it drives something else.
        kind: ``motor`` (its control is a force, times the gear), ``position``, ``velocity``,
            ``pid``, or ``other``.
        range: range of its (first) control; None if not limited.
        force: lowest and highest force; None if not limited.
        motion: whether it acts along an angle (``hinge``) or a length (``slide``): of its joint, of
            its tendon, or of the force or torque at its site; None if it acts along neither.
        moves: joints that it drives through a fixed tendon.
        control: address of its first control.
        controls: number of its controls: a pid may have, in this order, a position, a velocity, a
            force.
    """

    name: str
    id: int
    joint: str | None
    kind: ActuatorKind
    range: tuple[float, float] | None
    force: tuple[float, float] | None
    control: int = -1
    controls: int = 1
    motion: Literal["hinge", "slide"] | None = None
    moves: tuple[str, ...] = ()

    @property
    def control_unit(self) -> str:
        """Unit of the control."""
        if self.motion is None:
            return "1"
        length, force = ("rad", "N*m") if self.motion == "hinge" else ("m", "N")
        units = {"position": length, "velocity": f"{length}/s", "motor": force}
        return units.get(self.kind, "1")


@dataclass(frozen=True)
class Body:
    """A moving body, with its number, its mass in kg, and the links that are fused to it."""

    name: str
    id: int
    mass: float
    aliases: tuple[str, ...] = ()


@dataclass(frozen=True)
class SensorRow:
    """One row of a sensor's data.

    Attributes:
        name: name; such as ``force.x`` for a sensor with three rows.
        address: address in ``sensordata``.
        unit: unit of the value.
    """

    name: str
    address: int
    unit: str


@dataclass(frozen=True, eq=False)
class RobotModel:
    """A robot read from a model file.

    Attributes:
        path: path of the model file.
        format: mjcf or urdf.
        spec: repaired mujoco.MjSpec, in which joints, actuators, bodies and sensors have names;
            compile a copy of it and do not change it.
        notes: notes about repairs and omissions, one line each.
        aliases: body that MuJoCo compiles, by name of a link that is fused into it.
        digest: digest of everything that was read, in hexadecimal digits.
        rate_controlled_actuators: actuators whose second control is the rate of their first; the
            simulation sets it.
        actuator_tables: actuators that a recording added, by name, as specified there.
        engine_table: time step and integrator that a recording specified instead of the file's.
        recorded_bases: floating joints that are replaced by slides and hinges, since their pose is
            recorded (`sims.robot.parsing.floating_bases`).
        speeds: velocity limits of joints in a URDF, rad/s or m/s; an MJCF specifies none.
        series: added joints in series with others (`dynamics.series_joints`): inertia about them by
            name, kg or kg m^2; only these joints are not in the model file.
        coupled: joints whose drives also drive the preceding joint (`sims.robot.coupled_drives`).
        contacts: pairs of geoms that touch in a recording, as `contact_pairs` names them; effects
            at these contacts are candidates.
        friction_form: form of the dry friction that effects add; friction of the file without added
            friction keeps the file's solver parameters.
        shapes: data written into compiled models whose meshes are convex hulls.
        function_cache: results of functions with the decorator `cache_per_robot`.
    """

    path: Path
    format: Format
    spec: Any
    notes: tuple[str, ...] = ()
    aliases: Mapping[str, str] | None = None
    digest: str = ""
    rate_controlled_actuators: tuple[str, ...] = ()
    actuator_tables: Mapping[str, Any] = field(default_factory=dict)
    engine_table: Mapping[str, Any] = field(default_factory=dict)
    recorded_bases: tuple[str, ...] = ()
    speeds: Mapping[str, float] = field(default_factory=dict)
    series: Mapping[str, float] = field(default_factory=dict)
    coupled: tuple[str, ...] = ()
    contacts: tuple[str, ...] = ()
    friction_form: FrictionForm = "stiff"
    shapes: CollisionShapes | None = None
    function_cache: dict[tuple[Any, ...], Any] = field(default_factory=dict, init=False, repr=False)

    @cached_property
    def compiled(self) -> Any:
        """The compiled mujoco.MjModel; it must not be changed."""
        # A copy is compiled, since a compiled spec holds all meshes a second time.
        return self.compile(self.spec.copy())

    def compile(self, spec: Any) -> Any:
        """Compile a mujoco.MjSpec of this robot."""
        with capture_mujoco_warnings():
            model = spec.compile()
        if self.shapes is not None:
            self.shapes.write(model)
        return model

    def with_friction_form(self, form: FrictionForm) -> RobotModel:
        """Return the robot with another form of the dry friction that effects add."""
        return self._with_same_model(friction_form=form)

    def with_contacts(self, contacts: tuple[str, ...]) -> RobotModel:
        """Return the robot with the contacts at which effects are candidates."""
        return self._with_same_model(contacts=contacts)

    def _with_same_model(self, **changes: Any) -> RobotModel:
        """Return the robot with changes on which the compiled model does not depend."""
        robot = replace(self, **changes)
        robot.__dict__["compiled"] = self.compiled
        return robot

    @property
    def is_on_ground(self) -> bool:
        """True if a floating body whose pose is recorded touches something, such as a floor."""
        return bool(self.contacts and self.recorded_bases)

    @cached_property
    def base_orientations(self) -> Mapping[str, tuple[float, ...]]:
        """Orientation (w, x, y, z) that the model file gives each body with a recorded pose.

        The keys are the names of the free or ball joints of the file. In the compiled model, slides
        and hinges named JOINT.ANGLE replace them, so that a body is found by its first hinge.
        """
        hinges = {base: self.joint(f"{base}.{ANGLES[0]}").id for base in self.recorded_bases}
        return {
            base: tuple(self.compiled.body(int(self.compiled.jnt_bodyid[hinge])).quat.tolist())
            for base, hinge in hinges.items()
        }

    @cached_property
    def base_joints(self) -> frozenset[str]:
        """Names of the slides and hinges that replace floating joints whose pose is recorded."""
        axes = (*POSITION_AXES, *ANGLES)
        return frozenset(f"{base}.{axis}" for base in self.recorded_bases for axis in axes)

    @cached_property
    def file_joints(self) -> tuple[Joint, ...]:
        """Joints of the model file with one coordinate, without those that `series` adds."""
        return tuple(j for j in self.joints if j.has_one_coordinate and j.name not in self.series)

    @property
    def name(self) -> str:
        """Name of the robot: the file name without its suffix."""
        return self.path.stem

    @cached_property
    def joints(self) -> tuple[Joint, ...]:
        """All joints, in the order of their velocities."""
        model = self.compiled
        joints = []
        for joint_id in range(model.njnt):
            kind = KINDS[int(model.jnt_type[joint_id])]
            low, high = (float(v) for v in model.jnt_range[joint_id])
            effort = _get_limit(
                model.jnt_actfrcrange[joint_id], bool(model.jnt_actfrclimited[joint_id])
            )
            joints.append(
                Joint(
                    name=model.joint(joint_id).name,
                    kind=kind,
                    id=joint_id,
                    position=int(model.jnt_qposadr[joint_id]),
                    velocity=int(model.jnt_dofadr[joint_id]),
                    range=(low, high) if model.jnt_limited[joint_id] else None,
                    # The upper limit of the actuator force.
                    effort=effort[1] if effort else None,
                )
            )
        return tuple(joints)

    @cached_property
    def actuators(self) -> tuple[Actuator, ...]:
        """All actuators."""
        model = self.compiled
        # Before MuJoCo 4 each actuator had one control.
        return tuple(
            self._describe_actuator(i) for i in range(getattr(model, "nactuator", model.nu))
        )

    def _describe_actuator(self, i: int) -> Actuator:
        """Describe actuator number i of the compiled model: what it drives, and its limits.

        MuJoCo calls what an actuator drives its transmission: a joint, a tendon, a site or others.
        """
        import mujoco

        model = self.compiled
        # Type of the transmission, and number of the joint, tendon or site.
        transmission, target = int(model.actuator_trntype[i]), int(model.actuator_trnid[i, 0])
        # The joint that it drives. The tendon of a coupled drive stands for the drive's own joint.
        joint = None
        if transmission in (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT)):
            joint = self.joints[target].name
        if self.coupled and transmission == int(mujoco.mjtTrn.mjTRN_TENDON):
            coupled_joint = model.tendon(target).name.removesuffix(COUPLING_TENDON_SUFFIX)
            joint = coupled_joint if coupled_joint in self.coupled else None
        # Address of its first control, and number of its controls. Before MuJoCo 4 each actuator
        # had one control.
        control, control_count = i, 1
        if hasattr(model, "actuator_ctrladr"):
            control, control_count = int(model.actuator_ctrladr[i]), int(model.actuator_ctrlnum[i])
        is_limited = control_count > 0 and bool(model.actuator_ctrllimited[control])
        # Whether it acts along an angle or a length; neither if its tendon moves joints of both
        # kinds.
        moved_joints = self._get_tendon_joints(i)
        motion = None
        if joint is not None:
            motion = self.joint(joint).motion
        elif transmission == int(mujoco.mjtTrn.mjTRN_TENDON):
            kinds = {self.joint(name).motion for name in moved_joints}
            if not kinds:
                motion = "slide"  # a spatial tendon has a length, and no joints of its own
            elif len(kinds) == 1:
                motion = kinds.pop()
        elif transmission == int(mujoco.mjtTrn.mjTRN_SITE):
            # The gear of a site has three components of a force, then three of a torque.
            motion = "slide" if model.actuator_gear[i, :3].any() else "hinge"
        return Actuator(
            name=model.actuator(i).name,
            id=i,
            joint=joint,
            kind=_detect_actuator_kind(model, i),
            range=_get_limit(model.actuator_ctrlrange[control], True) if is_limited else None,
            force=_get_limit(model.actuator_forcerange[i], bool(model.actuator_forcelimited[i])),
            control=control,
            controls=control_count,
            motion=motion,
            moves=moved_joints if joint is None else (),
        )

    def _get_tendon_joints(self, i: int) -> tuple[str, ...]:
        """Return the names of the joints of the fixed tendon that actuator number i drives.

        There are none if it drives something else, or a spatial tendon.
        """
        import mujoco

        model = self.compiled
        if int(model.actuator_trntype[i]) != int(mujoco.mjtTrn.mjTRN_TENDON):
            return ()
        # A tendon is a list of objects: joints for a fixed tendon, others for a spatial one.
        tendon = int(model.actuator_trnid[i, 0])
        first, count = int(model.tendon_adr[tendon]), int(model.tendon_num[tendon])
        wrap_indices = range(first, first + count)
        joint_type = int(mujoco.mjtWrap.mjWRAP_JOINT)
        joints = [
            int(model.wrap_objid[k]) for k in wrap_indices if int(model.wrap_type[k]) == joint_type
        ]
        return tuple(self.joints[joint].name for joint in joints)

    @cached_property
    def bodies(self) -> tuple[Body, ...]:
        """Bodies that joints move, directly or through other bodies.

        Their aliases are the links that are fused into them: MuJoCo merges links on fixed joints
        into one body.
        """
        model = self.compiled
        fused_names: dict[str, list[str]] = {}
        for alias, name in (self.aliases or {}).items():
            fused_names.setdefault(name, []).append(alias)
        moving_bodies = []
        for body_id in range(1, model.nbody):
            # Bodies welded to the world do not move; those welded to other bodies move with them.
            if int(model.body_weldid[body_id]) == 0:
                continue
            name, mass = model.body(body_id).name, float(model.body_mass[body_id])
            moving_bodies.append(Body(name, body_id, mass, tuple(fused_names.get(name, ()))))
        return tuple(moving_bodies)

    @cached_property
    def sensors(self) -> tuple[SensorRow, ...]:
        """Rows of all sensors; those of a sensor with several numbers end in their axis or number.

        Examples are ``force.x``, ``pose.w`` of a quaternion, and ``user.0``.
        """
        model = self.compiled
        rows = []
        for sensor_id in range(model.nsensor):
            name = model.sensor(sensor_id).name
            begin, count = int(model.sensor_adr[sensor_id]), int(model.sensor_dim[sensor_id])
            # Vectors and quaternions have axes, other numbers are counted.
            suffixes = {3: "xyz", 4: "wxyz"}.get(count) or map(str, range(count))
            name_endings = [""] if count == 1 else [f".{suffix}" for suffix in suffixes]
            unit = self._get_sensor_unit(sensor_id)
            rows += [SensorRow(name + end, begin + k, unit) for k, end in enumerate(name_endings)]
        return tuple(rows)

    def _get_sensor_unit(self, sensor: int) -> str:
        """Return the SI unit of a sensor by its number; ``1`` if the type does not determine it.

        Args:
            sensor: number of the sensor in the compiled model.
        """
        import mujoco

        model, sensor_types = self.compiled, mujoco.mjtSensor
        kind, object_id = int(model.sensor_type[sensor]), int(model.sensor_objid[sensor])
        if kind == int(sensor_types.mjSENS_JOINTPOS):
            return self.joints[object_id].unit
        if kind == int(sensor_types.mjSENS_JOINTVEL):
            return f"{self.joints[object_id].unit}/s"
        if kind in (int(sensor_types.mjSENS_JOINTACTFRC), int(sensor_types.mjSENS_JOINTLIMITFRC)):
            return self.joints[object_id].force_unit
        return _UNITS.get(kind, "1")

    def integrates(self, actuator: Actuator) -> bool:
        """Return whether an actuator integrates its control, such as ``intvelocity``."""
        import mujoco

        integrator = int(mujoco.mjtDyn.mjDYN_INTEGRATOR)
        return int(self.compiled.actuator_dyntype[actuator.id]) == integrator

    def joint(self, name: str) -> Joint:
        """Return the joint with a name.

        Raises:
            InputError: there is no such joint; the message lists the existing ones.
        """
        return self._find_by_name("joint", name, {joint.name: joint for joint in self.joints})

    def compute_servo_damping(self, actuator: Actuator) -> float:
        """Return the damping of its joint by a position servo, in N s/m or N m s/rad.

        Args:
            actuator: position servo of this robot.
        """
        model = self.compiled
        # The third bias parameter of MuJoCo's servo is minus its damping.
        return float(
            model.actuator_gear[actuator.id, 0] ** 2 * -model.actuator_biasprm[actuator.id, 2]
        )

    def actuator(self, name: str) -> Actuator:
        """Return the actuator with a name; errors as in `joint`."""
        return self._find_by_name("actuator", name, {a.name: a for a in self.actuators})

    def body(self, name: str) -> Body:
        """Return the body with a name, or the body into which a link with the name is fused.

        Raises:
            InputError: there is no such body; the message lists the existing ones.
        """
        bodies = {body.name: body for body in self.bodies}
        fused = (self.aliases or {}).get(name, name)
        return self._find_by_name("body", fused if fused in bodies else name, bodies)

    def _find_by_name(self, kind: str, name: str, elements: Mapping[str, _T]) -> _T:
        """Return an element of the robot by name.

        Args:
            kind: word for the element in the message, such as joint.
            name: name from the user.
            elements: all elements of this kind by name.

        Raises:
            InputError: the robot has no such element; the message lists the known names.
        """
        if name not in elements:
            raise make_unknown_name_error(
                f"{kind} of {self.path.name}", name, list(elements) or ["none"]
            )
        return elements[name]


def cache_per_robot(
    function: Callable[Concatenate[RobotModel, _P], _T],
) -> Callable[Concatenate[RobotModel, _P], _T]:
    """Cache the results of a function of a robot in the robot itself, by arguments (a decorator).

    The results are freed with the robot. A cache of the module would hold every model that a
    process has read.

    Args:
        function: function whose first argument is the robot; its other arguments must be hashable.
    """

    @wraps(function)
    def cached_function(robot: RobotModel, /, *args: _P.args, **kwargs: _P.kwargs) -> _T:
        """Return the result stored in the robot, or call the function and store its result.

        Args:
            robot: the robot with the cache.
            *args: further arguments.
            **kwargs: further arguments with names.
        """
        key = (function, *args, *kwargs.items())
        if key not in robot.function_cache:
            robot.function_cache[key] = function(robot, *args, **kwargs)
        result: _T = robot.function_cache[key]
        return result

    return cached_function


def _get_limit(values: Any, is_limited: bool) -> tuple[float, float] | None:
    return (float(values[0]), float(values[1])) if is_limited else None


def _detect_actuator_kind(model: Any, i: int) -> ActuatorKind:
    """Return the kind of an actuator from its gain and bias (MuJoCo's shortcuts).

    The force of an actuator with a constant gain g and an affine bias is
    g * control + b_0 + b_1 * position + b_2 * velocity. So it is

    * a motor without bias: g * control,
    * a position servo with b_1 = -g: g (control - position) + b_2 * velocity,
    * a velocity servo with b_2 = -g and b_1 = 0: g (control - velocity).

    Args:
        model: compiled model.
        i: number of the actuator.
    """
    import mujoco

    gain, bias = model.actuator_gainprm[i], model.actuator_biasprm[i]
    has_constant_gain = int(model.actuator_gaintype[i]) == int(mujoco.mjtGain.mjGAIN_FIXED)
    has_affine_bias = int(model.actuator_biastype[i]) == int(mujoco.mjtBias.mjBIAS_AFFINE)
    # A first-order filter before the actuator changes when a control acts, but not its meaning;
    # `filters` returns MuJoCo's numbers of the types of filters.
    dynamics = int(model.actuator_dyntype[i])
    keeps_meaning = dynamics == int(mujoco.mjtDyn.mjDYN_NONE) or dynamics in filters()
    pid = getattr(mujoco.mjtGain, "mjGAIN_PID", None)  # Available since MuJoCo 4.
    if pid is not None and int(model.actuator_gaintype[i]) == int(pid):
        return "pid"
    if not has_constant_gain or not keeps_meaning:
        return "other"
    if not has_affine_bias or not np.any(bias[:3]):
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


_UNITS: Mapping[int, str] = {
    0: "N",  # touch
    1: "m/s^2",  # accelerometer
    2: "m/s",  # velocimeter
    3: "rad/s",  # gyro
    4: "N",  # force
    5: "N*m",  # torque
    26: "m",  # frame position
    31: "m/s",  # frame linear velocity
    32: "rad/s",
    33: "m/s^2",
    34: "rad/s^2",
    35: "m",  # centre of mass of a subtree
    36: "m/s",
}
"""Units of sensors, by number of MuJoCo's mjtSensor.

Units of joint and actuator sensors depend on their joint.
"""
