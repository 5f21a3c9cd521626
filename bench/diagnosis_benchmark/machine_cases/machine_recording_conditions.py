"""Recording conditions of a machine case, drawn from a seed.

They are the machine's parameters, runs, commands and noise.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from bench.diagnosis_benchmark.case_generation.recording_conditions import (
    ANY_CONDITIONS,
    NOISE_KINDS,
    RequestedConditions,
    SensorNoise,
    draw_input_signal,
)
from bench.diagnosis_benchmark.machine_cases.machine_dynamics import (
    MACHINES,
    Effects,
    MachineDynamics,
)
from bench.diagnosis_benchmark.machine_cases.machine_simulation import (
    MachineMotion,
    MachineRuns,
    read_encoders,
    simulate_machine,
)
from sims.core.simulator import Array
from sims.systems.servo import Servo as ServoSimulator

ENCODER_NOISE_RANGE = (1e-3, 3e-3)
"""Range of the encoder noise, rad."""
FITTED_RUN_COUNTS = (3, 4, 5)
"""Numbers of runs from which one is drawn."""
RUN_LENGTHS_SECONDS = (2.0, 3.0, 4.0)
"""Lengths of a run from which one is drawn, seconds."""
SAMPLING_RATES_HZ = (50, 100)
"""Sampling rates from which one is drawn, Hz."""
MAX_JOINT_ANGLE = 1.4
"""Maximum joint angle from hanging down, rad; beyond it a small force decides the motion."""
MAX_COMMAND_ATTEMPTS = 8
"""Maximum number of attempts to scale commands down until the joints keep their angle limit."""


@dataclass(frozen=True)
class MachineRecordingConditions:
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
    runs: MachineRuns
    noise: SensorNoise
    rate: int
    seconds: float
    held_out: int

    @property
    def noise_sigmas(self) -> float:
        """Standard deviation of the noise, equal for all channels."""
        return next(iter(self.noise.sigma.values()))

    @property
    def free_parameters(self) -> dict[str, float]:
        """Parameters that the user does not know: none for a robot, whose model file states all."""
        names = SERVO_PARAMETERS if self.system == "servo" else ()
        return {name: self.numbers[name] for name in names}

    @property
    def fitted_runs(self) -> MachineRuns:
        """The runs for fitting."""
        return self.take_first_runs(len(self.runs.q) - self.held_out)

    def take_first_runs(self, count: int) -> MachineRuns:
        """Return the first runs."""
        times, *arrays = self.runs
        return MachineRuns(times, *(array[:count] for array in arrays))

    def make_machine(self, causes: Effects) -> MachineDynamics:
        """Make the machine with hidden causes: effects of the library, or unmodelled ones."""
        return MACHINES[self.system](self.numbers, causes)

    def simulate_readings(self, causes: Effects, coarse: float = 1.0) -> Array:
        """Simulate noise-free encoder readings of the runs for fitting.

        The held-out runs at the end of `runs` are left out.

        Shapes: R runs, T samples, N joints.

        Args:
            causes: hidden causes.
            coarse: factor of the step size; above 1 is faster and less accurate.

        Returns:
            Readings, (R, T, N).
        """
        plant = self.make_machine(causes)
        return read_encoders(
            simulate_machine(plant, self.fitted_runs, coarse), plant, self.runs.times
        )

    @cached_property
    def base_motion(self) -> MachineMotion:
        """Motion of the runs for fitting without hidden causes."""
        return simulate_machine(self.make_machine({}), self.fitted_runs)

    @cached_property
    def motion_scales(self) -> dict[str, Array]:
        """Typical scales of the motion without hidden causes, by quantity; one per joint, (N,).

        Strengths of hidden causes are relative to them. ``force`` (inertia force minus gravity),
        ``speed`` and ``position`` are RMS values, ``travel`` is the mean range of a run,
        ``inertia`` the mean diagonal of the mass matrix.

        Shapes: N joints.
        """
        q, v = self.base_motion.q, self.base_motion.v
        a = np.gradient(v, self.base_motion.times, axis=0)
        runs, joints = q.shape[1:]
        plant, positions = self.make_machine({}), q.reshape(-1, joints)
        inertia = plant.compute_mass_matrix(positions).reshape(len(q), runs, joints, joints)
        inertia_force = np.einsum("klij,klj->kli", inertia, a)
        force = inertia_force - plant.compute_gravity_force(positions).reshape(q.shape)
        return {
            "force": np.sqrt(np.mean(force**2, axis=(0, 1))),
            "speed": np.sqrt(np.mean(v**2, axis=(0, 1))),
            "travel": np.mean(np.ptp(q, axis=0), axis=0),
            "position": np.sqrt(np.mean(q**2, axis=(0, 1))),
            "inertia": np.mean(inertia, axis=(0, 1)).diagonal(),
        }


SERVO_PARAMETERS = ("torque_constant", "resistance", "armature")
"""Names of a servo's parameters, in the order of the simulator."""


