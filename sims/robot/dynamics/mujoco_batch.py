"""Batch of MuJoCo simulations of one robot, with model fields for effects, and a cache of batches.

The fields of each batch element are initialised from the model file, and effects are written into
them. Fields from which MuJoCo derives others (masses) have a separate batch, so that simulations
without such a change keep exactly the constants of the file.

Run evaluators of one recording, of its segments and with smaller time steps have separate
simulators, whose batches would be equal. Each candidate with added elements needs its own model
and batches, and most candidates are requested only once.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from sims.core.effect import ActiveEffects
from sims.core.mujoco_import import disable_step_profiler
from sims.core.simulator import Array
from sims.robot.coupled_drives import COUPLING_FIELD
from sims.robot.dry_friction import write_friction_form
from sims.robot.dynamics.added_elements import AddedElements, add_elements
from sims.robot.dynamics.disabled_drives import (
    FORCE_FIELDS,
    ForceRanges,
    iterate_constant_stretches,
)
from sims.robot.dynamics.midpoint_state import IndexArray, Mask
from sims.robot.dynamics.series_joints import (
    USED_FIELDS,
    WRITTEN_FIELDS,
    compute_rest_positions,
    convert_flank_parameters,
    is_series_effect,
    write_series_effects,
)
from sims.robot.dynamics.servo_force_limits import ForceLimits, find_stiff_force_limits
from sims.robot.floating_joints import FloatingJoints, FloatingState
from sims.robot.integrator_settings import with_integrator_settings
from sims.robot.model_field_effects import CONTACT_FIELDS, MODEL_FIELD_EFFECTS, get_write_order
from sims.robot.model_simplification import strip_assets
from sims.robot.mujoco_messages import format_mujoco_error
from sims.robot.parsing.collision_filters import can_collide
from sims.robot.robot_model import RobotModel, cache_per_robot

BATCH_SIZE = 64
"""Batch size; the data of a larger batch exceed the processor cache."""
BATCH_SIZES = (1, 8, BATCH_SIZE)
"""Available batch sizes."""
MAX_UNINTERRUPTED_STEPS = 40_000
"""Maximum number of steps, summed over batch elements, in one call.

