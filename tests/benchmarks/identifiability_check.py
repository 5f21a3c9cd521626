"""Measure whether the identifiability check is right.

``python -m tests.benchmarks.identifiability_check [--count 200]``

Problems are random: a pendulum, slider, servo or two-joint arm with some unknown numbers, and with
random strengths of input and noise. For a number that the check calls identifiable, the interval
must contain the true value in 90 to 98 of 100 problems. Otherwise three tuners fit the number for
three robots that differ in this number only, and it counts as fixed if every estimate is within a
tenth of its range.
"""

import argparse
import tempfile
from pathlib import Path

import numpy as np

from bench.core.plugin_registries import make_robot_simulator
from bench.diagnosis.evaluation.noise_model import NoiseModel
from bench.diagnosis.evaluation.run_evaluator import RunEvaluator
from bench.diagnosis.fitting.base_fit import find_start_with_tuner, fit_base_model
from bench.diagnosis.fitting.trajectory_derivatives import compute_central_jacobian
from bench.diagnosis.identifiability import assess_identifiability
from sims.core.simulator import Scenario
from sims.recording.recording import Recording, Run
from sims.systems.pendulum import Pendulum
from sims.systems.servo import Servo
from sims.systems.slider import Slider

TUNERS = ("nelder_mead", "cma_es", "least_squares")
FIXED = 0.1  # Fraction of a number's range.
VALUES = 3  # Number of values of a number that is not identifiable.
TIMES = np.arange(120) / 40.0
SYSTEMS = {
    "pendulum": (Pendulum, "q", ((), ("mass",), ("length",), ("mass", "gravity"))),
    "slider": (Slider, "x", ((),)),
    "servo": (Servo, "q", ((), ("mass",), ("length",), ("voltage",))),
}
FREE = (
    ("mass.scale@forearm",), ("drag.linear@elbow", "drag.linear@shoulder"),
    ("actuator.stiffness@*",), ("inertia.scale@upper_arm", "mass.scale@upper_arm"),
    ("inertia.armature@*", "mass.scale@forearm"), ("spring.linear@elbow", "friction.coulomb@elbow"),
)  # fmt: skip
ARM = """
<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody>
<body name="upper_arm" pos="0 0 1"><joint name="shoulder" axis="0 1 0" damping="0.1"/>
<inertial pos="0 0 -0.2" mass="1.2" diaginertia="0.02 0.02 0.002"/>
<body name="forearm" pos="0 0 -0.4"><joint name="elbow" axis="0 1 0" damping="0.05"/>
<inertial pos="0 0 -0.17" mass="0.8" diaginertia="0.01 0.01 0.001"/></body></body></worldbody>
<actuator><position name="m_shoulder" joint="shoulder" kp="60" kv="3"/>
<position name="m_elbow" joint="elbow" kp="30" kv="1.5"/></actuator></mujoco>
"""


