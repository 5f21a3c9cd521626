"""Draw targets: scenarios and observations whose true parameters are hidden from the tuners.

A target's numbers are drawn from its own random streams (`core.random_streams`), in a fixed order:
start and true parameters, initial state, inputs, constants, sensor noise. Another order gives
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

from bench.benchmark.problem.experiment_config import Experiment, FixedOrRange
from bench.benchmark.problem.experiment_recording import ObservedRuns, RecordedRuns
from bench.core.input_signals import evaluate_signal
from bench.core.random_streams import TargetStreams
from sims.core.simulator import Array, Channel, InputError, Scenario, Simulator
from sims.core.unit_cube import UnitCube

_CUBE_CORNERS = np.array([[0.0], [1.0]])
"""Opposite corners of the unit cube, for any dimension."""
DIVERGENCE_LIMIT = 1e12
"""Largest magnitude of a sample, in units of its channel's typical magnitude.

A simulation with larger samples counts as diverged although its numbers are finite.
"""
MAX_DRAWS = 200
"""Maximum number of draws of one target."""
MAX_FAILED_SHARE = 0.9
"""Largest share of draws that may diverge.

With a larger share the other draws would not be a representative sample of the ranges.
"""


@dataclass(frozen=True)
class BlindedTarget:
    """Target without its true parameters, as worker processes get it.

    Attributes:
        name: name, for example ``wide-017``.
        range: in, wide or real.
        start: (dim,) starting point of the tuners in the unit cube.
        fitting: runs that the tuner may use.
        held_out: runs for validation; empty if no runs are held out.
    """

    name: str
    range: str
    start: Array
    fitting: ObservedRuns
    held_out: ObservedRuns


@dataclass(frozen=True)
class Target:
    """Target with its true parameters; exists in the parent process only.

    Attributes:
        blinded: part of the target that worker processes get.
        truth: (dim,) true parameters in physical units; None if they are unknown.
        redraws: number of draws that were discarded because their simulation diverged.
    """

    blinded: BlindedTarget
    truth: Array | None
    redraws: int = 0


class Redraws(NamedTuple):
    """Number of targets that were drawn again.

    Attributes:
        redrawn: number of targets whose first draw diverged.
        draws: number of draws of all targets together.
    """

    redrawn: int
    draws: int


class TargetProblem(Protocol):
    """Problem from which targets are drawn, as `tuning_problem.TuningProblem` is.

    Attributes:
        experiment: configuration of the experiment.
        world: simulator that makes the targets.
        cube: map between bounds and unit cube.
        channels: observed channels, in order.
        noise: (C,) standard deviation of each channel's noise.
        recording: content of the experiment's recording; None for simulated targets.
        salt: salt from which targets are drawn.
    """

    experiment: Experiment
    salt: str
    world: Simulator
    cube: UnitCube
    channels: tuple[Channel, ...]
    noise: Array
    recording: RecordedRuns | None

    def draw_scenarios(self, rng: np.random.Generator) -> tuple[Scenario, ...]:
        """Draw the scenarios of one target."""


def draw_targets(problem: TargetProblem) -> list[Target]:
    """Draw all targets of an experiment.

    The ranges alternate, so that a part of the targets contains all ranges.

    Args:
        problem: problem of the experiment.

    Returns:
        `experiment.targets` targets for each range, in the order of their numbers.

    Raises:
        InputError: all of `MAX_DRAWS` draws of a target diverge.
    """
    experiment = problem.experiment
    return [
        draw_target(problem, kind, index)
        for index in range(experiment.targets)
        for kind in experiment.ranges
    ]


def draw_target(problem: TargetProblem, kind: str, index: int) -> Target:
    """Draw one target, again if its simulation diverges.

    It depends on the experiment's name, but not on tuners, seeds or budgets.

    Args:
        problem: problem of the experiment.
        kind: range of the target.
        index: number of the target in its range.

    Raises:
        InputError: all of `MAX_DRAWS` draws diverge.
    """
    for number in range(MAX_DRAWS):
        target = _draw_target(problem, kind, index, number)
        if target is not None:
            return target
    raise _make_divergence_error(problem.experiment, MAX_DRAWS, MAX_DRAWS)


def count_redraws(experiment: Experiment, drawn_targets: Sequence[Target]) -> Redraws:
    """Count the draws of all targets.

    A target is drawn again if its own simulation diverges.

    Args:
        experiment: configuration of the experiment, for messages.
        drawn_targets: all targets, each with the number of its discarded draws.

    Raises:
        InputError: more than `MAX_FAILED_SHARE` of the draws diverged.
    """
    failed = sum(target.redraws for target in drawn_targets)
    draws = failed + len(drawn_targets)
    if failed > MAX_FAILED_SHARE * draws:
        raise _make_divergence_error(experiment, failed, draws)
    return Redraws(sum(target.redraws > 0 for target in drawn_targets), draws)


def _make_divergence_error(experiment: Experiment, failed: int, draws: int) -> InputError:
    """Make the error for an experiment too many of whose targets diverge when they are simulated.

    Args:
        experiment: configuration of the experiment, for its name.
        failed: number of simulations that diverged.
        draws: number of all simulations.
    """
    return InputError(
        f"experiment {experiment.name}: the simulation of {failed} of {draws} targets drawn "
        f"diverges (not finite, or beyond {DIVERGENCE_LIMIT:g} times a channel's typical "
        f"magnitude); expected at most {MAX_FAILED_SHARE:.0%}: narrow the bounds and training "
        "ranges in [parameters], or choose a smaller time step in [settings]"
    )


def _draw_target(problem: TargetProblem, kind: str, index: int, number: int) -> Target | None:
    """Make one draw of a target; None if its simulation diverges.

    Args:
        problem: simulator, noise and ranges from which targets are drawn.
        kind: range of the target: ``wide`` draws from all bounds, others from the training range.
        index: index of the target in its range.
        number: 0 for the first draw; counts the repeated draws, each from new streams.
    """
    # The stream's name contains no tuner, seed or budget, so that all tuners get the same target.
    # With a secret salt, start, true parameters, scenario and noise have a stream each.
    experiment_name = problem.experiment.same_targets_as or problem.experiment.name
    redraw_names = ("redraw", number) if number else ()
    streams = TargetStreams(problem.salt, experiment_name, kind, index, *redraw_names)
    # Lower and upper limits in the unit cube, between which start and true parameters are drawn.
    box = _CUBE_CORNERS if kind == "wide" else problem.cube.training
    # The start is drawn first: with a public salt, all quantities share one stream.
    start, truth = (
        streams.get_stream(stream_name).uniform(box[0], box[1], size=problem.cube.dim)
        for stream_name in ("start", "truth")
    )
    name = f"{kind}-{index:03d}"
    recording = problem.recording
    # The true parameters of a recording are not known; only the start is drawn.
    if recording:
        return Target(BlindedTarget(name, kind, start, recording.fitting, recording.held_out), None)
    # There is one scenario, because only recordings have several runs.
    scenarios = problem.draw_scenarios(streams.get_stream("scenario"))
    # The parameters of `world` are the first of the tuned ones.
    theta = problem.cube.to_physical(truth[None])[:, : len(problem.world.parameters)]
    noise_free = problem.world.simulate(theta, scenarios[0])[0]
    observed = noise_free + problem.noise * streams.get_stream("noise").standard_normal(
        noise_free.shape
    )
    fitting = ObservedRuns(scenarios, _round_to_resolution(observed, problem))
    held_out = _simulate_held_out(problem, theta, streams)
    if any(_is_divergent(y, problem.channels) for y in (noise_free, held_out.observed)):
        return None
    blinded = BlindedTarget(name, kind, start, fitting, held_out)
    return Target(blinded, problem.cube.to_physical(truth), redraws=number)


def _round_to_resolution(observed: Array, problem: TargetProblem) -> Array:
    """Round samples (T, C) to the resolution of the channels that have one.

    Shapes: T samples, C channels.

    Args:
        observed: (T, C) samples in the units of the channels.
        problem: the problem, with the resolution of its sensors.
    """
    steps = [problem.experiment.resolution.get(c.name, 0.0) for c in problem.channels]
    rounded = observed.copy()
    for column, step in enumerate(steps):
        if step:
            rounded[:, column] = step * np.round(observed[:, column] / step)
    return rounded


def _is_divergent(observed: Array, channels: Sequence[Channel]) -> bool:
    """Return whether a simulation failed.

    It failed if a sample is infinite or beyond `DIVERGENCE_LIMIT` times the scale of its channel,
    or if a channel has no sample. Single missing samples (NaN), as of a camera, are not a failure.

    Args:
        observed: (T, C) simulated samples of C channels; T is 0 without held-out scenarios.
        channels: the channels, with their scales.
    """
    if not len(observed):
        return False
    limits = DIVERGENCE_LIMIT * np.array([channel.scale for channel in channels])
    return bool((np.abs(observed) > limits).any() or np.isnan(observed).all(axis=0).any())


def draw_scenario(
    experiment: Experiment,
    rng: np.random.Generator,
    initial: Mapping[str, FixedOrRange],
    inputs: Mapping[str, str],
) -> Scenario:
    """Draw one run of an experiment.

    Args:
        experiment: configuration with the sampling and the constants.
        rng: random generator for values that are given as a range.
        initial: initial state by name: a number, or the range from which it is drawn.
        inputs: descriptions of the input signals by name, such as ``sine:2:0.5``.
    """
    sampling = experiment.sampling
    start = {name: _draw_value(rng, value) for name, value in initial.items()}
    times = np.arange(sampling.samples) / sampling.rate
    signals = {name: evaluate_signal(text, times, rng) for name, text in inputs.items()}
    # Only constants with a range are drawn; the others are set in the simulator.
    ranges = {name: v for name, v in experiment.constants.items() if isinstance(v, tuple)}
    constants = {name: _draw_value(rng, value) for name, value in ranges.items()}
    return Scenario(times, start, signals, constants)


def _draw_value(rng: np.random.Generator, value: FixedOrRange) -> float:
    return rng.uniform(*value) if isinstance(value, tuple) else value


def _simulate_held_out(
    problem: TargetProblem, theta: Array, target_streams: TargetStreams
) -> ObservedRuns:
    """Simulate the held-out scenarios of a target, without sensor noise.

    Args:
        problem: problem of the experiment; its simulator `world` makes the targets.
        theta: (1, p) true parameters of the target.
        target_streams: random streams of the target, which determine the scenarios.

    Returns:
        Scenarios and observations; none if the experiment has no held-out scenarios.
    """
    experiment, held_out = problem.experiment, problem.experiment.held_out
    if held_out is None:
        return ObservedRuns((), np.empty((0, len(problem.channels))))
    initial = {**experiment.initial, **held_out.initial}
    inputs = {**experiment.inputs, **held_out.inputs}
    # Each scenario has its own stream, so that more scenarios do not change the first ones.
    streams = [target_streams.get_held_out_stream(i) for i in range(held_out.scenarios)]
    scenarios = tuple(draw_scenario(experiment, rng, initial, inputs) for rng in streams)
    observed = [problem.world.simulate(theta, scenario)[0] for scenario in scenarios]
    return ObservedRuns(scenarios, np.concatenate(observed))