A call then takes a fraction of a second, after which Ctrl-C is handled.
"""


class JointAddresses:
    """Addresses of joints with one coordinate in MuJoCo's vectors.

    Attributes:
        positions: (D,) addresses in qpos.
        velocities: (D,) addresses in qvel.
    """

    def __init__(self, robot: RobotModel, series: bool = False, both: bool = False) -> None:
        """Collect the addresses of hinges and slides: by default, those of the robot's model file.

        Args:
            robot: robot whose compiled model has the joints.
            series: select the joints that effects have added in series with others instead, such as
                the second joints of flexible drives.
            both: select the joints of the file, followed by those in series.
        """
        series_joints = tuple(robot.joint(name) for name in robot.series)
        if both:
            joints = robot.file_joints + series_joints
        elif series:
            joints = series_joints
        else:
            joints = robot.file_joints
        self.positions: IndexArray = np.array([j.position for j in joints], dtype=np.intp)
        self.velocities: IndexArray = np.array([j.velocity for j in joints], dtype=np.intp)


DRIVE_SENSOR_PREFIX = "simgap.drive."
"""Prefix of the names of sensors that are added to a model."""


GRAVCOMP_PLACEHOLDER = 1e-200
"""Gravity compensation that changes no force, since it is smaller than any rounding error."""


def make_batch_spec(robot: RobotModel) -> Any:
    """Make a mujoco.MjSpec with which masses and centres of mass can differ between batch elements.

    MuJoCo stores less for a body that turns about its centre of mass (a simple body), and then
    rejects changes of its centre of mass; it also omits gravity compensation that is zero in the
    file. Here no body counts as simple, and gravity compensation is always computed. The motion is
    the same.

    Args:
        robot: robot whose spec is copied.
    """
    spec = robot.spec.copy()
    for body in spec.bodies:
        body.simple = False
    # MuJoCo computes no gravity compensation if no body of the compiled model has any. So one body
    # gets a compensation that is too small to change a force.
    if not any(body.gravcomp for body in spec.bodies):
        spec.bodies[-1].gravcomp = GRAVCOMP_PLACEHOLDER
    return spec


def compile_batch_model(robot: RobotModel, derived: bool) -> Any:
    """Compile the model of a batch, with a sensor of the actuator force on each joint of the file.

    A sensor shows the force at the beginning of a step for every integrator. The field
    `qfrc_actuator` of MuJoCo's data has the force of the integrator's last evaluation instead.

    Args:
        robot: robot to simulate.
        derived: whether masses and centres of mass differ between batch elements, so that MuJoCo
            derives constants from them again.
    """
    import mujoco

    spec = make_batch_spec(robot) if derived else robot.spec.copy()
    # The compiled callback of effect forces finds its simulation by the user data.
    spec.nuserdata = max(spec.nuserdata, 1)
    for joint in robot.file_joints:
        spec.add_sensor(
            name=DRIVE_SENSOR_PREFIX + joint.name,
            type=mujoco.mjtSensor.mjSENS_JOINTACTFRC,
            objtype=mujoco.mjtObj.mjOBJ_JOINT,
            objname=joint.name,
        )
    return robot.compile(spec)


def find_drive_sensors(model: Any, robot: RobotModel) -> dict[str, int]:
    """Return the addresses of actuator forces in the sensor data of a batch model, by joint.

    Args:
        model: model of `compile_batch_model`, which has the sensors.
        robot: robot of this model.

    Returns:
        Column in the sensor data by name of the joint, for all joints of the file.
    """
    return {
        joint.name: int(model.sensor(DRIVE_SENSOR_PREFIX + joint.name).adr[0])
        for joint in robot.file_joints
    }


class MujocoBatch:
    """Batch of simulations of a robot.

    Attributes:
        fields: present model fields of the batch elements, (N, ...) by name.
        batch: the mujoco.batch.Batch.
        file_joints: addresses of the joints of the robot's file.
        series_joints: addresses of the joints in series with them.
        all_joints: addresses of all these joints, in this order.
        floating: free and ball joints.
        drives: columns of the sensor data with actuator forces, by joint.
    """

    def __init__(
        self,
        robot: RobotModel,
        derived: bool,
        settings: Mapping[str, float],
        count: int = BATCH_SIZE,
    ) -> None:
        """Compile the model, create MuJoCo's batch, and expand the model fields that effects write.

        Expanded fields (numbers of the model, such as masses) have separate values for each batch
        element, so that each simulates other effects. Only fields that effects can write are
        expanded.

        Args:
            robot: robot to simulate.
            derived: whether masses or armatures change, from which MuJoCo derives constants.
            settings: options of the model by name, such as timestep (seconds).
            count: batch size.
        """
        import mujoco
        from mujoco import batch

        disable_step_profiler()
        # Fields that effects write depend on the time step, so it is set first.
        self.robot = robot = with_integrator_settings(robot, settings)
        self.derived = derived
        self.count = count
        self.file_joints = JointAddresses(robot)
        self.series_joints = JointAddresses(robot, series=True)
        self.all_joints = JointAddresses(robot, both=True)
        self.floating = FloatingJoints.from_robot(robot)
        model = compile_batch_model(robot, derived)
        # A failed simulation must become NaN; an automatic reset by MuJoCo would hide the failure.
        model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
        if not can_collide(model):
            # Collision detection without possible contacts takes a third of a step of one joint.
            model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
        self.drives = find_drive_sensors(model, robot)
        # All elements are simulated by one thread.
        self.batch: Any = batch.Batch(model, count, 1)
        field_names = {
            field
            for field_effect in MODEL_FIELD_EFFECTS.values()
            if derived or not field_effect.changes_derived_constants
            for field in field_effect.fields
        }
        # Some fields belong to elements that effects add, and exist only in a model with these:
        # joints in series, tendons of coupled drives, and pairs of geoms.
        if robot.series:
            field_names |= set(USED_FIELDS)
        if not robot.coupled:
            field_names -= {COUPLING_FIELD}
        if not model.npair:
            field_names -= CONTACT_FIELDS
        self.fields: dict[str, Any] = {
            name: self.batch.expand(name) for name in sorted(field_names)
        }
        # The values of the model file are restored before other effects are written.
        self._file_values = {name: values[:1].copy() for name, values in self.fields.items()}
        # Fields that differ from the file since effects were written, or changed afterwards.
        self._changed_fields: set[str] = set()
        # Effects in the fields; None if the fields have been changed since they were written.
        self._written_effects: tuple[tuple[str, bytes], ...] | None = None

    @property
    def model(self) -> Any:
        """The mujoco.MjModel that the batch elements share, except for their fields."""
        return self.batch.model

    @cached_property
    def force_limits(self) -> ForceLimits:
        """Force limits of stiff servos."""
        return find_stiff_force_limits(self.model)

    @property
    def nbytes(self) -> int:
        """Memory in bytes of the batch's model, and of its elements' fields and states."""
        own = [*self.fields.values(), *self._file_values.values(), self.batch.state]
        return int(self.model.nbuffer + sum(values.nbytes for values in own))

    def write_effects(self, acting: ActiveEffects) -> None:
        """Write effects that are numbers of MuJoCo's model, such as masses, into its fields.

        Nothing is done if the fields have these effects already. Otherwise the steps are:

        1. Restore the values of the file in the fields that former effects changed.
        2. Write the effects in a fixed order, since some depend on others.
        3. Let MuJoCo recompute the constants that it derives from the changed fields.

        Args:
            acting: effects with K coefficients for each of the N batch elements, (K, N, 1).
        """
        written_effects = tuple((effect.name, c.tobytes()) for effect, c in acting)
        if written_effects == self._written_effects:
            return
        # 1. Values of the file. Constants that were derived from other values are not valid then.
        for name in self._changed_fields:
            self.fields[name][...] = self._file_values[name]
        needs_constants = bool(self.robot.series) or any(
            self._needs_recomputed_constants(name) for name in self._changed_fields
        )
        self._changed_fields.clear()
        # 2. Effects; those in series with joints are written together.
        for effect, c in sorted(acting, key=lambda pair: get_write_order(pair[0].of)):
            if not c.any() or is_series_effect(effect):
                continue
            # An effect at one place has the name of the registered effect in `of`.
            field_effect = MODEL_FIELD_EFFECTS[effect.of or effect.name]
            field_effect.write(self.fields, self.robot, effect.place, c[:, :, 0])
            self._changed_fields.update(field_effect.fields)
            needs_constants = needs_constants or field_effect.changes_derived_constants
        if self.robot.series:
            # This follows the armature effects, since each drive takes its share of the armature.
            write_series_effects(self.fields, self.robot, acting)
            self._changed_fields.update(WRITTEN_FIELDS)
        # 3. Derived constants.
        if needs_constants:
            elements_are_equal = all((c == c[:, :1]).all() for _, c in acting)
            self._recompute_constants(elements_are_equal)
        if self.robot.series:
            # Parameters of compliant flanks depend on the derived inverse inertia.
            convert_flank_parameters(self.fields, self.robot)
        # Dry friction of the model, to which `set_dry_friction` adds that of other effects.
        self._model_friction = self.fields["dof_frictionloss"].copy()
        self._written_effects = written_effects

    def _recompute_constants(self, elements_are_equal: bool) -> None:
        """Let MuJoCo recompute the constants that it derives from the changed fields.

        If all batch elements are equal, it does so for the first one, whose fields are copied.

        Args:
            elements_are_equal: whether all elements have the same effects, so that the constants of
                one are those of all.
        """
        from mujoco.batch import MODEL_FIELDS

        # MuJoCo before 4.0, the newest for Python 3.10, does not tell which fields are expanded.
        if not elements_are_equal or not hasattr(self.batch, "expanded"):
            self.batch.set_const()
            return
        self.batch.set_const([0])
        # An expanded field has a row for each batch element; all others are common to them.
        for name in MODEL_FIELDS:
            if self.batch.expanded(name) is not None:
                values = self.batch.expand(name)
                values[1:] = values[:1]

    def _mark_changed(self, field_names: Iterable[str]) -> None:
        """Record that fields are changed after effects were written; the next write resets them."""
        self._changed_fields.update(field_names)
        self._written_effects = None

    @staticmethod
    def _needs_recomputed_constants(field: str) -> bool:
        """Return whether MuJoCo must recompute derived constants after the named field changed.

        An example is ``body_mass``, from which MuJoCo derives the inverse weights of bodies and
        joints.

        Args:
            field: name of a field of the model.
        """
        return any(
            field in field_effect.fields and field_effect.changes_derived_constants
            for field_effect in MODEL_FIELD_EFFECTS.values()
        )

    def set_initial_state(
        self, positions: Array, velocities: Array, floating_state: FloatingState
    ) -> tuple[Array, Array]:
        """Set the initial states of the first n batch elements.

        Recordings do not contain the state of joints in series, such as the deflection of a
        flexible gear. So they rest at the equilibrium of the links while the drives are held.

        Args:
            positions: (n, D) positions of the D joints of the file.
            velocities: (n, D) velocities of the joints of the file.
            floating_state: poses and velocities of floating bodies.

        Returns:
            Initial positions and velocities (n, H) of the H joints in series; the velocities are
            zero.
        """
        self.batch.reset(stage=0)
        qpos, qvel = self.batch.bind("qpos"), self.batch.bind("qvel")
        element_count = len(positions)
        qpos[:element_count, self.file_joints.positions] = positions
        qvel[:element_count, self.file_joints.velocities] = velocities
        qpos[:element_count, self.floating.positions] = floating_state.pose
        qvel[:element_count, self.floating.velocities] = floating_state.rate
        series = self.series_joints
        series_positions = np.zeros((element_count, series.positions.size))
        if series_positions.size:
            # The load on a joint in series is that of springs, dampers, gravity and motion. MuJoCo
            # subtracts the bias forces of gravity and motion.
            passive, bias = self.batch.bind("qfrc_passive"), self.batch.bind("qfrc_bias")
            self.batch.forward(self.get_element_ids(element_count))
            loads = (passive - bias)[:element_count, series.velocities].T
            series_positions[:] = np.stack(
                compute_rest_positions(self.fields, self.robot, list(loads)), axis=1
            )
            qpos[:element_count, series.positions] = series_positions
        return series_positions, np.zeros_like(series_positions)

    def map_forces(self, forces: Array) -> Array:
        """Map generalised forces (..., nv) of the file's model to this batch's model.

        The model of the batch may have further joints in series, on which no force acts. The result
        has a column for each degree of freedom of this model.
        """
        if self.model.nv == forces.shape[-1]:
            return forces
        # Degrees of freedom of the file, in the same order as in the file's model.
        file_dofs = np.setdiff1d(np.arange(self.model.nv), self.series_joints.velocities)
        result = np.zeros((*forces.shape[:-1], self.model.nv))
        result[..., file_dofs] = forces
        return result

    def activate(self, activations: Array) -> None:
        """Set the initial activations (n, na) of the first n batch elements."""
        if self.model.na:
            self.batch.bind("act")[: len(activations)] = activations

    def step(
        self,
        controls: Array,
        forces: Array,
        record: Sequence[str],
        off: Mask | None = None,
        before_call: Callable[[int], None] | None = None,
        steps_per_call: int | None = None,
    ) -> dict[str, Array]:
        """Step n batch elements S times with given controls and forces.

        Failed elements are marked in `failed`; their recorded numbers have no meaning.

        Args:
            controls: (n, S, nu) controls.
            forces: (n, S, nv) generalised forces.
            record: fields of MuJoCo's data to record.
            off: (n, S, K) whether each of K actuators is switched off; none is by default.
            before_call: called with the number of the first step of each call of MuJoCo; it may
                change `forces` of the steps that follow, as a callback may.
            steps_per_call: number of steps in one call of MuJoCo; as many as can be interrupted
                after a fraction of a second if None.

        Returns:
            Recorded fields (n, S, ...) by name.
        """
        import mujoco

        # `input_kinds` tells MuJoCo of which parts its inputs consist: controls, and forces if any.
        state = mujoco.mjtState
        input_kinds = int(state.mjSTATE_CTRL)
        applies_forces = before_call is not None or bool(forces.any())
        if applies_forces:
            input_kinds |= int(state.mjSTATE_QFRC_APPLIED)
        batch_size, steps, _ = controls.shape
        records = self._allocate_records(batch_size, steps, record)
        steps_per_call = steps_per_call or max(MAX_UNINTERRUPTED_STEPS // max(batch_size, 1), 1)
        for steps_without_switch in self._split_at_switches(steps, off, steps_per_call):
            if before_call is not None:
                before_call(steps_without_switch.start)
            inputs = controls[:, steps_without_switch]
            if applies_forces:
                inputs = np.concatenate([inputs, forces[:, steps_without_switch]], axis=2)
            recorded = self.batch.rollout(
                steps_without_switch.stop - steps_without_switch.start,
                inputs,
                input_kinds,
                tuple(record),
                self.get_element_ids(batch_size),
            )
            for name, values in recorded.items():
                records[name][:, steps_without_switch] = values
        self._record_failures(batch_size)
        return records

    def _split_at_switches(
        self, steps: int, off: Mask | None, steps_per_call: int
    ) -> Iterator[slice]:
        """Yield the steps in consecutive parts, and switch actuators on or off before each part.

        Within a part no switch changes, so that MuJoCo makes its steps in one call. An actuator is
        switched off by a force range of zero. At the end all are switched on.

        Args:
            steps: number S of steps.
            off: (n, S, K) which of the K actuators are off in n batch elements; None if all are on.
            steps_per_call: maximum number of steps in a part.
        """
        ranges = None
        stretches: Iterable[slice] = [slice(0, steps)]
        if off is not None and off.any():
            ranges, stretches = self.force_ranges(), iterate_constant_stretches(off)
        for stretch in stretches:
            # The switches at the first step of a stretch hold for all of its steps.
            if ranges is not None and off is not None:
                ranges.write(off[:, stretch.start])
            for begin in range(stretch.start, stretch.stop, steps_per_call):
                yield slice(begin, min(begin + steps_per_call, stretch.stop))
        if ranges is not None:
            ranges.restore()

    def force_ranges(self) -> ForceRanges:
        """Return the force ranges, to switch actuators off until the next `write_effects`."""
        self._mark_changed(FORCE_FIELDS)
        return ForceRanges(self.fields)

    def get_servo_stiffness(self, joints: JointAddresses) -> Array:
        """Return the force of position servos per unit of their errors, with the written effects.

        Args:
            joints: addresses of D joints.

        Returns:
            (N, D) stiffness in all N batch elements, the force on the joint per unit of the set
            point's error; zero for joints without a position servo. Several servos at one joint are
            added up.
        """
        robot = self.robot
        stiffness = np.zeros((self.count, len(joints.velocities)))
        # Column of the result, by the address of the joint's velocity in qvel.
        column_of_address = {int(address): i for i, address in enumerate(joints.velocities)}
        for actuator in robot.actuators:
            if actuator.kind == "position" and actuator.joint is not None:
                gear = float(robot.compiled.actuator_gear[actuator.id, 0])
                gain = self.fields["actuator_gainprm"][:, actuator.id, 0]
                column = column_of_address[robot.joint(actuator.joint).velocity]
                stiffness[:, column] += gear * gain
        return stiffness

    def set_dry_friction(self, n: int, dof: int, limit: Array) -> None:
        """Set the dry friction at one joint of the first n batch elements.

        It is the friction of the model with the effects that are written into it, plus `limit`.
        So a limit of an earlier call is replaced.

        Args:
            n: number of batch elements.
            dof: index of the joint's velocity.
            limit: (n,) friction limits to add, N or N m.
        """
        self.fields["dof_frictionloss"][:n, dof] = self._model_friction[:n, dof] + limit
        self.prepare_dry_friction(slice(n), dof)

    def prepare_dry_friction(self, batch_indices: Any, dofs: Any) -> None:
        """Set the solver parameters of dry friction at the joints where effects add it.

        At all others, the file's friction keeps its solver parameters. The next `write_effects`
        restores all of them.

        Args:
            batch_indices: NumPy index of the batch elements.
            dofs: NumPy index of the joints' velocities.
        """
        # These are the fields of dry friction, whatever the effect.
        self._mark_changed(MODEL_FIELD_EFFECTS["friction.coulomb"].fields)
        write_friction_form(self.fields, self.robot, batch_indices, dofs)

    def _allocate_records(self, n: int, steps: int, record: Sequence[str]) -> dict[str, Array]:
        """Allocate an array (n, steps, ...) for each field of MuJoCo's data to record, by name."""
        return {name: np.empty((n, steps, *self.batch.bind(name).shape[1:])) for name in record}

    def get_element_ids(self, n: int) -> IndexArray | None:
        """Return the indices of the first n elements; None stands for all of them."""
        return None if n == self.count else np.arange(n)

    def _record_failures(self, n: int) -> None:
        """Record which batch elements have failed: MuJoCo no longer moves those with a warning."""
        self.failed = (self.batch.warning[:n, :, 1] > 0).any(axis=1)