class Problem:
    """A random problem: motion, noise and unknown numbers."""

    def __init__(self, rng, arm):
        self.system = str(rng.choice([*SYSTEMS, "arm"]))
        self.strength = 10.0 ** rng.uniform(-2.5, 0)
        self.noise = 10.0 ** rng.uniform(-3.5, -2)
        self.seed = int(rng.integers(2**31))
        if self.system == "arm":
            self.free = FREE[rng.integers(len(FREE))]
            self.kind, self.channels = (
                make_robot_simulator(arm, free=self.free),
                ("q.shoulder", "q.elbow"),
            )
        else:
            self.kind, channel, choices = SYSTEMS[self.system]
            self.channels, self.free = (channel,), choices[rng.integers(len(choices))]
        self.parameters = self.kind.system.parameters
        self.true_parameters = self.drawn(rng)

    def drawn(self, rng):
        """Draw values of parameters and of free constants, by name."""
        values = {}
        for p in self.parameters:
            low, high = p.training or p.bounds
            values[p.name] = float(rng.uniform(low, high))
        for constant in self.kind.system.constants:
            share = rng.uniform(0.8, 1.25) if constant.name in self.free else 1.0
            values[constant.name] = constant.value * share
        return values

    def recording(self, true_parameters):
        """Return two runs with motion and noise."""
        rng = np.random.default_rng(self.seed)
        names = [p.name for p in self.parameters]
        constants = {k: v for k, v in true_parameters.items() if k not in names}
        simulator = self.kind(constants, self.channels)
        runs = []
        for number in range(2):
            inputs = self.inputs(simulator, rng)
            begin = {next(iter(simulator.states)): self.strength * rng.uniform(-0.5, 0.5)}
            theta = np.array([[true_parameters[name] for name in names]])
            seen = simulator.simulate(theta, Scenario(TIMES, begin, inputs))[0]
            seen = seen + self.noise * rng.standard_normal(seen.shape)
            channels = dict(zip(self.channels, seen.T, strict=True))
            runs.append(Run(str(number), TIMES, channels, inputs, {}, {}, held_out=False))
        noise = dict.fromkeys(self.channels, self.noise)
        return Recording(Path("x.csv"), self.kind.system.name, "", {}, noise, tuple(runs))

    def inputs(self, simulator, rng):
        given = {}
        for channel in simulator.inputs:
            name, wave = channel.name, np.zeros(TIMES.size)
            if name == "torque_enable":
                wave = wave + 1.0
            elif not name.startswith("force."):
                for _ in range(3):
                    rate, phase = rng.uniform(0.5, 6), rng.uniform(0, 6)
                    wave = wave + np.sin(rate * TIMES + phase) - np.sin(phase)
                wave *= self.strength * (0.1 if self.system == "pendulum" else 0.5)
            given[name] = wave
        return given

    def world(self, true_parameters):
        """Return the evaluator of the recording, as in explain, and its noise model."""
        recording = self.recording(true_parameters)
        free = () if self.system == "arm" else self.free
        engine = self.kind.default_engine if self.kind.own_engine else "batch"
        world = RunEvaluator(self.kind, recording, recording.runs, engine, (), free)
        return world, NoiseModel(
            np.full(len(self.channels), self.noise), np.zeros(len(self.channels))
        )


def answered(problem, rng):
    """Return (level, whether its interval contains the true value or it is fixed) of each free
    number."""
    world, noise = problem.world(problem.true_parameters)
    fit = compute_central_jacobian(world, fit_base_model(world, noise).fit, noise)
    places = {world.parameters[i].name: i for i in world.base_indices}
    rows = []
    for number in assess_identifiability(world, noise, fit):
        if not number.free:
            continue
        place = places[number.name]
        true_parameters = problem.true_parameters[number.name]
        if number.word == "identifiable" or number.word == "weak":
            rows.append((number.word, abs(fit.theta[place] - true_parameters) < number.half))
        else:
            rows.append((number.word, is_fixed(problem, number, rng)))
    world.close()
    return rows


def is_fixed(problem, number, rng):
    """Return whether every tuner finds each of several values of a number."""
    name, near = number.name, FIXED * (number.high - number.low)
    for value in range(VALUES):
        # Draw from the whole range: an insensitive number stays near its nominal value.
        true_parameters = {
            **problem.true_parameters,
            name: float(rng.uniform(number.low, number.high)),
        }
        world, noise = problem.world(true_parameters)
        (place,) = (k for k, i in enumerate(world.base_indices) if world.parameters[i].name == name)
        for tuner in TUNERS:
            found = find_start_with_tuner(tuner, world, noise, value)[place]
            if abs(found - true_parameters[name]) > near:
                world.close()
                return False
        world.close()
    return True


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--count", type=int, default=200)
    options = parser.parse_args()
    rng = np.random.default_rng(17)
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        arm = Path(folder) / "arm.xml"
        arm.write_text(ARM)
        for _ in range(options.count):
            problem = Problem(rng, arm)
            rows += [(problem.system, *row) for row in answered(problem, rng)]
    for word in ("identifiable", "weak", "not identifiable"):
        for system in (*SYSTEMS, "arm", "all"):
            own = [ok for s, w, ok in rows if w == word and system in (s, "all")]
            said = "fixed all the same" if word.startswith("not") else "intervals hold"
            if own:
                share = 100 * np.mean(own)
                print(f"{word}, {system}: {len(own)} numbers, {said}: {sum(own)} ({share:.1f} %)")


if __name__ == "__main__":
    main()
