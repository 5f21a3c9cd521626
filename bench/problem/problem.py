"""An experiment's problem: its simulator, its targets with their truth sealed away, its practice
ground.

`Problem` is rebuilt from the experiment in every process. Targets are made in the parent process
alone, which keeps their true parameters; workers get `SealedTarget`s.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from bench.problem.experiment import Experiment
from bench.problem.identifiability import Spectrum, spectrum
from bench.problem.recorded import Side, measured
from bench.problem.seeds import rng_for
from bench.problem.signals import signal
from bench.registry import simulators
from methods.base import BudgetExceededError, Scene
from sims.base import Array, InputError, Scenario, Simulator, UnitCube, adjusted, unknown


@dataclass(frozen=True)
class SealedTarget:
    """A target without its truth, as a worker process gets it.

    Attributes:
        name: e.g. ``wide-017``.
        range: in, wide or real.
        start: (dim,) where tuners start, unit cube.
        fitting: what the tuner may see.
        held_out: what only measures; without runs where nothing is held out.
    """

    name: str
    range: str
    start: Array
    fitting: Side
    held_out: Side


@dataclass(frozen=True)
class Target:
    """A sealed target and, in the parent process only, its true parameters (dim,), physical; None
    where unknown.
    """

    sealed: SealedTarget
    truth: Array | None


class Problem:
    """What an experiment tunes: simulator, unit cube, observed channels and their scale; counts
    what it simulates.
    """

    def __init__(self, experiment: Experiment) -> None:
        self.experiment = experiment
        self.simulated = 0
        kind = simulators.get(experiment.simulator)
        observe = experiment.observe or tuple(c.name for c in kind.channels)
        self.simulator = self._simulator(kind, observe, experiment.settings)
        self._world = (
            self._simulator(kind, observe, experiment.world) if experiment.world else self.simulator
        )
        self.cube = UnitCube(adjusted(self.simulator.parameters, experiment.parameters))
        self.channels = self.simulator.channels
        self.error_channel = self._channel(experiment.error_channel or self.channels[0].name)
        noise = dict(experiment.noise)
        for name in noise:
            self._channel(name)
        self._measured = None
        if experiment.recording:
            self._measured = measured(experiment.recording.path, self.simulator)
            noise = {**self._measured.noise, **noise}
        self.noise: Array = np.array([noise.get(c.name, 0.0) for c in self.channels])
        self.scale: Array = np.where(self.noise > 0, self.noise, [c.scale for c in self.channels])

    def _simulator(
        self, kind: type[Simulator], observe: Sequence[str], settings: Mapping[str, Any]
    ) -> Simulator:
        experiment = self.experiment
        try:
            return kind(constants=experiment.fixed, observe=observe, **settings)
        except TypeError as error:
            raise InputError(
                f"experiment {experiment.name}: simulator {experiment.simulator}: {error}"
            ) from None

    def close(self) -> None:
        """Give back what the simulators hold."""
        self.simulator.close()
        self._world.close()

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
        if len(scenarios) == 1:
            return self.simulator.simulate(theta, scenarios[0])
        return np.concatenate([self.simulator.simulate(theta, s) for s in scenarios], axis=1)

    def scenarios(self, rng: np.random.Generator) -> tuple[Scenario, ...]:
        """The recording's training runs, or one run with initial state and inputs drawn as the
        experiment says.
        """
        if self._measured:
            return self._measured.fitting.scenarios
        return (self._scenario(rng, self.experiment.initial, self.experiment.inputs),)

    def _scenario(
        self,
        rng: np.random.Generator,
        initial: Mapping[str, float | tuple[float, float]],
        inputs: Mapping[str, str],
    ) -> Scenario:
        sampling = self.experiment.sampling
        start = {k: rng.uniform(*v) if isinstance(v, tuple) else v for k, v in initial.items()}
        times = np.arange(sampling.samples) / sampling.rate
        signals = {name: signal(text, times, rng) for name, text in inputs.items()}
        drawn = {
            k: rng.uniform(*v) for k, v in self.experiment.constants.items() if isinstance(v, tuple)
        }
        return Scenario(times, start, signals, drawn)

    def scene(self, scenarios: Sequence[Scenario]) -> Scene:
        """What tuners are told; an initial value that a channel shows is the observation's first
        sample.
        """
        shown = {c.name for c in self.channels}
        known = [
            {**{k: v for k, v in s.initial.items() if k not in shown}, **s.constants}
            for s in scenarios
        ]
        initial = [v for numbers in known for _, v in sorted(numbers.items())]
        inputs = [
            np.array([v for _, v in sorted(s.inputs.items())]).reshape(-1, s.times.size).T
            for s in scenarios
        ]
        return Scene(np.array(initial, dtype=np.float64), np.concatenate(inputs))

    def _held_out(self, theta: Array, names: tuple[str, str, int]) -> Side:
        """Unseen scenarios, and what the target's world does in them, without sensor noise: what is
        to be predicted.

        Args:
            theta: (1, p) the target's parameters.
            names: of the target, on which the scenarios depend and on nothing else.
        """
        experiment, wanted = self.experiment, self.experiment.held_out
        if wanted is None:
            return Side((), np.empty((0, len(self.channels))))
        initial, inputs = (
            {**experiment.initial, **wanted.initial},
            {**experiment.inputs, **wanted.inputs},
        )
        drawn = [
            self._scenario(rng_for(*names, "held-out", i), initial, inputs)
            for i in range(wanted.scenarios)
        ]
        return Side(
            tuple(drawn), np.concatenate([self._world.simulate(theta, s)[0] for s in drawn])
        )

    def target(self, kind: str, index: int) -> Target:
        """Target `index` of range `kind`; it depends on the experiment's name, not on tuners, seeds
        or budgets.
        """
        met = self.experiment.same_targets_as or self.experiment.name
        rng = rng_for(met, "target", kind, index)
        box = np.array([[0.0], [1.0]]) if kind == "wide" else self.cube.training
        draw = rng.uniform(box[0], box[1], size=(2, self.cube.dim))
        start, truth = draw[0], draw[1]
        name = f"{kind}-{index:03d}"
        if self._measured:
            return Target(
                SealedTarget(name, kind, start, self._measured.fitting, self._measured.held_out),
                None,
            )
        scenarios = self.scenarios(rng)
        theta = self.cube.physical(truth[None])[:, : len(self._world.parameters)]
        observed = self._world.simulate(theta, scenarios[0])[0]
        observed = observed + self.noise * rng.standard_normal(observed.shape)
        held_out = self._held_out(theta, (met, kind, index))
        return Target(
            SealedTarget(name, kind, start, Side(scenarios, observed), held_out),
            self.cube.physical(truth),
        )

    @property
    def identifiable(self) -> bool:
        """Whether there is more than one parameter, and so combinations that data may tell or not,
        and it is asked.
        """
        return self.cube.dim > 1 and self.experiment.identifiability

    def spectrum(self, target: Target) -> Spectrum | None:
        """What the target's data identify; None where the truth is unknown or nothing is asked."""
        if target.truth is None or not self.identifiable:
            return None
        scenarios = target.sealed.fitting.scenarios

        def simulate(theta: Array) -> Array:
            return np.concatenate([self.simulator.simulate(theta, s) for s in scenarios], axis=1)

        return spectrum(simulate, target.truth, self.cube.parameters, self.scale)

    def targets(self) -> list[Target]:
        """All targets of the experiment; the ranges take turns, so that a part of the work is a
        part of each.
        """
        return [
            self.target(kind, i)
            for i in range(self.experiment.targets)
            for kind in self.experiment.ranges
        ]

    def outside(self, truth: Array) -> float:
        """How far `truth` (dim,) lies outside the training range: the largest distance, in
        training-range widths.
        """
        ranges = np.array([p.training_range for p in self.cube.parameters])
        beyond = np.maximum(ranges[:, 0] - truth, truth - ranges[:, 1])
        return float(max(0.0, (beyond / self.cube.training_widths()).max()))

    def practice(self, budget: int) -> Practice:
        """The simulator as a learned tuner may use it while training."""
        return Practice(self, budget)


