"""Whether the SO-101's base servo has a D term on the error:
``python -m tests.benchmarks.so101_base``.

Stiffness, damping and the dead zone of the servo are fitted to the first 80 s of `chirp_sweep`,
from where each run begins, with a D term on the error, or a command that leads, held at several
sizes; RMSE of every motion in mrad. Then what is left of the chirp beyond, part by part. Some
minutes.
"""

from itertools import pairwise
from pathlib import Path

import numpy as np
from scipy.optimize import least_squares

from bench.gap.model.world import World
from bench.recordings.inspection import load

LOG = Path(__file__).parents[2] / "results/reference/real/datasheets/so101-base/base.toml"
PLACE, FITTED, UPTO = "m_shoulder_pan", "chirp_sweep", 80.0
ZONE, LEAD, LATE = (f"{e}@{PLACE}" for e in ("servo.deadband", "servo.derivative", "input.delay"))
FREE = {f"actuator.stiffness@{PLACE}": 0.1, f"actuator.damping@{PLACE}": 0.1, ZONE: 1e-3}
"""What is fitted, and how far apart two of it differ."""
START = (0.0, 0.0, 0.01)
HELD = ({}, {LEAD: 0.05}, {LATE: -0.05})
PARTS = (0.0, 80.0, 95.0, 105.0, 112.0, 121.0)


def main():
    recording, kind = load(LOG)
    world = World(kind, recording, recording.runs, None, candidates=[ZONE, LEAD, LATE])
    column = {parameter.name: i for i, parameter in enumerate(world.parameters)}
    names = [run.name for run in recording.runs]
    chirp = names.index(FITTED)
    times = np.asarray(recording.runs[chirp].times)
    wanted = np.array(world.observed)
    wanted[chirp, np.searchsorted(times, UPTO) :] = np.nan

    def errors(thetas, run):
        """Of rows of parameters in one run, mrad."""
        of = np.full(len(thetas), run)
        return 1e3 * (world.simulate(thetas, of, world.guess[of]) - world.observed[of])[:, :, 0]

    def rms(theta):
        seen = np.isfinite(wanted[:, :, 0])
        gaps = [errors(theta[None], run)[0][seen[run]] for run in range(len(names))]
        return [round(float(np.sqrt(np.mean(gap**2))), 2) for gap in gaps]

    for held in HELD:
        theta = fitted(
            errors, world.nominal(), column, held, chirp, np.isfinite(wanted[chirp, :, 0])
        )
        found = {name: round(float(theta[column[name]]), 4) for name in FREE}
        print(held, found, dict(zip(names, rms(theta), strict=True)), flush=True)
        gap = errors(theta[None], chirp)[0][: times.size]
        for low, high in pairwise(PARTS):
            part = gap[(times >= low) & (times < high)]
            print(f"  {low:g} to {high:g} s: {np.sqrt(np.nanmean(part**2)):.1f} mrad", flush=True)


def fitted(errors, theta, column, held, run, seen):
    """Parameters, those of `FREE` as the run says, those of `held` as they are."""
    for name, value in {**held, **dict(zip(FREE, START, strict=True))}.items():
        theta[column[name]] = value
    places, steps = [column[name] for name in FREE], np.array(list(FREE.values()))

    def gaps(z):
        rows = np.tile(theta, (len(z), 1))
        rows[:, places] = z * steps
        return errors(rows, run)[:, seen]

    def slopes(z):
        near = gaps(np.vstack([z, z + 0.01 * np.eye(z.size)]))
        return (near[1:] - near[0]).T / 0.01

    begin = theta[places] / steps
    theta[places] = least_squares(lambda z: gaps(z[None])[0], begin, jac=slopes).x * steps
    return theta


if __name__ == "__main__":
    main()
