"""Recordings of a robot that floats."""

from itertools import pairwise

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from bench.gap.explain import explain
from sims.base import InputError, Scenario
from tests.sims.robot.test_floating import SATELLITE
from tests.sims.robot.test_motion import kind_of

MODEL = SATELLITE.replace('axis="0 0.6 0.8"', 'axis="0 0 1"')
HULL, PANEL = (5.0, 0.3, 0.3), (1.0, 0.03, 0.25)
"""Mass, moment about the centre of mass, and how far that is from the hinge."""
TRUE = 0.05
"""N m s/rad of drag that the file lacks."""
SPINS = (0.8, -0.5, 0.3)
"""rad/s of the hull as each run begins."""
TOML = """model = "satellite.xml"
[channels."q.boom"]
unit = "rad"
noise = 0.001
[inputs."u.m_boom"]
unit = "N*m"
[runs.2]
held_out = true
"""


TIMES = np.arange(0.0, 3.0, 0.02)


def commands(run):
    """(T,) N m, each held until the next."""
    return 0.12 * np.sin((2.0 + run) * TIMES) + 0.05 * np.cos(5.0 * TIMES)


def motion(run):
    """(T,) angle of the boom: two bodies in a plane whose common centre of mass rests, by Lagrange.

    With turns a of the hull and b of the panel, m = m1 m2 / (m1 + m2) and e the unit vectors along
    the bodies, the kinetic energy is I1 a'^2 / 2 + I2 b'^2 / 2 + m |r1 a' e1 + r2 b' e2|^2 / 2.
    """
    (m1, i1, r1), (m2, i2, r2) = HULL, PANEL
    m = m1 * m2 / (m1 + m2)

    def rates(_, state, command):
        a, b, va, vb = state
        cross = m * r1 * r2 * np.cos(a - b)
        inertia = np.array([[i1 + m * r1**2, cross], [cross, i2 + m * r2**2]])
        turning = m * r1 * r2 * np.sin(a - b) * np.array([-(vb**2), va**2])
        torque = command - (0.02 + TRUE) * (vb - va)
        return [va, vb, *np.linalg.solve(inertia, turning + torque * np.array([-1.0, 1.0]))]

    states = [np.array([0.0, 0.0, SPINS[run], SPINS[run]])]
    for span, command in zip(pairwise(TIMES), commands(run), strict=False):
        made = solve_ivp(rates, span, states[-1], "DOP853", args=(command,), rtol=1e-9, atol=1e-10)
        states.append(made.y[:, -1])
    return np.array([b - a for a, b, *_ in states])


def recorded(tmp_path):
    rng = np.random.default_rng(4)
    lines = ["run,t,u.m_boom,q.boom"]
    for run in range(3):
        seen = motion(run) + rng.normal(0.0, 1e-3, TIMES.size)
        columns = zip(TIMES, commands(run), seen, strict=True)
        lines += [f"{run},{t:.9g},{u:.9g},{q:.9g}" for t, u, q in columns]
    begins = [f'[runs.{k}.initial]\n"qd.base.wz" = {spin}\n' for k, spin in enumerate(SPINS)]
    (tmp_path / "satellite.xml").write_text(MODEL)
    (tmp_path / "log.csv").write_text("\n".join(lines) + "\n")
    (tmp_path / "log.toml").write_text(TOML + "".join(begins))
    return tmp_path / "log.csv"


@pytest.mark.parametrize("run", range(len(SPINS)))
def test_a_hull_that_spins_swings_its_boom_as_two_bodies_in_a_plane(run):
    simulator = kind_of(MODEL, free=("damping@boom",))(observe=["q.boom"])
    scenario = Scenario(TIMES, {"qd.base.wz": SPINS[run]}, {"u.m_boom": commands(run)})
    seen = simulator.simulate(np.array([[TRUE]]), scenario)[0, :, 0]
    np.testing.assert_allclose(seen, motion(run), atol=1e-6)


def test_pieces_of_what_floats_are_refused(tmp_path):
    with pytest.raises(InputError, match=r"log\.csv: expected no --pieces: .* leave it out"):
        explain(recorded(tmp_path), pieces=1.0)