CACHE_BYTES = 96 << 20
"""Maximum memory of models with added elements, in bytes.

Beyond it the least recently used models are dropped. The robot's original model does not count.
"""


class RefusedModelError(Exception):
    """MuJoCo cannot compile a model with added elements; states the effects and the reason."""


@dataclass
class _Variant:
    """A robot with added elements, and its batches by options, kind and size."""

    robot: RobotModel
    batches: dict[tuple[object, ...], MujocoBatch] = field(default_factory=dict)

    @property
    def nbytes(self) -> int:
        """Memory of the models and of the batch elements' own fields, in bytes."""
        # The compiled model of the robot counts twice, since its spec takes about as much memory.
        size = 2 * int(self.robot.compiled.nbuffer)
        return size + sum(mujoco_batch.nbytes for mujoco_batch in self.batches.values())


class BatchCache:
    """Cache of batches by the added elements, the options of the model, and the batch size."""

    def __init__(self, robot: RobotModel, limit: int = CACHE_BYTES) -> None:
        """Start with the robot's own model and no batch; batches are made on first request.

        Parts of the model without influence on the motion, such as textures, are removed here, so
        that batches take less memory.

        Args:
            robot: robot as read from its model file.
            limit: maximum memory in bytes, see `CACHE_BYTES`.
        """
        self._limit = limit
        # The robot's own model, and those with added elements, with the last used one at the end.
        self._own = _Variant(strip_assets(robot))
        self._extended: dict[AddedElements, _Variant] = {}
        # Reasons why MuJoCo rejects a model, by the added elements.
        self._refused: dict[AddedElements, str] = {}

    @property
    def batches(self) -> list[MujocoBatch]:
        """All cached batches."""
        variants = [self._own, *self._extended.values()]
        return [mujoco_batch for variant in variants for mujoco_batch in variant.batches.values()]

    def get_batch(
        self, added: AddedElements, derived: bool, count: int, settings: Mapping[str, float]
    ) -> MujocoBatch:
        """Return a batch of simulations from the cache, or create it.

        Creating a batch compiles the model, which takes much longer than a simulation. A model that
        MuJoCo rejects is not compiled again: the reason is stored, and printed once.

        Args:
            added: elements that effects add to the model, as pairs of place and effect.
            derived: whether masses or armatures change, from which MuJoCo derives constants.
            count: number of batch elements.
            settings: options of the model by name, such as ``timestep``.

        Raises:
            RefusedModelError: MuJoCo cannot compile the model with these added elements.
        """
        if added in self._refused:
            raise RefusedModelError(self._refused[added])
        key = (derived, count, *settings.items())
        try:
            variant = self._get_variant(added)
            if key not in variant.batches:
                variant.batches[key] = MujocoBatch(variant.robot, derived, settings, count)
                self._evict_unused_variants()
            return variant.batches[key]
        except ValueError as error:
            # The robot's own model has compiled when its file was read, so this error has another
            # cause.
            if not added:
                raise
            effects = ", ".join(f"{effect}@{place}" if place else effect for place, effect in added)
            reason = f"{effects}: MuJoCo does not compile the model: {format_mujoco_error(error)}"
            self._refused[added] = reason
            sys.stderr.write(f"simgap: not simulated: {reason}\n")
            raise RefusedModelError(reason) from None

    def _get_variant(self, added: AddedElements) -> _Variant:
        """Return the robot with added elements and its batches, and mark it as most recently used.

        Without added elements, this is the robot's own model, which is never dropped from
        the cache. Otherwise it is made if the cache does not have it.

        Args:
            added: the elements, as pairs of place and effect.
        """
        if not added:
            return self._own
        # The dictionary is ordered by last use: the variant is taken out, and goes to the end.
        variant = self._extended.pop(added, None) or _Variant(add_elements(self._own.robot, added))
        self._extended[added] = variant
        return variant

    def _evict_unused_variants(self) -> None:
        """Drop the least recently used models with added elements, until the limit of memory holds.

        The last one is in use, and stays.
        """
        sizes = {added: variant.nbytes for added, variant in self._extended.items()}
        for added in list(sizes)[:-1]:
            if sum(sizes.values()) <= self._limit:
                break
            del self._extended[added], sizes[added]


@cache_per_robot
def get_batch_cache(robot: RobotModel) -> BatchCache:
    """Return the batch cache of a robot, which is stored with the robot."""
    return BatchCache(robot)
