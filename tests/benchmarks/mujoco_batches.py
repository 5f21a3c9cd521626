"""Measure the cost of a batch element in the engine `mujoco`, and in MuJoCo alone.

Run with ``OMP_NUM_THREADS=1 python -m tests.benchmarks.mujoco_batches``; prints a Markdown table. A
batch element is a pendulum for 4 s at 100 Hz, 1,600 steps of 2.5 ms. The variants alternate in one
process, and the minimum of some rounds counts.
"""

from __future__ import annotations

from collections.abc import Callable
from time import perf_counter, process_time

import numpy as np

from sims.core.simulator import Scenario
from sims.systems.pendulum import Pendulum

BATCH_SIZES = (1, 16, 256)
STEPS = 1600
STEP = 2.5e-3
FRICTION = 0.01
"""Dry friction, N*m."""
CASES = {
    "plain": (),
    "dry friction and drag": ("friction.coulomb", "drag.quadratic"),
    "dry friction by Stribeck, spring": ("friction.stribeck", "spring.linear"),
}
PENDULUM = """
<mujoco><worldbody><body><joint type="hinge" axis="0 1 0" armature="1e-4"/>
<inertial mass="0.49" pos="0 0 -0.1" diaginertia="1e-9 1e-9 1e-9"/></body></worldbody></mujoco>
"""
Cost = tuple[float, float]
"""Processor and wall time per batch element, ms."""


def native(batch_size: int, threads: int = 1) -> Callable[[], None]:
    """Return a function that runs MuJoCo alone, as the reference for costs.

    It uses `mujoco.batch.Batch` with dry friction by the joint's `frictionloss`, and reads no
    intermediate results.

    Args:
        batch_size: number of pendulums, each with its own initial angle.
        threads: threads of the batch.

    Returns:
        Function that makes all steps once, from the start.
    """
    import mujoco
    from mujoco import batch

    model = mujoco.MjModel.from_xml_string(PENDULUM)
    model.opt.timestep = STEP
    model.dof_frictionloss[:] = FRICTION
    many = batch.Batch(model, batch_size, threads)
    angles = np.linspace(0.5, 2.5, batch_size)

    def work() -> None:
        many.reset(stage=int(mujoco.mjtStage.mjSTAGE_NONE))
        many.bind("qpos")[:, 0] = angles
        many.step(nstep=STEPS)

    return work


def ours(effects: tuple[str, ...], batch_size: int, **settings: int) -> Callable[[], None]:
    """Return a function that runs the engine `mujoco` on many pendulums.

    Each effect has half of its largest coefficient.
    """
    pendulum = Pendulum(engine="mujoco", effects=effects, **settings)
    known = len(Pendulum.system.parameters)
    middle = [p.nominal for p in pendulum.parameters[:known]]
    middle += [0.5 * p.bounds[1] for p in pendulum.parameters[known:]]
    theta = np.array(middle) * np.random.default_rng(1).uniform(
        0.95, 1.05, (batch_size, len(middle))
    )
    run = Scenario(np.arange(401) / 100, {"q": 1.5})
    return lambda: np.testing.assert_equal(
        pendulum.simulate(theta, run).shape[:2], (batch_size, 401)
    )


def once(work: Callable[[], None], batch_size: int) -> Cost:
    """Return the cost per batch element."""
    processor, wall = process_time(), perf_counter()
    work()
    return 1e3 * (process_time() - processor) / batch_size, 1e3 * (
        perf_counter() - wall
    ) / batch_size


def main() -> None:
    """Print the table."""
    print("| pendulum | elements | engine `mujoco`, ms | `batch.Batch` itself, ms |")
    print("|---|---|---|---|")
    for name, effects in CASES.items():
        for batch_size in BATCH_SIZES:
            variants = ours(effects, batch_size), native(batch_size)
            costs = [[once(work, batch_size) for work in variants] for _ in range(3)]
            cells = [f"{cpu:.2f} ({wall:.2f})" for cpu, wall in np.min(costs, axis=0).tolist()]
            print(f"| {name} | {batch_size:,} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
