"""Recording conditions of benchmark cases, drawn from a seed.

They are true base parameters, runs with inputs, channels, and sensor noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from bench.diagnosis_benchmark.case_generation.input_and_sensor_effects import (
    EffectCoefficients,
    TrueSystem,
)
from sims.core.simulator import Array, Scenario
from sims.system_simulator import SystemSimulator
from sims.systems.ball import Ball
from sims.systems.pendulum import Pendulum
from sims.systems.slider import Slider

SIMULATORS: dict[str, type[SystemSimulator]] = {
    "ball": Ball,
    "pendulum": Pendulum,
    "slider": Slider,
}
"""Simulators by the name of their system."""

GROUND_PARALLEL_EFFECTS = (
    "gravity.tilt",
    "lift.magnus",
    "wind",
    "contact.friction",
    "drag.quadratic",
    "updraft",
    "gust",
)
"""Effects that only the horizontal motion of a ball shows."""

INPUT_DEPENDENT_EFFECTS = ("input.", "backlash", "supply.", "friction.load_")
"""Prefixes of the effects that only an input shows."""

NOISE_KINDS = ("white", "ar1", "quantised")
"""Kinds of sensor noise: white, AR(1), or white before rounding."""

NOISE_RANGES = {
    "ball": (2e-3, 2e-2),
    "pendulum": (1e-3, 1e-2),
    "slider": (1e-3, 1e-2),
}
"""Ranges of the standard deviation of the noise by system, m or rad."""

FREQUENCY_RANGES = {
    "pendulum": (3.0, 10.0),
    "slider": (2.0, 5.0),
}
"""Ranges of the ratio of a rate's noise to the position's, by system, 1/s."""

MAX_RUNS = 6
"""Maximum number of runs."""

PENDULUM = Pendulum(observe=["q"], engine="batch")
"""Simulator that estimates the swing of a drawn pendulum; it generates no data."""

DrawnConditions = tuple[dict[str, float], tuple[str, ...], list[Scenario]]
"""Parameters by name, names of the channels, and runs."""


@dataclass(frozen=True)
class SensorNoise:
    """Sensor noise.

    Attributes:
        sigma: standard deviation by channel.
        kind: white, ar1 or quantised.
        phi: AR(1) coefficient.
        dither: standard deviation of the white noise before rounding, in units of a rounding step.
        stated: whether the recording states the noise.
    """

    sigma: dict[str, float]
    kind: str
    phi: float
    dither: float
    stated: bool = True

    def add_to(self, observed: Array, rng: np.random.Generator) -> Array:
        """Add noise to observations: rounding, autocorrelated noise (AR(1)), or white noise.

        All three have the standard deviation `sigma`. Before the rounding, white noise (dither) is
        added, as a real sensor has it.

        Shapes: T samples, C channels.

        Args:
            observed: noise-free observations, (T, C).
            rng: random generator.

        Returns:
            Noisy observations, (T, C).
        """
        sigma = np.array(list(self.sigma.values()))
        white = rng.standard_normal(observed.shape)
        if self.kind == "quantised":
            # Rounding has the variance step^2 / 12 and the dither (dither step)^2; the step makes
            # their sum sigma^2.
            step = sigma / np.sqrt(1 / 12 + self.dither**2)
            rounded: Array = np.round((observed + self.dither * step * white) / step) * step
            return rounded
        if self.kind == "ar1":  # x[t] = phi x[t-1] + sqrt(1 - phi^2) white noise, of variance 1
            for sample in range(1, len(white)):
                white[sample] = (
                    self.phi * white[sample - 1] + np.sqrt(1 - self.phi**2) * white[sample]
                )
        recorded: Array = observed + sigma * white
        return recorded


@dataclass(frozen=True)
class RecordingConditions:
    """Recording conditions of a case, without the hidden cause.

    Attributes:
        system: name of the system.
        parameters: true base parameters.
        constants: constants of the system.
        channels: names of the recorded channels.
        scenarios: the runs.
        noise: sensor noise.
        rate: sampling rate, Hz.
        seconds: length of a run.
    """

    system: str
    parameters: dict[str, float]
    constants: dict[str, float]
    channels: tuple[str, ...]
    scenarios: tuple[Scenario, ...]
    noise: SensorNoise
    rate: int
    seconds: float

    @property
    def noise_sigmas(self) -> Array:
        """Standard deviation of the noise by channel, (C,)."""
        return np.array([self.noise.sigma[name] for name in self.channels])

    @property
    def is_driven(self) -> bool:
        """True if there is an input."""
        return bool(self.scenarios[0].inputs)

    def make_true_system(self, causes: EffectCoefficients) -> TrueSystem:
        """Make the true system with hidden causes: effects of the library, or unmodelled ones."""
        return TrueSystem(self.system, self.parameters, self.constants, causes)


class RequestedConditions(NamedTuple):
    """Requested recording conditions; those that are None are drawn.

    Attributes:
        rate: sampling rate, Hz.
        runs: number of runs.
        noise: one of `NOISE_KINDS`.
    """

    rate: int | None = None
    runs: int | None = None
    noise: str | None = None


ANY_CONDITIONS = RequestedConditions()
"""Conditions of which all are drawn."""


def draw_conditions(
    system: str,
    rng: np.random.Generator,
    hidden: Sequence[str] = (),
    requested: RequestedConditions = ANY_CONDITIONS,
) -> RecordingConditions:
    """Draw recording conditions in which the hidden effects can be observed.

    Some effects need an input or horizontal motion; conditions without it are not drawn for them.

    Args:
        system: name of the system, such as ``pendulum``.
        rng: random generator.
        hidden: names of the hidden effects.
        requested: conditions that are given; those that are None are drawn.

    Returns:
        True parameters, runs (sample times, initial states and inputs), channels, sensor noise,
        rate (Hz) and length of a run (s).
    """
    # Rate in Hz and length of a run in s.
    rate = int(rng.choice([50, 100, 200], p=[0.3, 0.5, 0.2]))
    seconds = float(rng.choice([2.0, 3.0, 4.0, 5.0, 6.0], p=[0.1, 0.2, 0.4, 0.2, 0.1]))
    runs = int(rng.choice([3, 4, 5, MAX_RUNS], p=[0.25, 0.4, 0.2, 0.15]))
    # These values are drawn in any case, so that later draws do not depend on the request.
    rate, runs = requested.rate or rate, requested.runs or runs
    times = np.arange(round(rate * seconds)) / rate
    draw = {
        "ball": _draw_ball_conditions,
        "pendulum": _draw_pendulum_conditions,
        "slider": _draw_slider_conditions,
    }[system]
    parameters, channels, scenarios = draw(rng, times, runs, hidden)
    noise = _draw_sensor_noise(rng, system, channels)
    noise = replace(noise, kind=requested.noise or noise.kind)
    return RecordingConditions(
        system, parameters, get_constants(system), channels, tuple(scenarios), noise, rate, seconds
    )


def get_constants(system: str, **changed: float) -> dict[str, float]:
    """Return the constants of a system by name.

    Args:
        system: name of the system, such as ``pendulum``.
        **changed: constants with other values.
    """
    return {c.name: c.value for c in SIMULATORS[system].constants} | changed


def _draw_sensor_noise(
    rng: np.random.Generator, system: str, channels: Sequence[str]
) -> SensorNoise:
    """Draw the sensor noise: its size, kind and correlation, and whether the recording states it.

    The size is drawn log-uniformly. The noise of a rate (``qd``, ``v``) is that of the position
    times a frequency, as if the rate were obtained by differentiation.

    Args:
        rng: random generator.
        system: name of the system, such as ``pendulum``.
        channels: names of the recorded channels.
    """
    sigma = float(np.exp(rng.uniform(*np.log(NOISE_RANGES[system]))))
    rate_factor = (
        float(rng.uniform(*FREQUENCY_RANGES[system])) if system in FREQUENCY_RANGES else 1.0
    )
    by_channel = {name: sigma * (rate_factor if name in ("qd", "v") else 1.0) for name in channels}
    kind = str(rng.choice(NOISE_KINDS))
    # Everything is drawn for every kind of noise, in this order, so that later draws do not depend
    # on the kind.
    return SensorNoise(
        by_channel,
        kind,
        phi=float(rng.uniform(0.3, 0.9)),
        dither=float(rng.uniform(0.3, 0.6)),
        stated=bool(rng.random() < 0.5),
    )


def _draw_ball_conditions(
    rng: np.random.Generator, times: Array, runs: int, hidden: Sequence[str]
) -> DrawnConditions:
    """Draw parameters, channels and runs of a ball.

    Three in ten recordings contain only the height of a ball that falls upright, but never if a
    hidden cause needs horizontal motion (`GROUND_PARALLEL_EFFECTS`).

    Args:
        rng: random generator.
        times: sample times, s, (T,).
        runs: number of runs.
        hidden: names of the hidden causes.

    Returns:
        Parameters by name, names of the channels, and the runs.
    """
    # Speeds are in m/s, heights in m.
    is_vertical = not set(hidden) & set(GROUND_PARALLEL_EFFECTS) and rng.random() < 0.3
    speed = 0.0 if is_vertical else 3.0
    parameters, scenarios = {"restitution": float(rng.uniform(0.5, 0.9))}, []
    for _ in range(runs):
        vx, vy = rng.uniform(-speed, speed, 2)
        # Initial height in m, and upward velocity in m/s, which is zero for half of them.
        z, vz = rng.uniform(2.0, 5.0), rng.choice([0.0, rng.uniform(-2.0, 3.0)])
        scenarios.append(
            Scenario(times, {"x": 0.0, "y": 0.0, "z": z, "vx": vx, "vy": vy, "vz": vz})
        )
    return parameters, ("z",) if is_vertical else ("x", "y", "z"), scenarios


def _draw_pendulum_conditions(
    rng: np.random.Generator, times: Array, runs: int, hidden: Sequence[str]
) -> DrawnConditions:
    """Draw parameters, channels and runs of a pendulum.

    Half of the pendulums have an input, and all if a hidden cause is visible only with one. A run
    is drawn again until its largest angle without effects is 0.25 to 2.8 rad: smaller motion shows
    little.

    Args:
        rng: random generator.
        times: sample times, s, (T,).
        runs: number of runs.
        hidden: names of the hidden causes.

    Returns:
        Parameters by name, names of the channels, and the runs.
    """
    # Inertia in kg m².
    parameters = {"inertia": float(rng.uniform(2e-3, 6e-3))}
    driven = any(name.startswith(INPUT_DEPENDENT_EFFECTS) for name in hidden) or rng.random() < 0.5
    # The rate is recorded in 40 % of the recordings.
    channels = ("q",) if rng.random() < 0.6 else ("q", "qd")
    signal_form = str(rng.choice(["steps", "sine", "chirp"]))
    scenarios: list[Scenario] = []
    while len(scenarios) < runs:
        inputs = {}
        if driven:
            amplitude = rng.uniform(0.05, 0.2)  # N m
            inputs["u"] = amplitude * draw_input_signal(signal_form, times, rng, hertz=(0.3, 3.0))
        # Initial rate in rad/s, and angle in rad.
        rate = rng.choice([0.0, rng.uniform(-5.0, 5.0)])
        start = {"q": rng.choice([-1, 1]) * rng.uniform(0.3, 2.5), "qd": rate}
        scenario = Scenario(times, start, inputs)
        swing = PENDULUM.simulate(np.array([[parameters["inertia"]]]), scenario)
        # Beyond the top, the smallest force decides on which side it falls.
        if 0.25 < np.abs(swing).max() < 2.8:
            scenarios.append(scenario)
    return parameters, channels, scenarios


def _draw_slider_conditions(
    rng: np.random.Generator, times: Array, runs: int, hidden: Sequence[str]
) -> DrawnConditions:
    """Draw parameters, channels and runs of a slider, which always has an input.

    The input is scaled so that the slider would travel 0.4 to 2.5 m by it, within 0.5 to 8 N.

    Args:
        rng: random generator.
        times: sample times, s, (T,).
        runs: number of runs.
        hidden: names of the hidden causes; unused here.

    Returns:
        Parameters by name, names of the channels, and the runs.
    """
    parameters = {"mass": float(rng.uniform(0.5, 2.0))}
    # The rate is recorded in 40 % of the recordings.
    channels = ("x",) if rng.random() < 0.6 else ("x", "v")
    signal_form, scenarios = str(rng.choice(["steps", "sine", "chirp"])), []
    for _ in range(runs):
        start = {
            "x": rng.choice([0.0, rng.uniform(-0.5, 0.5)]),
            # Initial velocity in m/s.
            "v": rng.choice([0.0, rng.uniform(-0.3, 0.3)]),
        }
        # Lowest and highest frequency in Hz.
        force = draw_input_signal(signal_form, times, rng, (0.3, 2.0))
        force -= force.mean()  # otherwise the slider drifts away
        # Range of the position for a force of amplitude 1 N, m, by integrating the acceleration
        # twice. The times begin at 0, so times[1] is the sampling interval.
        travel = np.ptp(np.cumsum(np.cumsum(force))) * times[1] ** 2 / parameters["mass"]
        amplitude = np.clip(rng.uniform(0.4, 2.5) / travel, 0.5, 8.0)  # N
        scenarios.append(Scenario(times, start, {"u": force * amplitude}))
    return parameters, channels, scenarios


def draw_input_signal(
    form: str, times: Array, rng: np.random.Generator, hertz: tuple[float, float]
) -> Array:
    """Generate an input signal of amplitude one.

    Args:
        form: steps (between random levels), sine, or chirp (a sine whose frequency increases).
        times: sample times from 0 on, s, (T,).
        rng: random generator.
        hertz: range of frequency, Hz, in which frequencies are drawn log-uniformly.

    Returns:
        Signal, (T,).
    """
    if form == "steps":
        level_duration = rng.uniform(0.25, 1.0)
        level_index = np.floor(times / level_duration).astype(int)
        levels: Array = rng.uniform(-1.0, 1.0, level_index[-1] + 1)[level_index]
        return levels
    log_low, log_high = np.log(hertz)
    # A sine has the lower frequency; a chirp goes from the lower to the higher one.
    low, high = np.sort(np.exp(rng.uniform(log_low, log_high, 2)))
    # Number of cycles up to each time, the integral of the frequency.
    cycles = low * times
    if form == "chirp":
        cycles = cycles + (high - low) * times**2 / (2 * times[-1])
    random_phase = rng.random()  # in cycles
    signal: Array = np.sin(2 * np.pi * (cycles + random_phase))
    return signal
