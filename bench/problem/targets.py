"""Targets: scenarios and observations whose true parameters are sealed from the tuners.

A target's numbers are drawn from streams of its own (`bench.problem.salt`), in a fixed order: start
and truth, initial state, inputs, constants, sensor noise. Whatever is drawn in another order is
another target.

A target whose own simulation diverges cannot be used to compare tuners. The whole target is drawn
again from random streams that are named after the number of the draw. So the same salt gives the
same targets, in any process and in any order.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np

from bench.problem.experiment import Drawn, Experiment
from bench.problem.recorded import Measured, Side
from bench.problem.salt import Streams
from bench.problem.signals import signal
from sims.base import Array, Channel, InputError, Scenario, Simulator, UnitCube

_CUBE = np.array([[0.0], [1.0]])
"""Corners of the unit cube, in as many dimensions as there are."""
DIVERGENCE_LIMIT = 1e12
"""Largest magnitude of a sample, in units of its channel's typical magnitude: beyond it a
simulation counts as diverged although its numbers are finite.
"""
MAX_DRAWS = 200
"""Maximum number of draws of one target."""
MAX_FAILED_SHARE = 0.9
"""Largest share of draws that may diverge: the rest would not be a sample of the ranges."""


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

    Attributes:
        sealed: what a worker process gets.
        truth: (dim,) the true parameters.
        redraws: draws that were discarded because their simulation diverged.
    """

    sealed: SealedTarget
    truth: Array | None
    redraws: int = 0


class Redraws(NamedTuple):
    """How many targets had to be drawn again.

    Attributes:
        redrawn: targets whose first draw diverged.
        draws: draws of all targets together.
    """

    redrawn: int
    draws: int


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
    """Draw target `index` of range `kind`, again where its simulation diverges.

    It depends on the experiment's name, not on tuners, seeds or budgets.

    Raises:
        InputError: all of `MAX_DRAWS` draws diverge.
    """
    for number in range(MAX_DRAWS):
        target = _draw(problem, kind, index, number)
        if target is not None:
            return target
    raise _diverging(problem.experiment, MAX_DRAWS, MAX_DRAWS)


def redraws_of(experiment: Experiment, drawn: Sequence[Target]) -> Redraws:
    """Count the draws of all targets.

    Raises:
        InputError: more than `MAX_FAILED_SHARE` of them diverged.
    """
    failed = sum(target.redraws for target in drawn)
    draws = failed + len(drawn)
    if failed > MAX_FAILED_SHARE * draws:
        raise _diverging(experiment, failed, draws)
    return Redraws(sum(target.redraws > 0 for target in drawn), draws)


def _diverging(experiment: Experiment, failed: int, draws: int) -> InputError:
    return InputError(
        f"experiment {experiment.name}: the simulation of {failed} of {draws} targets drawn "
        f"diverges (not finite, or beyond {DIVERGENCE_LIMIT:g} times a channel's typical "
        f"magnitude); expected at most {MAX_FAILED_SHARE:.0%}: narrow the bounds and training "
        "ranges in [parameters], or choose a smaller time step in [settings]"
    )


def _draw(problem: Drawing, kind: str, index: int, number: int) -> Target | None:
    """Make one draw; None where the simulation diverges."""
    # No tuner, seed or budget in the stream's name: all tuners meet the same target.
    met = problem.experiment.same_targets_as or problem.experiment.name
    again = ("redraw", number) if number else ()
    streams = Streams(problem.salt, met, kind, index, *again)
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
    if any(_diverges(each, problem.channels) for each in (clean, held_out.observed)):
        return None
    sealed = SealedTarget(name, kind, start, fitting, held_out)
    return Target(sealed, problem.cube.physical(truth), number)


def _diverges(observed: Array, channels: Sequence[Channel]) -> bool:
    """Whether a simulation (T, C) failed: a sample is infinite or beyond `DIVERGENCE_LIMIT`, or a
    channel has no sample. Single missing samples (NaN), as of a camera, are no failure.
    """
    if not len(observed):
        return False
    limits = DIVERGENCE_LIMIT * np.array([channel.scale for channel in channels])
    return bool((np.abs(observed) > limits).any() or np.isnan(observed).all(axis=0).any())


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
