"""MuJoCo engine: forces through ``qfrc_applied``, impacts through its contact solver.

A system with one coordinate is a body on a hinge or guide. For a bouncing system, the module
``<system>_mujoco_world`` in its package writes the world; its interface is specified in
`sims.engines.external.world_interface`.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import cast

from sims.core.argument_checks import check_positive
from sims.core.engine import Engine, IntegrationBatch, Trajectories
from sims.core.mujoco_import import import_mujoco
from sims.core.simulator import InputError
from sims.core.system import System
from sims.core.user_messages import truncate_text
from sims.engines.external import ball_integration, joint_integration
from sims.engines.external.external_engine import (
    RolloutFunction,
    integrate_batch,
    resolve_time_step,
)
from sims.engines.external.mujoco_ball_contact import MujocoBall, MujocoSoftBall
from sims.engines.external.mujoco_world import CompiledWorld, MujocoJoint, write_joint_model
from sims.engines.external.world_interface import (
    MujocoWorldModule,
    check_one_coordinate,
    find_world_module,
)

REQUIRED_PACKAGES = ("mujoco",)

_CONTACT_STIFFNESS = 1e5
"""Default stiffness of the native contact in 1/s^2: contacts then last 10 ms."""
_MAX_THREADS = 1024
_DEFAULT_STEP = 2e-3
"""MuJoCo's default time step in seconds."""


def make_engine(
    system: type[System],
    *,
    time_step: float | None = None,
    native_contact: bool = False,
    stiffness: float | None = None,
    threads: int = 1,
) -> Engine:
    """Make the MuJoCo engine for one simulator.

    By default impacts are computed exactly, not by MuJoCo; settings that apply to its own contact
    only are refused without it.

    Args:
        system: system that the engine will integrate.
        time_step: longest step in seconds (2 ms with `native_contact`); each sampling interval is
            divided into equal steps not longer than this.
        native_contact: for a bouncing system: use MuJoCo's soft contact, a spring and a damper
            whose damping is chosen for the restitution, stepped and read at first order
            (`sims.engines.external.ball_integration`).
        stiffness: with `native_contact`: stiffness of the contact in 1/s^2 (1e5: contacts of 10
            ms).
        threads: number of threads, each of which steps some batch elements; the results do not
            depend on it. Use 1 if other processes use the other cores.

    Returns:
        The engine.

    Raises:
        InputError: a setting is not valid.
    """
    if native_contact and time_step is None:
        time_step = _DEFAULT_STEP
    step = resolve_time_step(time_step, system)
    if not (isinstance(threads, int) and 1 <= threads <= _MAX_THREADS):
        raise InputError(
            f"threads must be a whole number from 1 to {_MAX_THREADS}, "
            f"found {truncate_text(str(threads))}"
        )
    if not native_contact:
        if stiffness is not None:
            raise InputError(
                "setting stiffness applies to MuJoCo's native contact only: set"
                " native_contact = true"
            )
        return MujocoEngine(system, step, threads=threads)
    if not system.bounces:
        raise InputError(f"system {system.name} does not bounce: leave native_contact out")
    if stiffness is not None:
        check_positive("stiffness", stiffness, "a positive number")
    return MujocoEngine(system, step, stiffness or _CONTACT_STIFFNESS, threads)


class MujocoEngine:
    """MuJoCo engine for one system.

    Batch elements are integrated one after the other, in one world for each thread.
    """

    name: str = "mujoco"

    def __init__(
        self,
        system: type[System],
        largest_step: float,
        stiffness: float | None = None,
        threads: int = 1,
    ) -> None:
        """Choose how batch elements are integrated, with one world and rollout function per thread.

        With `stiffness`, MuJoCo's own soft contact moves a ball. Otherwise a system that
        bounces gets impacts at their exact times, and any other system is a body on a
        joint.

        Args:
            system: System that the engine will integrate.
            largest_step: Longest step, s.
            stiffness: Stiffness of the soft contact, 1/s^2; None for exact impacts.
            threads: Number of threads.

        Raises:
            InputError: MuJoCo cannot simulate the system.
        """
        self.largest_step = largest_step
        self._rollouts: list[RolloutFunction] = []
        write_model: Callable[[Mapping[str, float]], str]
        if system.bounces:
            module = find_world_module(self.name, system, "mujoco_world", MujocoWorldModule)
            write_model = cast(MujocoWorldModule, module).model
        else:
            check_one_coordinate(self.name, system)
            joint_type = "hinge" if system.kind == "rotary" else "slide"
            write_model = partial(write_joint_model, joint_type)
        self._worlds = [CompiledWorld(write_model) for _ in range(threads)]
        for world in self._worlds:
            rollout: RolloutFunction
            if stiffness is not None:
                soft_ball = MujocoSoftBall(world, stiffness)
                rollout = partial(ball_integration.integrate_native_ball, soft_ball)
            elif system.bounces:
                rollout = partial(ball_integration.integrate_ball, MujocoBall(world))
            else:
                rollout = partial(joint_integration.integrate_joint, MujocoJoint(world))
            self._rollouts.append(rollout)

    def integrate(self, batch: IntegrationBatch) -> Trajectories:
        """Integrate all batch elements; see `Engine`."""
        with _suppress_warnings():
            return integrate_batch(batch, self._rollouts, self.close)

    def close(self) -> None:
        """Release the MuJoCo worlds; the next integration makes new ones."""
        for world in self._worlds:
            world.close()


@contextlib.contextmanager
def _suppress_warnings() -> Iterator[None]:
    """Suppress MuJoCo's warnings of instability, which it would write to a file.

    Unstable batch elements become NaN.
    """
    mujoco = import_mujoco()
    previous_handler = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(_ignore_warning)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(previous_handler)


def _ignore_warning(message: str) -> None:
    """Ignore a warning."""
