"""Many lanes of one robot in MuJoCo: `mujoco.batch.Batch`, with the model fields that effects
write.

A lane's fields begin as the file states them; what acts in the lane is written into them. Fields
from which MuJoCo derives others (masses) go into a batch of their own, so that lanes without such a
change keep the very constants of the file.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any, Protocol

import numpy as np

from sims.base import Array
from sims.robot import contacts
from sims.robot.floating import Afloat, Floating
from sims.robot.force_limits import ForceLimits, stiff_force_limits
from sims.robot.midway import Look, Mask, Midway, Places
from sims.robot.model import Robot
from sims.robot.native import COUPLING, FIELDS, lanes_spec, write_friction_form
from sims.robot.series import FIELDS as SERIES
from sims.robot.series import WRITTEN, hung, is_series, press
from sims.robot.series import write as in_series
from sims.robot.switched_off import FORCE_FIELDS, ForceRanges, constant_stretches
from sims.system import Acting

LANES = 64
"""Of a batch: of more, what is held for them leaves the processor's cache."""
SIZES = (1, 8, LANES)
"""Lanes that a batch is made for."""
INTERRUPTED = 40_000
"""Steps of all lanes together in one call: a fraction of a second, after which Ctrl-C is heard."""


class Addresses:
    """Where the joints of one coordinate stand in MuJoCo's vectors.

    Attributes:
        positions: (D,) in qpos.
        velocities: (D,) in qvel.

    Args:
        robot: whose.
        series: which joints: those of the robot's file, or those put in series with them.
        both: or those of the file, then those in series.
    """

    def __init__(self, robot: Robot, series: bool = False, both: bool = False) -> None:
        singles = [joint for joint in robot.joints if joint.single]
        own = [joint for joint in singles if joint.name not in robot.series]
        second = [robot.joint(name) for name in robot.series]
        joints = [*own, *second] if both else second if series else own
        self.positions: Places = np.array([j.position for j in joints], dtype=np.intp)
        self.velocities: Places = np.array([j.velocity for j in joints], dtype=np.intp)


class Asked(Protocol):
    """Effects that are asked for their forces in every step, as `sims.robot.forces.Forces`."""

    rubs: Mask
    addresses: Addresses
    loaded: Mask

    def at(self, k: int, look: Look) -> tuple[Array, Array]:
        """Forces and limits of dry friction over step k."""
        ...


DRIVE = "simgap.drive."
"""Beginning of the names of sensors that are added to a model."""


def read_model(robot: Robot, derived: bool) -> Any:
    """The compiled model of lanes, with a sensor of what actuators exert on each joint.

    A sensor shows the instant at which a step begins, whatever the integrator; MuJoCo's data would
    show the last of the instants that it looked at.

    Args:
        robot: whose.
        derived: whether masses and centres of mass change lane by lane.
    """
    import mujoco

    spec = lanes_spec(robot) if derived else robot.spec.copy()
    for joint in robot.joints:
        if joint.single and joint.name not in robot.series:
            spec.add_sensor(
                name=DRIVE + joint.name,
                type=mujoco.mjtSensor.mjSENS_JOINTACTFRC,
                objtype=mujoco.mjtObj.mjOBJ_JOINT,
                objname=joint.name,
            )
    return robot.compile(spec)


def drives(model: Any, robot: Robot) -> dict[str, int]:
    """Where in its sensors' data a model of lanes has what actuators exert, by joint."""
    own = [joint.name for joint in robot.joints if joint.single]
    singles = [name for name in own if name not in robot.series]
    return {name: int(model.sensor(DRIVE + name).adr[0]) for name in singles}


def stepped(robot: Robot, settings: Mapping[str, float]) -> Robot:
    """The robot with options of its model other than the file's; itself where they are the same."""
    option = robot.compiled.opt
    if all(getattr(option, name) == value for name, value in settings.items()):
        return robot
    spec = robot.spec.copy()
    for name, value in settings.items():
        setattr(spec.option, name, value)
    return replace(robot, spec=spec)


