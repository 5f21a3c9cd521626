"""Bodies in MuJoCo: on a joint, and a ball over level ground.

MuJoCo's contact asks for an acceleration along the normal, of which it gives the share d: with r
the depth, v its rate, and a_0 what would happen without contact,

    a_ref = -b v - k r                                                     (1)
    a = (1 - d) a_0 + d a_ref, never pulling                               (2)

("Solver parameters", https://mujoco.readthedocs.io/en/stable/modeling.html#solver-parameters).
Written as ``solref = (-stiffness, -damping)`` with constant impedance d and no stiffness, a_ref =
-(damping / d) v, so that with

    damping = (1 + e) / h                                                  (3)

a single step of length h from the surface, other forces made up for (a_0 = 0), takes v to v - (1 +
e) v = -e v: exactly the restitution e, for any h. A resting ball is held by

    damping = 1 / h,    stiffness = 0.1 / h^2                              (4)

which let it sink in by 10 (1 - d) g h^2. MuJoCo's friction is a convex
relaxation that turns slip into lift (Todorov, ICRA 2014, doi:10.1109/ICRA.2014.6907751), so contact
is frictionless here and the tangential speed lost in an impact goes in as an impulse, through
``qfrc_applied`` in the step of the impact.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from sims.engines import flight
from sims.engines.point import State, Vector
from sims.engines.worlds import MujocoJointModule

_IMPACT = 1e-4
"""Seconds that the step of an impact lasts; MuJoCo takes accelerations above 1e10 for a failure."""
_IMPEDANCE = 0.9999
"""Share d of the acceleration asked for that contact gives: the largest MuJoCo allows."""


@functools.cache
def library() -> Any:
    """The module ``mujoco``, imported on first use: it takes a while and most commands never
    simulate.
    """
    import mujoco

    return mujoco


class CompiledWorld:
    """One MuJoCo model and its state, compiled when first needed and again when the constants
    change.

    Args:
        model: called with the constants; returns MJCF.
    """

    def __init__(self, model: Callable[[Mapping[str, float]], str]) -> None:
        self._compile = model
        self._built_for: dict[str, float] | None = None
        self._model: Any = None
        self._data: Any = None

    def __reduce__(self) -> tuple[type[CompiledWorld], tuple[Callable[[Mapping[str, float]], str]]]:
        # A copy of a simulator, here or in another process, gets a world of its own.
        return CompiledWorld, (self._compile,)

    def fresh(self, constants: Mapping[str, float]) -> tuple[Any, Any]:
        """Model and data as newly made, for these constants."""
        if self._built_for != constants:
            mujoco = library()
            self._model = mujoco.MjModel.from_xml_string(self._compile(constants))
            disabled = mujoco.mjtDisableBit
            # Joint damping explicit, as in Bullet and as `sims.engines.joint` takes it to be.
            self._model.opt.disableflags |= disabled.mjDSBL_EULERDAMP
            # A lane that fails must be NaN: MuJoCo would reset it, and it would pass for done.
            self._model.opt.disableflags |= disabled.mjDSBL_AUTORESET
            self._data = mujoco.MjData(self._model)
            self._built_for = dict(constants)
        else:
            library().mj_resetData(self._model, self._data)
        return self._model, self._data

    def close(self) -> None:
        """Give back model and data."""
        self._model = self._data = self._built_for = None


class Joint:
    """A body on one hinge or guide; see `sims.engines.joint.Joint`."""

    def __init__(self, world: CompiledWorld, module: MujocoJointModule) -> None:
        self._world = world
        self._load = module.load
        self._gravity = module.gravity
        self.open_loop: bool = module.OPEN_LOOP

    def start(self, constants: dict[str, float]) -> None:
        """A world for these constants, as newly made."""
        self._constants, self.gravity = constants, self._gravity(constants)
        self._model, self._data = self._world.fresh(constants)
        self._x = self._data.qpos
        self._w = self._data.qvel
        self._force = self._data.qfrc_applied
        self._step = library().mj_step

    def pace(self, step: float, inertia: float, damping: float) -> bool:
        """Step in seconds, generalised inertia, joint damping."""
        self._model.opt.timestep = step
        self._model.dof_damping[0] = damping
        return self._load(self._model, inertia, self._constants)

    def place(self, x: float, w: float) -> None:
        """The joint's position and velocity."""
        self._x[0] = x
        self._w[0] = w

    def advance(self, force: float) -> tuple[float, float]:
        """One step."""
        self._force[0] = force
        self._step(self._model, self._data)
        return self._x.item(), self._w.item()

    def glide(self, force: float, counts: Sequence[int]) -> list[tuple[float, float]]:
        """Steps with a force or torque at the joint."""
        states = []
        self._force[0] = force
        for count in counts:
            # None where `joint` has taken the step itself, with an input of its own.
            if count:
                self._step(self._model, self._data, count)
            states.append((self._x.item(), self._w.item()))
        return states

    def __getstate__(self) -> dict[str, Any]:
        return {name: self.__dict__[name] for name in ("_world", "_load", "_gravity", "open_loop")}


