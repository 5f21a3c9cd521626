"""MuJoCo as an engine: forces through ``qfrc_applied``, impacts through its contact solver.

The world that carries a system is written by the module ``mujoco_world`` beside the system's own;
`sims.engines.worlds` states what such a module must have.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterator
from functools import partial
from typing import Protocol, cast

from sims.base import InputError
from sims.engines import (
    flight,
    flights,
    joint,
    joints,
    mujoco_balls,
    mujoco_batch,
    native,
    together,
)
from sims.engines.external import Lane, Path, Rollouts, checked_time_step, in_turn, integrate
from sims.engines.mujoco_bodies import CompiledWorld, Joint, MujocoBall, library
from sims.engines.mujoco_soft import SoftBall
from sims.engines.worlds import MujocoJointModule, MujocoModule, world_module
from sims.limits import cut
from sims.system import Engine, Lanes, Motion, System

REQUIRES = ("mujoco",)

_STIFFNESS = 1e5
"""1/s^2, of `native_contact` where the user sets none: contacts then last 10 ms."""
_MOST_THREADS = 1024
_OWN_STEP = 2e-3
"""Seconds: the step that MuJoCo takes by default."""


def engine(
    system: type[System],
    *,
    time_step: float | None = None,
    native_contact: bool = False,
    stiffness: float | None = None,
    threads: int = 1,
) -> Engine:
    """The engine for one simulator.

    Args:
        system: what it will integrate.
        time_step: longest step in seconds (2 ms with `native_contact`); each sampling interval is
            divided into equal steps not longer than this.
        native_contact: for a system that bounces: MuJoCo's contact as a spring and damper that give
            way, whose damping is chosen for the restitution; stepped and read at first order
            (`sims.engines.native`).
        stiffness: with `native_contact`: of the contact, 1/s^2 (1e5, that is contacts of 10 ms).
        threads: over which lanes that are stepped together are spread; results do not depend on
            it. One is right where other processes use the other cores.

    Raises:
        InputError: an impossible setting.
    """
    if native_contact and time_step is None:
        time_step = _OWN_STEP
    step = checked_time_step(time_step, system)
    if not (isinstance(threads, int) and 1 <= threads <= _MOST_THREADS):
        raise InputError(
            f"threads must be a whole number from 1 to {_MOST_THREADS}, found {cut(str(threads))}"
        )
    if not native_contact:
        if stiffness is not None:
            raise InputError(
                "setting stiffness belongs to MuJoCo's contact as it comes: set"
                " native_contact = true"
            )
        return MujocoEngine(system, step, threads=threads)
    if not system.bounces:
        raise InputError(f"system {system.name} does not bounce: leave native_contact out")
    if stiffness is not None and not 0 < stiffness < math.inf:
        raise InputError(f"stiffness must be a positive number, found {stiffness}")
    return MujocoEngine(system, step, stiffness or _STIFFNESS)


class _Closed(Protocol):
    """What is closed with the engine."""

    def close(self) -> None:
        """Give back what is kept."""
        ...


class MujocoEngine:
    """MuJoCo: lanes together where there is `mujoco.batch` and they are enough, else one after the
    other in one world.
    """

    name: str = "mujoco"
    requires: tuple[str, ...] = REQUIRES

    def __init__(
        self,
        system: type[System],
        largest_step: float,
        stiffness: float | None = None,
        threads: int = 1,
    ) -> None:
        self.largest_step = largest_step
        self._rollouts: Rollouts | None = None
        self._many: _Closed | None = None
        asked = MujocoModule if system.bounces else MujocoJointModule
        module, self._reason = world_module(system, "mujoco_world", asked)
        if module is None:
            return
        self._world = CompiledWorld(cast(MujocoModule, module).model)
        if stiffness is not None:
            self._alone(partial(native.rollout, SoftBall(self._world, stiffness)))
        elif system.bounces:
            alone = partial(flight.rollout, MujocoBall(self._world))
            balls = mujoco_balls.Balls(CompiledWorld(cast(MujocoModule, module).model), threads)
            self._together(alone, balls, flights.Fliers(balls))
        else:
            body = cast(MujocoJointModule, module)
            on_joint = partial(joint.rollout, Joint(self._world, body))
            bodies = mujoco_batch.Joints(self._world, body, threads)
            self._together(on_joint, bodies, joints.Company(bodies))

    def _alone(self, rollout: Callable[[Lane], Path]) -> None:
        """Integrate lane after lane."""
        self._rollouts = partial(in_turn, rollout, self.close)

    def _together(
        self, alone: Callable[[Lane], Path], many: _Closed, company: together.Company
    ) -> None:
        """Integrate lanes together, if this MuJoCo does."""
        if not mujoco_batch.there():
            self._alone(alone)
            return
        self._many = many
        self._rollouts = partial(together.rollouts, alone, company, self.close)

    def integrate(self, lanes: Lanes) -> Motion:
        """See `Engine`."""
        assert self._rollouts is not None, "a system that the engine refuses"
        with _quiet():
            return integrate(lanes, self._rollouts, self.close)

    def refuses(self, system: type[System]) -> str:  # noqa: ARG002
        """See `Engine`."""
        return self._reason

    def close(self) -> None:
        """Give back the MuJoCo world; the next integration makes a new one."""
        if self._rollouts is not None:
            self._world.close()
        if self._many is not None:
            self._many.close()


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Without MuJoCo's warnings of instability, which it would write to a file: such lanes become
    NaN.
    """
    mujoco = library()
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(_ignore)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(before)


def _ignore(message: str) -> None:
    """Nothing."""