class Bench:
    """Up to `LANES` simulations of a robot side by side.

    Attributes:
        fields: model fields of the lanes, (LANES, ...) by name, as they are.
        batch: the mujoco.batch.Batch.
        places: addresses of the joints of the robot's file.
        second: those of joints in series with them.
        whole: all of these, in this order.
        floating: bodies that float or turn on balls.
        drives: columns of the sensors' data that show what actuators exert, by joint.

    Args:
        robot: whose.
        derived: whether masses or armatures change, from which MuJoCo derives constants.
        settings: of the options: timestep (seconds), integrator (its number).
        count: how many lanes there are.
    """

    def __init__(
        self, robot: Robot, derived: bool, settings: Mapping[str, float], count: int = LANES
    ) -> None:
        import mujoco
        from mujoco import batch

        # What effects write hangs on the step: they shall find the one that is made.
        self.robot = robot = stepped(robot, settings)
        self.derived = derived
        self.count = count
        self.places, self.second = Addresses(robot), Addresses(robot, series=True)
        self.whole = Addresses(robot, both=True)
        self.floating = Floating.of(robot)
        model = read_model(robot, derived)
        # A lane that fails must be NaN: MuJoCo would reset it, and it would pass for done.
        model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
        if not contacts.possible(model):
            # Looking for what cannot be is a third of a step of one joint.
            model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
        self.drives = drives(model, robot)
        self.batch: Any = batch.Batch(model, count, 1)
        names = {
            field
            for native in FIELDS.values()
            if derived or not native.derived
            for field in native.fields
        }
        names |= set(SERIES) if robot.series else set()
        names -= set() if robot.coupled else {COUPLING}
        self.fields: dict[str, Any] = {name: self.batch.expand(name) for name in sorted(names)}
        self._stated = {name: values[:1].copy() for name, values in self.fields.items()}
        self._changed: set[str] = set()

    @property
    def model(self) -> Any:
        """The mujoco.MjModel that lanes share but for their fields."""
        return self.batch.model

    @cached_property
    def force_limits(self) -> ForceLimits:
        """Force limits of stiff servos."""
        return stiff_force_limits(self.model)

    @property
    def nbytes(self) -> int:
        """Bytes of the model that the batch copies, and of the lanes' own fields and states."""
        own = [*self.fields.values(), *self._stated.values(), self.batch.state]
        return int(self.model.nbuffer + sum(values.nbytes for values in own))

    def load(self, acting: Acting) -> None:
        """Write the native effects, with coefficients (K, LANES, 1), into the lanes' fields."""
        for name in self._changed:
            self.fields[name][...] = self._stated[name]
        was_derived = any(self._derives(name) for name in self._changed)
        self._changed.clear()
        derives = was_derived or bool(self.robot.series)
        for effect, c in acting:
            if not c.any() or is_series(effect):
                continue
            native = FIELDS[effect.of or effect.name]
            native.write(self.fields, self.robot, effect.place, c[:, :, 0])
            self._changed.update(native.fields)
            derives = derives or native.derived
        if self.robot.series:
            # After the armatures, of which each takes its own part.
            in_series(self.fields, self.robot, acting)
            self._changed.update(WRITTEN)
        if derives:
            self.batch.set_const()
        if self.robot.series:
            press(self.fields, self.robot)
        self._loaded_friction = self.fields["dof_frictionloss"].copy()

    @staticmethod
    def _derives(field: str) -> bool:
        return any(field in native.fields and native.derived for native in FIELDS.values())

    def begin(self, positions: Array, velocities: Array, afloat: Afloat) -> tuple[Array, Array]:
        """Put the lanes at their initial states, (n, D) each, of the file's joints, and of what
        floats; returns where joints in series begin (n, H): where the links hang while their drives
        are held.
        """
        self.batch.reset(stage=0)
        qpos, qvel = self.batch.bind("qpos"), self.batch.bind("qvel")
        n = len(positions)
        qpos[:n, self.places.positions] = positions
        qvel[:n, self.places.velocities] = velocities
        qpos[:n, self.floating.positions] = afloat.pose
        qvel[:n, self.floating.velocities] = afloat.rate
        second = self.second
        begun = np.zeros((n, second.positions.size))
        if begun.size:
            passive, bias = self.batch.bind("qfrc_passive"), self.batch.bind("qfrc_bias")
            self.batch.forward(self._ids(n))
            pulls = (passive - bias)[:n, second.velocities].T
            begun[:] = np.stack(hung(self.fields, self.robot, list(pulls)), axis=1)
            qpos[:n, second.positions] = begun
        return begun, np.zeros_like(begun)

    def spread(self, forces: Array) -> Array:
        """Generalised forces (..., nv) of the file's model as this one has them."""
        if self.model.nv == forces.shape[-1]:
            return forces
        own = np.setdiff1d(np.arange(self.model.nv), self.second.velocities)
        result = np.zeros((*forces.shape[:-1], self.model.nv))
        result[..., own] = forces
        return result

    def activate(self, activations: Array) -> None:
        """Put the actuators of n lanes at their first activations (n, na)."""
        if self.model.na:
            self.batch.bind("act")[: len(activations)] = activations

    def run(
        self, controls: Array, forces: Array, record: Sequence[str], off: Mask | None = None
    ) -> dict[str, Array]:
        """Step n lanes S times.

        Args:
            controls: (n, S, nu).
            forces: (n, S, nv) generalised forces.
            record: fields of MuJoCo's data.
            off: (n, S, K) which actuators are switched off.

        Returns:
            What is recorded, (n, S, ...) by name.
        """
        import mujoco

        state = mujoco.mjtState
        spec = int(state.mjSTATE_CTRL)
        given = controls
        if forces.any():
            spec |= int(state.mjSTATE_QFRC_APPLIED)
            given = np.concatenate([controls, forces], axis=2)
        n, steps, _ = controls.shape
        result = self._begun(n, steps, record)
        for part in self._switched(n, steps, off):
            done = self.batch.rollout(
                part.stop - part.start, given[:, part], spec, tuple(record), self._ids(n)
            )
            for name, values in done.items():
                result[name][:, part] = values
        self._fails(n)
        return result

    def _switched(self, n: int, steps: int, off: Mask | None) -> Iterator[slice]:
        """Yield the parts of `_parts` after another, with actuators that are off switched off."""
        if off is None or not off.any():
            yield from self._parts(n, steps)
            return
        ranges = self.force_ranges()
        for stretch in constant_stretches(off):
            ranges.write(off[:, stretch.start])
            for part in self._parts(n, stretch.stop - stretch.start):
                yield slice(stretch.start + part.start, stretch.start + part.stop)
        ranges.restore()

    def force_ranges(self) -> ForceRanges:
        """Return the force ranges of the lanes, to switch actuators off until they are loaded
        again.
        """
        self._changed.update(FORCE_FIELDS)
        return ForceRanges(self.fields)

    def ask(
        self,
        controls: Array,
        forces: Array,
        asking: Asked,
        record: Sequence[str],
        off: Mask | None = None,
    ) -> dict[str, Array]:
        """The same where effects are asked for their forces in every step.

        Args:
            controls: as in `run`.
            forces: likewise.
            asking: the effects.
            record: likewise.
            off: likewise.
        """
        n, steps, _ = controls.shape
        dofs = asking.addresses.velocities
        bind = self.batch.bind
        ctrl, applied = bind("ctrl"), bind("qfrc_applied")
        loss = self.fields["dof_frictionloss"]
        own = loss[:n, dofs].copy()
        rubs = bool(asking.rubs.any())
        if rubs:
            # Where no effect adds friction, that of the file keeps its solver parameters.
            lanes, joints = np.nonzero(asking.rubs)
            write_friction_form(self.fields, self.robot, lanes, dofs[joints])
            self._changed.update(FIELDS["friction.coulomb"].fields)
        result = self._begun(n, steps, record)
        shown = {name: bind(name)[:n] for name in record}
        ids = self._ids(n)
        # Before MuJoCo looks for the first time: what is bound later would not show it.
        lanes_at = Midway(self.batch, asking.addresses.positions, dofs, asking.loaded)
        changes: Mask = np.any(np.diff(controls, axis=1, prepend=controls[:, :1]) != 0, axis=2)
        of = lanes_at.of
        ctrl[:n] = controls[:, 0]
        switches = (
            {}
            if off is None or not off.any()
            else {stretch.start: off[:, stretch.start] for stretch in constant_stretches(off)}
        )
        ranges = self.force_ranges() if switches else None
        if ranges is not None:
            ranges.write(switches[0])
        self.batch.forward(ids)
        for k in range(steps):
            ctrl[:n] = controls[:, k]
            if ranges is not None and k in switches:
                ranges.write(switches[k])
                changes[:, k] = True
            force, limit = asking.at(k, lanes_at.look(changes[:, k]))
            applied[:n] = forces[:, k]
            applied[:n, of] += force
            if rubs:
                loss[:n, of] = own + np.maximum(limit, 0.0)
            self.batch.step(ids)
            for name, values in result.items():
                values[:, k] = shown[name]
        if ranges is not None:
            ranges.restore()
        self._fails(n)
        return result

    def stiffness(self, places: Addresses) -> Array:
        """(LANES, D) what position servos exert for each unit of their errors, as the lanes are
        loaded; zero of joints without one.
        """
        robot = self.robot
        result = np.zeros((self.count, len(places.velocities)))
        columns = {int(place): i for i, place in enumerate(places.velocities)}
        for actuator in robot.actuators:
            if actuator.kind == "position" and actuator.joint is not None:
                gear = float(robot.compiled.actuator_gear[actuator.id, 0])
                gain = self.fields["actuator_gainprm"][:, actuator.id, 0]
                result[:, columns[robot.joint(actuator.joint).velocity]] += gear * gain
        return result

    def rub(self, n: int, dof: int, limit: Array) -> None:
        """Add dry friction of at most `limit` (n,) to what was loaded, in the first n lanes, at the
        joint whose velocity has the index `dof`; what was added before is replaced.
        """
        loss = self.fields["dof_frictionloss"]
        changed = FIELDS["friction.coulomb"].fields
        if not self._changed.issuperset(changed):
            self._changed.update(changed)
        loss[:n, dof] = self._loaded_friction[:n, dof] + limit
        write_friction_form(self.fields, self.robot, slice(n), dof)

    def _begun(self, n: int, steps: int, record: Sequence[str]) -> dict[str, Array]:
        """Arrays that will hold what is recorded."""
        return {name: np.empty((n, steps, *self.batch.bind(name).shape[1:])) for name in record}

    def _ids(self, n: int) -> Places | None:
        return None if n == self.count else np.arange(n)

    def _fails(self, n: int) -> None:
        """What warns stands still from then on: it has failed."""
        self.failed = (self.batch.warning[:n, :, 1] > 0).any(axis=1)

    @staticmethod
    def _parts(lanes: int, steps: int) -> Iterator[slice]:
        """Steps in stretches of a fraction of a second, after which Ctrl-C is heard."""
        largest = max(INTERRUPTED // max(lanes, 1), 1)
        for begin in range(0, steps, largest):
            yield slice(begin, min(begin + largest, steps))
