"""Targets: scenarios and observations whose true parameters are sealed from the tuners.

A target's numbers are drawn from streams of its own (`bench.problem.salt`), in a fixed order: start
and truth, initial state, inputs, constants, sensor noise. Whatever is drawn in another order is
another target.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from bench.problem.experiment import Drawn, Experiment
from bench.problem.recorded import Measured, Side
from bench.problem.salt import Streams
from bench.problem.signals import signal
from sims.base import Array, Channel, Scenario, Simulator, UnitCube

_CUBE = np.array([[0.0], [1.0]])
"""Corners of the unit cube, in as many dimensions as there are."""


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


class Drawing(Protocol):
    """What targets are drawn of, as `bench.problem.problem.Problem` is.

    Attributes:
        experiment: as it was read.
        world: the simulator that makes the targets.
        cube: between bounds and unit cube.
        channels: observed, in order.
        noise: (C,) 1 sigma of each channel.
        recording: what the experiment's recording holds; None for simulated targets.
        salt: what targets are drawn from.
    """

    experiment: Experiment
    salt: str
    world: Simulator
    cube: UnitCube
    channels: tuple[Channel, ...]
    noise: Array
    recording: Measured | None

    def scenarios(self, rng: np.random.Generator) -> tuple[Scenario, ...]:
        """Those of one target."""


def draw(problem: Drawing, kind: str, index: int) -> Target:
    """Target `index` of range `kind`; it depends on the experiment's name, not on tuners, seeds or
    budgets.
    """
    # No tuner, seed or budget in the stream's name: all tuners meet the same target.
    met = problem.experiment.same_targets_as or problem.experiment.name
    streams = Streams(problem.salt, met, kind, index)
    box = _CUBE if kind == "wide" else problem.cube.training
    start, truth = (
        streams.of(what).uniform(box[0], box[1], size=problem.cube.dim)
        for what in ("start", "truth")
    )
    name = f"{kind}-{index:03d}"
    recording = problem.recording
    if recording:
        return Target(SealedTarget(name, kind, start, recording.fitting, recording.held_out), None)
    scenarios = problem.scenarios(
        streams.of("scenario")
    )  # a single one: several runs come from recordings
    # The world's own parameters are the first of those that are tuned.
    theta = problem.cube.physical(truth[None])[:, : len(problem.world.parameters)]
    clean = problem.world.simulate(theta, scenarios[0])[0]
    observed = clean + problem.noise * streams.of("noise").standard_normal(clean.shape)
    fitting = Side(scenarios, observed)
    held_out = _held_out(problem, theta, streams)
    sealed = SealedTarget(name, kind, start, fitting, held_out)
    return Target(sealed, problem.cube.physical(truth))


def scenario(
    experiment: Experiment,
    rng: np.random.Generator,
    initial: Mapping[str, Drawn],
    inputs: Mapping[str, str],
) -> Scenario:
    """One run as the experiment samples it.

    Args:
        experiment: has the sampling and the constants.
        rng: draws what is given as a range.
        initial: initial state.
        inputs: texts of signals.
    """
    sampling = experiment.sampling
    start = {name: _drawn(rng, value) for name, value in initial.items()}
    times = np.arange(sampling.samples) / sampling.rate
    signals = {name: signal(text, times, rng) for name, text in inputs.items()}
    # Those that are the same in every scenario are the simulator's own.
    ranges = {name: v for name, v in experiment.constants.items() if isinstance(v, tuple)}
    constants = {name: _drawn(rng, value) for name, value in ranges.items()}
    return Scenario(times, start, signals, constants)


def _drawn(rng: np.random.Generator, value: Drawn) -> float:
    return rng.uniform(*value) if isinstance(value, tuple) else value


def _held_out(problem: Drawing, theta: Array, target: Streams) -> Side:
    """Unseen scenarios, and what the target's world does in them, without sensor noise: what is to
    be predicted.

    Args:
        problem: the experiment's.
        theta: (1, p) the target's parameters.
        target: its streams, on which the scenarios depend and on nothing else.
    """
    experiment, wanted = problem.experiment, problem.experiment.held_out
    if wanted is None:
        return Side((), np.empty((0, len(problem.channels))))
    initial = {**experiment.initial, **wanted.initial}
    inputs = {**experiment.inputs, **wanted.inputs}
    # A stream for each: more of them leave the first as they are.
    streams = [target.held_out(i) for i in range(wanted.scenarios)]
    scenarios = tuple(scenario(experiment, rng, initial, inputs) for rng in streams)
    observed = [problem.world.simulate(theta, each)[0] for each in scenarios]
    return Side(scenarios, np.concatenate(observed))