class Practice:
    """The practice ground of learned tuners; see `methods.base.Practice`."""

    def __init__(self, problem: Problem, budget: int) -> None:
        self._problem = problem
        self.dim = problem.cube.dim
        self.training = problem.cube.training
        self.scale = problem.scale
        self.used = 0
        self.budget = budget
        scenarios = problem.scenarios(np.random.default_rng(0))
        self.lengths = tuple(s.times.size for s in scenarios)
        self.scene = problem.scene(scenarios)

    def sample(self, rng: np.random.Generator, n: int) -> Array:
        """(n, dim) parameters drawn uniformly from the training range, unit cube."""
        return rng.uniform(self.training[0], self.training[1], size=(n, self.dim))

    def simulate(self, rng: np.random.Generator, points: Array) -> Array:
        """Observations (n, T, C) of `points` (n, dim), all in one scenario drawn by `rng`; told by
        `scene`.
        """
        points = np.asarray(points, dtype=np.float64)
        slack = 1e-9
        if not ((points >= self.training[0] - slack) & (points <= self.training[1] + slack)).all():
            raise ValueError(
                "a learned tuner may only simulate inside the training range while it trains"
            )
        if self.used + len(points) > self.budget:
            raise BudgetExceededError(
                f"{self.used + len(points)} training simulations asked, {self.budget} allowed"
            )
        self.used += len(points)
        scenarios = self._problem.scenarios(rng)
        self.scene = self._problem.scene(scenarios)
        return self._problem.simulate(points, scenarios)
