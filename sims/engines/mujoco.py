"""MuJoCo engine: forces through ``qfrc_applied``, impacts through its contact solver.

The module ``mujoco_world`` in the system's package writes the world of a system; its interface is
specified in `sims.engines.worlds`.
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
"""Default stiffness of the native contact in 1/s^2: contacts then last 10 ms."""
_MOST_THREADS = 1024
_OWN_STEP = 2e-3
"""MuJoCo's default time step in seconds."""


def engine(
    system: type[System],
    *,
    time_step: float | None = None,
    native_contact: bool = False,
    stiffness: float | None = None,
    threads: int = 1,
) -> Engine:
    """Make the MuJoCo engine for one simulator.

    Args:
        system: system that the engine will integrate.
        time_step: longest step in seconds (2 ms with `native_contact`); each sampling interval is
            divided into equal steps not longer than this.
        native_contact: for a bouncing system: use MuJoCo's soft contact, a spring and a damper
            whose damping is chosen for the restitution, stepped and read at first order
            (`sims.engines.native`).
        stiffness: with `native_contact`: stiffness of the contact in 1/s^2 (1e5: contacts of 10
            ms).
        threads: number of threads for batch elements that are stepped together; the results do not
            depend on it. Use 1 if other processes use the other cores.

    Returns:
        The engine.

    Raises:
        InputError: a setting is not valid.
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
    """Object that is closed together with the engine."""

    def close(self) -> None:
        """Release stored worlds."""
        ...


class MujocoEngine:
    """MuJoCo engine for one system.

    Batch elements are integrated together if `mujoco.batch` is available and there are enough of
    them, otherwise one after the other in one world.
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
        """Set up integration of one element after the other."""
        self._rollouts = partial(in_turn, rollout, self.close)

    def _together(
        self, alone: Callable[[Lane], Path], many: _Closed, company: together.Company
    ) -> None:
        """Set up integration of elements together, if this MuJoCo version can step batches."""
        if not mujoco_batch.there():
            self._alone(alone)
            return
        self._many = many
        self._rollouts = partial(together.rollouts, alone, company, self.close)

    def integrate(self, lanes: Lanes) -> Motion:
        """Integrate all batch elements; see `Engine`."""
        assert self._rollouts is not None, "a system that the engine refuses"
        with _quiet():
            return integrate(lanes, self._rollouts, self.close)

    def refuses(self, system: type[System]) -> str:  # noqa: ARG002
        """Return why the engine cannot integrate the system; see `Engine`."""
        return self._reason

    def close(self) -> None:
        """Release the MuJoCo worlds; the next integration makes new ones."""
        if self._rollouts is not None:
            self._world.close()
        if self._many is not None:
            self._many.close()


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Suppress MuJoCo's warnings of instability, which it would write to a file.

    Unstable batch elements become NaN.
    """
    mujoco = library()
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(_ignore)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(before)


def _ignore(message: str) -> None:
    """Ignore a warning."""
