"""Recording conditions of a machine case, drawn from a seed.

They are the machine's parameters, runs, commands and noise.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from bench.diagnosis.worlds.machines.motion import Motion, Runs, moved, read
from bench.diagnosis.worlds.machines.plants import PLANTS, Effects, Plant
from bench.diagnosis.worlds.settings import ANY, NOISES, Circumstances, Noise, wave
from sims.base import Array
from sims.servo.simulator import Servo as ServoSimulator

SIGMA = (1e-3, 3e-3)
"""Range of the encoder noise, rad."""
FITTED_OF = (3, 4, 5)
"""Numbers of runs from which one is drawn."""
SECONDS = (2.0, 3.0, 4.0)
"""Lengths of a run from which one is drawn, seconds."""
RATES = (50, 100)
"""Sampling rates from which one is drawn, Hz."""
FARTHEST = 1.4
"""Maximum joint angle from hanging down, rad; beyond it a small force decides the motion."""
TRIES = 8
"""Maximum number of attempts to scale commands down until the joints keep their angle limit."""


@dataclass(frozen=True)
class Setting:
    """Recording conditions of a machine case, without the hidden cause.

    Attributes:
        system: servo or arm2.
        numbers: parameters of the machine, by name.
        runs: the runs.
        noise: encoder noise.
        rate: sampling rate, Hz.
        seconds: length of a run.
        held_out: number of held-out runs; they are the last ones.
    """

    system: str
    numbers: Mapping[str, float]
    runs: Runs
    noise: Noise
    rate: int
    seconds: float
    held_out: int

    @property
    def sigma(self) -> float:
        """Standard deviation of the noise, equal for all channels."""
        return next(iter(self.noise.sigma.values()))

    @property
    def parameters(self) -> dict[str, float]:
        """Parameters that the user does not know: none for a robot, whose model file states all."""
        names = SERVO if self.system == "servo" else ()
        return {name: self.numbers[name] for name in names}

    @property
    def fitted(self) -> Runs:
        """The runs for fitting."""
        return self.some(len(self.runs.q) - self.held_out)

    def some(self, count: int) -> Runs:
        """Return the first runs."""
        commands, q, v = (part[:count] for part in self.runs[1:])
        return Runs(self.runs.times, commands, q, v)

    def plant(self, effects: Effects | None = None, foreign: Effects | None = None) -> Plant:
        """Make the machine with hidden causes.

        Args:
            effects: hidden effects of the library.
            foreign: hidden unmodelled causes.
        """
        return PLANTS[self.system](self.numbers, effects or {}, foreign or {})

    def seen(
        self, effects: Effects | None = None, foreign: Effects | None = None, coarse: float = 1.0
    ) -> Array:
        """Simulate noise-free encoder readings of the runs for fitting.

        Args:
            effects: hidden effects of the library.
            foreign: hidden unmodelled causes.
            coarse: factor of the step size.

        Returns:
            Readings, (R, T, N).
        """
        plant = self.plant(effects, foreign)
        return read(moved(plant, self.fitted, coarse), plant, self.runs.times)

    @cached_property
    def bare(self) -> Motion:
        """Motion of the runs for fitting without hidden causes."""
        return moved(self.plant(), self.fitted)

    @cached_property
    def typical(self) -> dict[str, Array]:
        """Scales of the motion without hidden causes, by quantity; one value per joint, (N,)."""
        q, v = self.bare.q, self.bare.v
        a = np.gradient(v, self.bare.times, axis=0)
        lanes, joints = q.shape[1:]
        inertia = self.plant().inertia(q.reshape(-1, joints)).reshape(len(q), lanes, joints, joints)
        force = np.einsum("klij,klj->kli", inertia, a)
        force = force - self.plant().weight(q.reshape(-1, joints)).reshape(q.shape)
        return {
            "force": np.sqrt(np.mean(force**2, axis=(0, 1))),
            "speed": np.sqrt(np.mean(v**2, axis=(0, 1))),
            "travel": np.mean(np.ptp(q, axis=0), axis=0),
            "position": np.sqrt(np.mean(q**2, axis=(0, 1))),
            "inertia": np.mean(inertia, axis=(0, 1)).diagonal(),
        }


SERVO = ("torque_constant", "resistance", "armature")
"""Names of a servo's parameters, in the order of the simulator."""


