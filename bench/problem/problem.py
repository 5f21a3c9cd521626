"""An experiment's problem: its simulator, the unit cube of its parameters, the channels observed
and their scale.

`Problem` is rebuilt from the experiment in every process. Targets (`bench.problem.targets`) are
made in the parent process alone, which keeps their true parameters; learned tuners meet the
simulator in `bench.problem.practice`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from bench.problem import targets
from bench.problem.experiment import Experiment
from bench.problem.identifiability import Spectrum, spectrum
from bench.problem.practice import Practice
from bench.problem.recorded import Measured, measured
from bench.problem.robots import completed, kind_of
from bench.problem.targets import Target
from methods.base import Scene
from sims.base import Array, InputError, Scenario, Simulator, UnitCube, adjusted, unknown


class Problem:
    """What an experiment tunes; counts what it simulates.

    Attributes:
        experiment: as it was read.
        simulator: the one that is tuned.
        world: the one that makes the targets; the same where the experiment names no other.
        cube: between the parameters' bounds and the unit cube.
        channels: observed, in order.
        error_channel: index of the one in which errors are reported.
        noise: (C,) 1 sigma of each channel, 0 where unknown.
        scale: (C,) what a residual is divided by: the noise, or the typical magnitude of the
            channel.
        recording: what the experiment's recording holds; None for simulated targets.
        salt: what targets are drawn from.
        simulated: simulations made so far.

    Args:
        experiment: as it was read.
        salt: the secret one, which only the process has that draws the targets; the experiment's
            own where None.
    """

    def __init__(self, experiment: Experiment, salt: str | None = None) -> None:
        if experiment.sweep:
            swept = ", ".join(experiment.sweep)
            remedy = "run those that bench.problem.experiment.expand gives"
            raise InputError(f"experiment {experiment.name}: sweeps over {swept}; {remedy}")
        if experiment.experiments:
            named = ", ".join(experiment.experiments)
            raise InputError(f"experiment {experiment.name}: names {named}; run these")
        self.experiment = experiment = completed(experiment)
        self.simulated = 0
        self.salt = experiment.salt if salt is None else salt

        kind = kind_of(experiment)
        observe = experiment.observe or tuple(c.name for c in kind.channels)
        self.simulator = self._simulator(kind, observe, experiment.settings)
        self.world = self.simulator
        if experiment.world:
            self.world = self._simulator(kind, observe, experiment.world)
            self._check_world()

        self._check_constants()
        self.cube = UnitCube(adjusted(self.simulator.parameters, experiment.parameters))
        self.channels = self.simulator.channels
        self.error_channel = self._channel(experiment.error_channel or self.channels[0].name)

        self.recording: Measured | None = None
        noise = dict(experiment.noise)
        for name in noise:
            self._channel(name)
        if experiment.recording:
            self.recording = measured(experiment.recording.path, self.simulator)
            # What the experiment says stands above what the recording does.
            noise = {**self.recording.noise, **noise}
        self.noise: Array = np.array([noise.get(c.name, 0.0) for c in self.channels])
        # Channels of different units weigh alike: by their noise, else by their usual size.
        typical = [c.scale for c in self.channels]
        self.scale: Array = np.where(self.noise > 0, self.noise, typical)

    def _simulator(
        self, kind: type[Simulator], observe: Sequence[str], settings: Mapping[str, Any]
    ) -> Simulator:
        experiment = self.experiment
        try:
            return kind(constants=experiment.fixed, observe=observe, **settings)
        except TypeError as error:  # a setting that its constructor does not take
            who = f"experiment {experiment.name}: simulator {experiment.simulator}"
            raise InputError(f"{who}: {error}") from None

    def _check_world(self) -> None:
        """Refuse a world whose parameters are not the first of the tuned ones."""
        tuned, made = (
            [parameter.name for parameter in simulator.parameters]
            for simulator in (self.simulator, self.world)
        )
        if made != tuned[: len(made)]:
            raise InputError(
                f"experiment {self.experiment.name}: world: expected none but the first of the "
                f"tuned parameters {', '.join(tuned)}, found {', '.join(made)}; name effects in "
                "fixed = { NAME = COEFFICIENT }"
            )

    def _check_constants(self) -> None:
        """Refuse constants that scenarios would draw and no simulator could have."""
        constants = self.experiment.constants.items()
        ranges = {name: ends for name, ends in constants if isinstance(ends, tuple)}
        for end in range(2):
            drawn = {name: ends[end] for name, ends in ranges.items()}
            self.simulator.run_constants(Scenario(np.zeros(1), constants=drawn))

    def close(self) -> None:
        """Give back what the simulators hold."""
        self.simulator.close()
        self.world.close()

    def _channel(self, name: str) -> int:
        names = [c.name for c in self.channels]
        if name not in names:
            raise unknown("channel", name, names)
        return names.index(name)

    def simulate(self, points: Array, scenarios: tuple[Scenario, ...]) -> Array:
        """Observations (n, T, C) of unit-cube points (n, dim), the scenarios' samples one after
        another.
        """
        self.simulated += len(points)
        theta = self.cube.physical(points)
        if len(scenarios) == 1:  # nothing to join, and joining copies
            return self.simulator.simulate(theta, scenarios[0])
        return np.concatenate([self.simulator.simulate(theta, s) for s in scenarios], axis=1)

    def scenarios(self, rng: np.random.Generator) -> tuple[Scenario, ...]:
        """The recording's training runs, or one run with initial state and inputs drawn as the
        experiment says.
        """
        if self.recording:
            return self.recording.fitting.scenarios
        experiment = self.experiment
        return (targets.scenario(experiment, rng, experiment.initial, experiment.inputs),)

    def scene(self, scenarios: Sequence[Scenario]) -> Scene:
        """What tuners are told; an initial value that a channel shows is the observation's first
        sample.
        """
        shown = {c.name for c in self.channels}
        initial: list[float] = []
        inputs = []
        for scenario in scenarios:
            hidden = {k: v for k, v in scenario.initial.items() if k not in shown}
            # By name, so that a network meets the same number in the same place.
            numbers = sorted({**hidden, **scenario.constants}.items())
            initial += [value for _, value in numbers]
            signals = np.array([values for _, values in sorted(scenario.inputs.items())])
            # A scenario without inputs has T samples of none.
            inputs.append(signals.reshape(-1, scenario.times.size).T)
        return Scene(np.array(initial, dtype=np.float64), np.concatenate(inputs))

    def target(self, kind: str, index: int) -> Target:
        """Target `index` of range `kind`; it depends on the experiment's name, not on tuners, seeds
        or budgets.
        """
        return targets.draw(self, kind, index)

    def targets(self) -> list[Target]:
        """All targets of the experiment; the ranges take turns, so that a part of the work is a
        part of each.
        """
        return [
            self.target(kind, index)
            for index in range(self.experiment.targets)
            for kind in self.experiment.ranges
        ]

    @property
    def identifiable(self) -> bool:
        """Whether there is more than one parameter, and so combinations that data may tell or not,
        and it is asked.
        """
        return self.cube.dim > 1 and self.experiment.identifiability

    def spectrum(self, target: Target) -> Spectrum | None:
        """What the target's data identify, at its truth; of a recording, whose starts share one, at
        the nominal parameters and with the first start. None where nothing is asked.
        """
        again = target.truth is None and target.sealed.name != f"{target.sealed.range}-000"
        if again or not self.identifiable:
            return None
        nominal = np.array([parameter.nominal for parameter in self.cube.parameters])
        at = nominal if target.truth is None else target.truth
        scenarios = target.sealed.fitting.scenarios

        def simulate(theta: Array) -> Array:
            # Beside `self.simulate`: what is asked here is no part of any budget.
            return np.concatenate([self.simulator.simulate(theta, s) for s in scenarios], axis=1)

        return spectrum(simulate, at, self.cube.parameters, self.scale)

    def outside(self, truth: Array) -> float:
        """How far `truth` (dim,) lies outside the training range: the largest distance, in
        training-range widths.
        """
        ranges = np.array([p.training_range for p in self.cube.parameters])
        # One of the two is positive outside, both are negative inside.
        beyond = np.maximum(ranges[:, 0] - truth, truth - ranges[:, 1])
        return float(max(0.0, (beyond / self.cube.training_widths()).max()))

    def practice(self, budget: int) -> Practice:
        """The simulator as a learned tuner may use it while training."""
        return Practice(self, budget)
