"""Test for a D term on the error in the SO-101's base servo, and for what limits the servo.

``python -m tests.benchmarks.so101_base``; twenty minutes.

Stiffness, damping and the dead zone of the servo are fitted to the first 80 s of `chirp_sweep`,
with initial states from each run, with a D term on the error, or a leading command, fixed at
several sizes. The output is the RMSE of every motion in mrad, and the residual of the later chirp
by interval. Then the same three numbers are fitted to the whole chirp, without and with a motion
profile, whose fit begins near the acceleration limit of the firmware. Finally, chirp,
`prbs_excitation` and steps are fitted together: the dead zone alone, with a profile, and a drive
that hardly brakes, with friction and a force limit.
"""

from itertools import pairwise
from pathlib import Path

import numpy as np
from scipy.optimize import least_squares

from bench.diagnosis.evaluation.run_evaluator import RunEvaluator
from bench.logs.recording_loading import load_recording

LOG = Path(__file__).parents[2] / "results/reference/real/datasheets/so101-base/base.toml"
PLACE, JOINT, FITTED, UPTO = "m_shoulder_pan", "shoulder_pan", "chirp_sweep", 80.0
ALL = (FITTED, "prbs_excitation", "step_response")
ZONE, LEAD, LATE, WAY, BRAKE = (
    f"{effect}@{PLACE}"
    for effect in (
        "servo.deadband", "servo.derivative", "input.delay", "servo.profile", "supply.braking",
    )
)  # fmt: skip
DRY, DRAG, MOST = f"friction.coulomb@{JOINT}", f"drag.linear@{JOINT}", f"actuator.limit@{PLACE}"
STIFF, DAMP = f"actuator.stiffness@{PLACE}", f"actuator.damping@{PLACE}"
FREE = {STIFF: (0.0, 0.1), DAMP: (0.0, 0.1), ZONE: (0.01, 1e-3)}
"""Fitted parameters, with their initial values and scales."""
LIMIT = 40.0
"""Initial value of a fit of the profile, rad/s^2.

It is near the STS3215's largest acceleration of 254 times 100 encoder steps, 38.96. If a limit is
reached, a motion may skip every other turn, so that the sum of squares has many minima.
"""
COASTS = {
    STIFF: (4.3, 0.1), DAMP: (2.0, 0.1), BRAKE: (0.98, 0.02), DRY: (0.15, 0.01),
    LATE: (0.0255, 1e-3), MOST: (1.4, 0.05), DRAG: (0.1, 0.01),
}  # fmt: skip
"""Initial values and scales of a fit of a drive with weak braking.

They are the result of a manual CMA-ES search with a plain model of one joint, from values that a
servo might have.
"""
HELD = ({}, {LEAD: 0.05}, {LATE: -0.05})
PARTS = (0.0, 80.0, 95.0, 105.0, 112.0, 121.0)


def main():
    recording, kind = load_recording(LOG)
    asked = [ZONE, LEAD, LATE, WAY, BRAKE, DRY, DRAG, MOST]
    world = RunEvaluator(kind, recording, recording.runs, None, candidates=asked)
    column = {parameter.name: i for i, parameter in enumerate(world.parameters)}
    names = [run.name for run in recording.runs]
    chirp = names.index(FITTED)
    times = np.asarray(recording.runs[chirp].times)
    shown = np.isfinite(world.observed[:, :, 0])
    slow = shown[chirp] & (np.arange(shown.shape[1]) < np.searchsorted(times, UPTO))

    def errors(thetas, run):
        """Return errors for rows of parameters in one run, mrad."""
        of = np.full(len(thetas), run)
        return (
            1e3
            * (world.simulate(thetas, of, world.initial_state_guesses[of]) - world.observed[of])[
                :, :, 0
            ]
        )

    def rms(theta):
        gaps = [errors(theta[None], run)[0][shown[run]] for run in range(len(names))]
        return [round(float(np.sqrt(np.mean(gap**2))), 2) for gap in gaps]

    cases = [(FREE, held, {chirp: slow}) for held in HELD]
    whole = {chirp: shown[chirp]}
    for more in ({}, {WAY: (LIMIT, 1.0)}, {WAY: (LIMIT, 1.0), LATE: (0.01, 1e-3)}):
        cases.append((FREE | more, {}, whole))
    every = {run: shown[run] for run in map(names.index, ALL)}
    for free in (FREE, FREE | {WAY: (LIMIT, 1.0), LATE: (0.01, 1e-3)}, COASTS):
        cases.append((free, {}, every))
    cases.append((COASTS, {}, whole))
    for free, held, seen in cases:
        theta = fitted(errors, world.get_nominal_theta(), column, free, held, seen)
        found = {name: round(float(theta[column[name]]), 4) for name in free}
        print(held, found, dict(zip(names, rms(theta), strict=True)), flush=True)
        gap = errors(theta[None], chirp)[0][: times.size]
        for low, high in pairwise(PARTS):
            then = gap[(times >= low) & (times < high)]
            print(f"  {low:g} to {high:g} s: {np.sqrt(np.nanmean(then**2)):.1f} mrad", flush=True)


def fitted(errors, theta, column, free, held, seen):
    """Return parameters after a fit of those in `free`; those in `held` are fixed.

    The fit uses the samples in `seen`, and all its runs have the same weight.
    """
    for name, value in {**held, **{name: begun for name, (begun, _) in free.items()}}.items():
        theta[column[name]] = value
    places, steps = [column[name] for name in free], np.array([step for _, step in free.values()])

    def gaps(z):
        rows = np.tile(theta, (len(z), 1))
        rows[:, places] = z * steps
        return np.hstack([errors(rows, run)[:, at] / np.sqrt(at.sum()) for run, at in seen.items()])

    def slopes(z):
        near = gaps(np.vstack([z, z + 0.01 * np.eye(z.size)]))
        return (near[1:] - near[0]).T / 0.01

    begin = theta[places] / steps
    theta[places] = least_squares(lambda z: gaps(z[None])[0], begin, jac=slopes).x * steps
    return theta


if __name__ == "__main__":
    main()