def draw_conditions(
    system: str, rng: np.random.Generator, requested: RequestedConditions = ANY_CONDITIONS
) -> MachineRecordingConditions:
    """Draw recording conditions: sampling, the machine's parameters, its runs and the noise.

    Args:
        system: servo or arm2.
        rng: random generator.
        requested: conditions that are given; those that are None are drawn.
    """
    rate, seconds = int(rng.choice(SAMPLING_RATES_HZ)), float(rng.choice(RUN_LENGTHS_SECONDS))
    count = int(rng.choice(FITTED_RUN_COUNTS))
    # These values are drawn in any case, so that later draws do not depend on the request.
    rate, count = requested.rate or rate, requested.runs or count
    times = np.arange(round(rate * seconds)) / rate
    numbers = _draw_servo_parameters(rng) if system == "servo" else _draw_arm_parameters(rng)
    plant = MACHINES[system](numbers, {})
    runs = _draw_runs(plant, times, count, rng)
    sigma = float(np.exp(rng.uniform(*np.log(ENCODER_NOISE_RANGE))))
    noise = SensorNoise(
        dict.fromkeys(plant.channels, sigma),
        requested.noise or str(rng.choice(NOISE_KINDS)),
        phi=float(rng.uniform(0.3, 0.9)),
        dither=float(rng.uniform(0.3, 0.6)),
        stated=bool(rng.random() < 0.5),
    )
    return MachineRecordingConditions(
        system, numbers, runs, noise, rate, seconds, held_out=max(1, count // 3)
    )


def _draw_servo_parameters(rng: np.random.Generator) -> dict[str, float]:
    """Draw the true parameters of the servo of a synthetic recording.

    Diagnosers have to find them, so they differ between recordings. The ranges are those of
    typical servos. Only parameters that diagnosers fit are random; all other constants are those
    of the simulator.

    Args:
        rng: random generator of the case.

    Returns:
        All parameters by name: torque constant in N m/A, resistance in Ohm, inertia of the rotor
        in kg m^2, and the constants of the simulator.
    """
    fitted_parameters = {
        # In N m/A, Ohm and kg m².
        "torque_constant": float(rng.uniform(0.3, 0.8)),
        "resistance": float(rng.uniform(2.5, 6.0)),
        "armature": float(rng.uniform(1e-3, 6e-3)),
    }
    return {c.name: c.value for c in ServoSimulator.constants} | fitted_parameters


def _draw_arm_parameters(rng: np.random.Generator) -> dict[str, float]:
    """Draw the parameters of an arm: masses, centres of mass, inertias, damping and rotor inertias.

    The names end with the number of the link, 1 for the upper arm and 2 for the forearm; ``length``
    is that of the upper arm. The moments of inertia are those of a rod, about m l^2 / 12.

    Args:
        rng: random generator of the case.

    Returns:
        Parameters by name, SI units. ``centre`` is the distance of the centre of mass from the
        joint, and ``armature`` the inertia of the rotor.
    """
    # Lengths of upper arm and forearm in m, and their masses in kg.
    length, outer = rng.uniform(0.25, 0.45), rng.uniform(0.2, 0.35)
    mass1, mass2 = rng.uniform(0.8, 2.0), rng.uniform(0.4, 1.0)
    parameters = {
        "mass1": mass1,
        "centre1": length * rng.uniform(0.4, 0.55),
        "inertia1": mass1 * length**2 * rng.uniform(0.08, 0.11),
        # In N m s/rad, and the rotor's inertia in kg m².
        "damping1": rng.uniform(0.1, 0.4),
        "armature1": rng.uniform(0.005, 0.02),
        "length": length,
        "mass2": mass2,
        "centre2": outer * rng.uniform(0.4, 0.55),
        "inertia2": mass2 * outer**2 * rng.uniform(0.08, 0.11),
        # In N m s/rad, and the rotor's inertia in kg m².
        "damping2": rng.uniform(0.03, 0.12),
        "armature2": rng.uniform(0.002, 0.01),
    }
    # Rounded as the model file states them.
    return {name: float(f"{value:.4g}") for name, value in parameters.items()}


def _draw_runs(
    plant: MachineDynamics, times: Array, count: int, rng: np.random.Generator
) -> MachineRuns:
    """Draw runs whose commands keep the joints within the angle limit.

    Commands are scaled down until the motion stays below `MAX_JOINT_ANGLE`, in at most
    `MAX_COMMAND_ATTEMPTS` attempts; the last commands are used in any case. A servo gets goal
    angles of up to 0.7 rad, an arm torques of up to 1.5 times the gravity torque at 0.4 rad.

    Args:
        plant: the machine without hidden causes.
        times: sample times, s, (T,).
        count: number of runs.
        rng: random generator.

    Returns:
        The runs, which begin at rest at angles within 0.4 rad.
    """
    signal_form = str(rng.choice(["steps", "sine", "chirp"]))
    joints = len(plant.joints)
    signals = np.array(
        [
            [draw_input_signal(signal_form, times, rng, (0.3, 2.0)) for _ in range(joints)]
            for _ in range(count)
        ]
    )
    commands = np.moveaxis(signals, 1, 2)  # (runs, T, joints)
    # Angles in rad.
    initial_positions = rng.uniform(-0.4, 0.4, (count, joints))
    probe_positions = 0.4 * np.ones((1, joints))
    # Amplitude of the commands: rad for a servo, N m for an arm.
    is_servo = plant.motors == ("goal",)
    amplitude = 0.7 if is_servo else np.abs(plant.compute_gravity_force(probe_positions))[0] * 1.5
    # Signals have amplitude 1.
    commands = commands * amplitude * rng.uniform(0.5, 1.0, (count, 1, joints))
    for _ in range(MAX_COMMAND_ATTEMPTS):
        # The initial velocities are zero.
        runs = MachineRuns(times, commands, initial_positions, np.zeros_like(initial_positions))
        # Largest angle of each run, over all steps and joints.
        max_angles = np.abs(simulate_machine(plant, runs, coarse=2.0).q).max(axis=(0, 2))
        if (max_angles <= MAX_JOINT_ANGLE).all():
            break
        # The next motion aims at 70 % of the limit.
        commands = commands * np.minimum(1.0, 0.7 * MAX_JOINT_ANGLE / max_angles)[:, None, None]
    return runs