def setting(system: str, rng: np.random.Generator, asked: Circumstances = ANY) -> Setting:
    """Draw recording conditions.

    Args:
        system: servo or arm2.
        rng: random generator.
        asked: conditions that are not drawn.
    """
    rate, seconds = int(rng.choice(RATES)), float(rng.choice(SECONDS))
    count = int(rng.choice(FITTED_OF))
    # These values are drawn in any case, so that later draws do not depend on the request.
    rate, count = asked.rate or rate, asked.runs or count
    times = np.arange(round(rate * seconds)) / rate
    numbers = _servo(rng) if system == "servo" else _arm(rng)
    plant = PLANTS[system](numbers, {}, {})
    runs = _runs(plant, times, count, rng)
    sigma = float(np.exp(rng.uniform(*np.log(SIGMA))))
    noise = Noise(
        dict.fromkeys(plant.channels, sigma),
        asked.noise or str(rng.choice(NOISES)),
        float(rng.uniform(0.3, 0.9)),
        float(rng.uniform(0.3, 0.6)),
        bool(rng.random() < 0.5),
    )
    return Setting(system, numbers, runs, noise, rate, seconds, max(1, count // 3))


def _servo(rng: np.random.Generator) -> dict[str, float]:
    drawn = {
        "torque_constant": float(rng.uniform(0.3, 0.8)),
        "resistance": float(rng.uniform(2.5, 6.0)),
        "armature": float(rng.uniform(1e-3, 6e-3)),
    }
    return {c.name: c.value for c in ServoSimulator.constants} | drawn


def _arm(rng: np.random.Generator) -> dict[str, float]:
    length, outer = rng.uniform(0.25, 0.45), rng.uniform(0.2, 0.35)
    mass1, mass2 = rng.uniform(0.8, 2.0), rng.uniform(0.4, 1.0)
    numbers = {
        "mass1": mass1,
        "centre1": length * rng.uniform(0.4, 0.55),
        "inertia1": mass1 * length**2 * rng.uniform(0.08, 0.11),
        "damping1": rng.uniform(0.1, 0.4),
        "armature1": rng.uniform(0.005, 0.02),
        "length": length,
        "mass2": mass2,
        "centre2": outer * rng.uniform(0.4, 0.55),
        "inertia2": mass2 * outer**2 * rng.uniform(0.08, 0.11),
        "damping2": rng.uniform(0.03, 0.12),
        "armature2": rng.uniform(0.002, 0.01),
    }
    # Rounded as the model file states them.
    return {name: float(f"{value:.4g}") for name, value in numbers.items()}


def _runs(plant: Plant, times: Array, count: int, rng: np.random.Generator) -> Runs:
    """Draw runs whose commands keep the joints within the angle limit."""
    form = str(rng.choice(["steps", "sine", "chirp"]))
    joints = len(plant.joints)
    waves = np.array(
        [[wave(form, times, rng, (0.3, 2.0)) for _ in range(joints)] for _ in range(count)]
    )
    commands = np.moveaxis(waves, 1, 2)
    begun = rng.uniform(-0.4, 0.4, (count, joints))
    turned = 0.4 * np.ones((1, joints))
    size = 0.7 if plant.motors == ("goal",) else np.abs(plant.weight(turned))[0] * 1.5
    commands = commands * size * rng.uniform(0.5, 1.0, (count, 1, joints))
    for _ in range(TRIES):
        runs = Runs(times, commands, begun, np.zeros_like(begun))
        farthest = np.abs(moved(plant, runs, coarse=2.0).q).max(axis=(0, 2))
        if (farthest <= FARTHEST).all():
            break
        commands = commands * np.minimum(1.0, 0.7 * FARTHEST / farthest)[:, None, None]
    return runs