class Mover:
    """A ball on three slides; see `sims.engines.flight.Mover`."""

    def __init__(self, world: CompiledWorld) -> None:
        self._world = world

    def start(self, constants: dict[str, float]) -> None:
        """A world for these constants, as newly made, without contact."""
        mujoco = library()
        self._mass = constants["mass"]
        self._floor = constants["radius"]
        self._gravity = constants["gravity"]
        self._model, self._data = self._world.fresh(constants)
        self._x = self._data.qpos
        self._w = self._data.qvel
        self._force = self._data.qfrc_applied
        self._no_contact = int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
        self._model.geom_solimp[:] = _IMPEDANCE, _IMPEDANCE, 1e-3, 0.5, 2.0
        self._step = mujoco.mj_step
        self._hertz = math.nan
        self._meets(False)

    def _meets(self, ground: bool) -> None:
        """Let contact act or not."""
        flags = self._model.opt.disableflags
        self._model.opt.disableflags = (
            flags & ~self._no_contact if ground else flags | self._no_contact
        )

    def _contact(self, stiffness: float, damping: float) -> None:
        """Stiffness (1/s^2) and damping (1/s) of the contact to come."""
        self._model.geom_solref[:] = -stiffness, -damping

    def pace(self, step: float) -> None:
        """Step in seconds."""
        self._model.opt.timestep = step
        self._hertz = 1.0 / step

    def place(self, x: Vector, w: Vector) -> None:
        """Position and velocity."""
        self._x[:] = x
        self._w[:] = w

    def advance(self, force: Vector) -> State:
        """One step with a force at the centre."""
        mass = self._mass
        self._force[:] = mass * force[0], mass * force[1], mass * force[2]
        self._step(self._model, self._data)
        self._force[:] = 0.0
        return self._x.tolist(), self._w.tolist()

    def glide(self, counts: Sequence[int]) -> list[State]:
        """Steps under gravity."""
        states: list[State] = []
        for count in counts:
            self._step(self._model, self._data, count)
            states.append((self._x.tolist(), self._w.tolist()))
        return states

    def __getstate__(self) -> dict[str, Any]:
        return {
            name: self.__dict__[name] for name in ("_world", "_stiffness") if name in self.__dict__
        }


class MujocoBall(Mover):
    """A ball that MuJoCo's contact sends back in one step; see `sims.engines.flight.FlyingBall`."""

    def start(self, constants: dict[str, float]) -> None:
        """As every ball's."""
        super().start(constants)
        self._held = False

    @property
    def model(self) -> Any:
        """The compiled world as `start` has made it."""
        return self._model

    def be(self, held: bool, before: Any) -> None:
        """Go on as another ball of this world, whose step and place follow.

        Args:
            held: whether contact holds it up.
            before: its acceleration in the step before, from which MuJoCo's solver begins.
        """
        self._held = held
        self._meets(held)
        self._hertz = math.nan
        self._data.qacc_warmstart[:] = before

    @property
    def became(self) -> tuple[bool, int, Any]:
        """What makes another ball go on as this one: as for `be`, and what is disabled, before the
        acceleration.
        """
        return self._held, self._model.opt.disableflags, self._data.qacc_warmstart

    def holding(self, step: float) -> tuple[float, float]:
        """What contact that holds a ball up is to MuJoCo, as ``solref``."""
        hertz = 1.0 / step
        return -0.1 * hertz**2, -hertz  # (4)

    def pace(self, step: float) -> None:
        """Step in seconds."""
        super().pace(step)
        if self._held:
            self._model.geom_solref[:] = self.holding(step)

    def strike(self, x: Vector, v: Vector, restitution: float, friction: float) -> Vector:
        """MuJoCo's contact solver on one short step, gravity made up for, friction put in as an
        impulse.
        """
        self._held = False
        self.pace(_IMPACT)
        self.place((x[0], x[1], self._floor - flight.INSIDE), v)
        self._contact(0.0, (1.0 + restitution) * self._hertz)  # (3)
        # Of the tangential speed mu (1 + e) |vn| goes (`sims.engines.ground`), in this one step.
        along = math.hypot(v[0], v[1])
        share = min(friction * (1.0 + restitution) * -v[2] / along, 1.0) if along else 0.0
        lost = share * self._hertz
        self._meets(True)
        _, after = self.advance((-lost * v[0], -lost * v[1], self._gravity))
        self._meets(False)
        return after

    def hold(self) -> None:
        """Contact that damps and, very little, springs."""
        self._held = True
        self._meets(True)
        # (4) depends on the step: where one is set already, contact is set for it.
        if not math.isnan(self._hertz):
            self.pace(1.0 / self._hertz)
