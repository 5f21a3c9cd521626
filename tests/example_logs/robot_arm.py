"""Make the recording of examples/robot again: `python -m tests.example_logs.robot_arm FOLDER`.

The "real" arm is given here by the equations of motion of two links in a plane, which SciPy
integrates from event to event. MuJoCo is not used. The elbow has dry friction, which can stick; the
model `arm2.xml` lacks it.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.integrate import solve_ivp

Array = npt.NDArray[np.float64]

RATE = 100
"""Sampling rate of samples and commands in Hz; a command is held until the next."""
SECONDS = 4
"""Length of a run, s."""
NOISE = 0.001
"""Standard deviation of the encoder noise, rad."""
RUNS = range(1, 7)
"""Numbers of the runs."""
TORQUES = (1.0, 0.3)
"""Root mean square of the commands at shoulder and elbow, N m."""
FRICTION = 0.03
"""Hidden cause: dry friction at the elbow, N m."""
EVENT_TOLERANCE = 1e-9
"""Offset that delays an event, N m or rad/s, so that rounding does not repeat it."""


@dataclass(frozen=True)
class Arm:
    """Arm of two links in a vertical plane with the numbers of arm2.xml, in SI units.

    Attributes:
        mass: Masses of the upper arm and the forearm.
        centre: Distances of their centres of mass from their joints.
        inertia: Moments of inertia about their centres of mass.
        armature: Inertias of the motors, reflected to the joints.
        damping: Viscous damping at the joints.
        length: Length of the upper arm, from shoulder to elbow.
        gravity: Gravitational acceleration, downwards.
        friction: Dry friction at the elbow.
    """

    mass: tuple[float, float] = (1.2, 0.8)
    centre: tuple[float, float] = (0.18, 0.15)
    inertia: tuple[float, float] = (0.018, 0.009)
    armature: tuple[float, float] = (0.01, 0.005)
    damping: tuple[float, float] = (0.3, 0.1)
    length: float = 0.4
    gravity: float = 9.81
    friction: float = 0.0

    def inertias(self, q: Array) -> Array:
        r"""Return the mass matrix (2, 2).

        .. math:: M_{11} = I_1 + m_1 c_1^2 + m_2 l^2 + 2 x + M_{22} - a_2 + a_1,\;
            M_{12} = I_2 + m_2 c_2^2 + x,\; M_{22} = I_2 + m_2 c_2^2 + a_2,\;
            x = m_2 l c_2 \cos q_2  (1)
        """
        (m1, m2), (c1, c2), (i1, i2), (a1, a2) = self.mass, self.centre, self.inertia, self.armature
        across = m2 * self.length * c2 * np.cos(q[1])
        forearm = i2 + m2 * c2**2
        whole = i1 + m1 * c1**2 + m2 * self.length**2 + 2 * across + forearm
        return np.array([[whole + a1, forearm + across], [forearm + across, forearm + a2]])

    def forces(self, q: Array, v: Array, torque: Array) -> Array:
        r"""Return the generalised forces (2,), including Coriolis terms but without dry friction.

        .. math:: f_1 = u_1 - d_1 v_1 + h (2 v_1 v_2 + v_2^2) - g (m_1 c_1 + m_2 l) \sin q_1 - w,\;
            f_2 = u_2 - d_2 v_2 - h v_1^2 - w,\; h = m_2 l c_2 \sin q_2,\;
            w = g m_2 c_2 \sin(q_1 + q_2)  (2)
        """
        (m1, m2), (c1, c2) = self.mass, self.centre
        whirl = m2 * self.length * c2 * np.sin(q[1])
        forearm = self.gravity * m2 * c2 * np.sin(q[0] + q[1])
        upper = self.gravity * (m1 * c1 + m2 * self.length) * np.sin(q[0])
        inertial = np.array([whirl * (2 * v[0] * v[1] + v[1] ** 2), -whirl * v[0] ** 2])
        weights = np.array([upper + forearm, forearm])
        forces: Array = torque - np.array(self.damping) * v + inertial - weights
        return forces

    def rate(self, state: Array, torque: Array, slide: int) -> Array:
        """Return velocities and accelerations (4,), with the elbow sliding (1, -1) or sticking (0).

        Args:
            state: (4,) positions and velocities.
            torque: (2,) torques.
            slide: Direction in which the elbow slides, or 0.
        """
        q, v = state[:2], state[2:]
        inertias, forces = self.inertias(q), self.forces(q, v, torque)
        if slide == 0:
            return np.array([v[0], 0.0, forces[0] / inertias[0, 0], 0.0])
        return np.append(v, np.linalg.solve(inertias, forces - [0.0, slide * self.friction]))

    def compute_stick_torque(self, state: Array, torque: Array) -> float:
        """Return the torque on a sticking elbow, N m."""
        inertias = self.inertias(state[:2])
        forces = self.forces(state[:2], state[2:], torque)
        return float(forces[1] - inertias[1, 0] * forces[0] / inertias[0, 0])

    def compute_stick_margin(self, state: Array, torque: Array) -> float:
        """Return the margin of a sticking elbow before break-away, N m; it slides below 0."""
        return self.friction - abs(self.compute_stick_torque(state, torque))

    def find_sliding_direction(self, state: Array, torque: Array) -> int:
        """Return how an elbow at rest continues: 0 if it sticks, else the sliding direction."""
        if self.compute_stick_margin(state, torque) > EVENT_TOLERANCE:
            return 0
        return 1 if self.compute_stick_torque(state, torque) > 0 else -1

    def advance(self, state: Array, slide: int, torque: Array, seconds: float) -> tuple[Array, int]:
        """Integrate over a time of constant torque.

        Args:
            state: (4,) positions and velocities.
            slide: Direction in which the elbow slides, or 0.
            torque: (2,) torques.
            seconds: Length of the time, s.

        Returns:
            The state at the end, and the sliding direction there.
        """
        now = 0.0
        while now < seconds:
            if slide == 0:
                slide = self.find_sliding_direction(state, torque)

            def change(_: float, y: Array, slide: int = slide) -> float:
                """Return a value that crosses zero just after the elbow stops or breaks away."""
                return (
                    slide * float(y[3]) + EVENT_TOLERANCE
                    if slide
                    else self.compute_stick_margin(y, torque)
                )

            change.terminal, change.direction = True, -1  # type: ignore[attr-defined]
            piece = solve_ivp(
                lambda _, y, slide=slide: self.rate(y, torque, slide),
                (now, seconds),
                state,
                method="DOP853",
                rtol=1e-10,
                atol=1e-11,
                events=change if self.friction else None,
            )
            now, state = float(piece.t[-1]), piece.y[:, -1]
            if piece.status == 1 and slide:
                slide, state[3] = 0, 0.0
        return state, slide

    def simulate(self, initial: Array, torques: Array) -> Array:
        """Simulate the arm.

        Args:
            initial: (4,) initial positions and velocities.
            torques: (T, 2) torques, each held from its sample to the next.

        Returns:
            Positions (T, 2) at the samples, rad.
        """
        state = np.array(initial, dtype=float)
        slide = int(np.sign(state[3])) if self.friction else 1
        positions = [state[:2]]
        for torque in torques[:-1]:
            state, slide = self.advance(state, slide, torque, 1 / RATE)
            positions.append(state[:2])
        return np.array(positions)


def torques_of(number: int) -> Array:
    """Return the commands (T, 2) of a run, N m: a sum of four sines at each joint."""
    rng = np.random.default_rng([16, number])
    time = np.arange(SECONDS * RATE) / RATE
    waves = 2 * np.pi * (rng.uniform(0.2, 1.6, (2, 4, 1)) * time + rng.uniform(size=(2, 4, 1)))
    sines = np.sin(waves).sum(axis=1) / np.sqrt(2)
    torques: Array = np.round(sines.T * TORQUES, 4)
    return torques


def rows_of(number: int, arm: Arm) -> list[str]:
    """Return the table's lines of a run, which begins with the arm hanging at rest."""
    torques = torques_of(number)
    positions = arm.simulate(np.zeros(4), torques)
    measured = positions + NOISE * np.random.default_rng([61, number]).normal(size=positions.shape)
    return [
        f"{number},{i / RATE:.2f},{u[0]:.4f},{u[1]:.4f},{q[0]:.5f},{q[1]:.5f}"
        for i, (u, q) in enumerate(zip(torques, measured, strict=True))
    ]


def table(friction: float = FRICTION) -> str:
    """Return the recording's table, as in log.csv."""
    lines = ["run,t,u.m_shoulder,u.m_elbow,q.shoulder,q.elbow"]
    for number in RUNS:
        lines += rows_of(number, Arm(friction=friction))
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    (Path(sys.argv[1]) / "log.csv").write_text(table())
