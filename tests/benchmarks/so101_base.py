"""Whether the SO-101's base servo has a D term on the error, and what limits it:
``python -m tests.benchmarks.so101_base``.

Stiffness, damping and the dead zone of the servo are fitted to the first 80 s of `chirp_sweep`,
from where each run begins, with a D term on the error, or a command that leads, held at several
sizes; RMSE of every motion in mrad. Then what is left of the chirp beyond, part by part. Then the
same three numbers are fitted to the whole chirp, without and with a motion profile, which begins
near the acceleration that the firmware allows. Ten minutes.
"""

from itertools import pairwise
from pathlib import Path

import numpy as np
from scipy.optimize import least_squares

from bench.gap.model.world import World
from bench.recordings.inspection import load

LOG = Path(__file__).parents[2] / "results/reference/real/datasheets/so101-base/base.toml"
PLACE, FITTED, UPTO = "m_shoulder_pan", "chirp_sweep", 80.0
ZONE, LEAD, LATE, WAY = (
    f"{e}@{PLACE}" for e in ("servo.deadband", "servo.derivative", "input.delay", "servo.profile")
)
FREE = {
    f"actuator.stiffness@{PLACE}": (0.0, 0.1),
    f"actuator.damping@{PLACE}": (0.0, 0.1),
    ZONE: (0.01, 1e-3),
}
"""What is fitted: where it begins, and how far apart two of it differ."""
LIMIT = 40.0
"""rad/s^2, where a fit of the profile begins, near the STS3215's largest acceleration of 254 times
100 encoder steps, 38.96: at a limit that is met a motion may skip every other turn, so that the
sum of squares has many minima."""
HELD = ({}, {LEAD: 0.05}, {LATE: -0.05})
PARTS = (0.0, 80.0, 95.0, 105.0, 112.0, 121.0)


def main():
    recording, kind = load(LOG)
    world = World(kind, recording, recording.runs, None, candidates=[ZONE, LEAD, LATE, WAY])
    column = {parameter.name: i for i, parameter in enumerate(world.parameters)}
    names = [run.name for run in recording.runs]
    chirp = names.index(FITTED)
    times = np.asarray(recording.runs[chirp].times)
    shown = np.isfinite(world.observed[:, :, 0])
    slow = shown[chirp] & (np.arange(shown.shape[1]) < np.searchsorted(times, UPTO))

    def errors(thetas, run):
        """Of rows of parameters in one run, mrad."""
        of = np.full(len(thetas), run)
        return 1e3 * (world.simulate(thetas, of, world.guess[of]) - world.observed[of])[:, :, 0]

    def rms(theta):
        gaps = [errors(theta[None], run)[0][shown[run]] for run in range(len(names))]
        return [round(float(np.sqrt(np.mean(gap**2))), 2) for gap in gaps]

    cases = [(FREE, held, slow) for held in HELD]
    for more in ({}, {WAY: (LIMIT, 1.0)}, {WAY: (LIMIT, 1.0), LATE: (0.01, 1e-3)}):
        cases.append((FREE | more, {}, shown[chirp]))
    for free, held, seen in cases:
        theta = fitted(errors, world.nominal(), column, free, held, chirp, seen)
        found = {name: round(float(theta[column[name]]), 4) for name in free}
        print(held, found, dict(zip(names, rms(theta), strict=True)), flush=True)
        gap = errors(theta[None], chirp)[0][: times.size]
        for low, high in pairwise(PARTS):
            then = gap[(times >= low) & (times < high)]
            print(f"  {low:g} to {high:g} s: {np.sqrt(np.nanmean(then**2)):.1f} mrad", flush=True)


def fitted(errors, theta, column, free, held, run, seen):
    """Parameters, those that are free as the run says, those of `held` as they are."""
    for name, value in {**held, **{name: begun for name, (begun, _) in free.items()}}.items():
        theta[column[name]] = value
    places, steps = [column[name] for name in free], np.array([step for _, step in free.values()])

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
