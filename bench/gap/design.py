"""The next recording: commands by which what is open would be settled.

Runs that an experimenter could make are simulated and ranked. Where two models explain the data so
far, a run x is worth what the rival would still leave of it after it is fitted again to both, with
what the old data know of its numbers, C, and d the difference of the two on the run (T-optimality;
A. C. Atkinson, V. V. Fedorov, Biometrika 62(1), 57, 1975, doi:10.1093/biomet/62.1.57),

    T(x) = min over δ, z of  |d - J δ - B z|^2 + δ' C^-1 δ                                      (1)

in units of the noise, J and B the rival's derivatives by its numbers and by the run's initial
state, which is free. Where nothing is open but numbers are wide, it is worth what it narrows them
by (D-optimality; V. V. Fedorov, Theory of Optimal Experiments, 1972),

    D(x) = 1/2 log det(I + C J' (I - B B^+) J)                                                  (2)
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple

import numpy as np

from bench.gap.measure import covariance
from bench.gap.model.models import Model, Models
from bench.gap.model.world import World
from bench.problem.signals import signal
from bench.recordings.poses import contacts
from sims.base import Array, Scenario

SPLITS = 14.0
"""(1) from which a run settles it: odds of 1,000 to 1 for what is true."""
ENOUGH = 4.0 * SPLITS
"""(1) beyond which more of it is worth no more."""
BEST = 8
"""Runs of the largest plain difference for which (1) is asked."""
SIZES = (1.0, 2.0)
"""Of the largest command recorded so far."""
TRAVEL = 3.0
"""Times the range recorded so far that a channel may leave it, where nothing states its limits."""
LITTLE = 1e-3
"""Of a channel's usual size, by which an initial state is moved for a derivative."""
WILD = 100.0
"""Times that such a shift may grow on the way."""
STEPS = 6
"""Of a fit of a rival to a run that does not exist."""


class Run(NamedTuple):
    """A run that could be recorded: in words, with its commands and its initial state."""

    says: str
    scenario: Scenario
    states: Array


@dataclass(frozen=True)
class Design:
    """What to record next.

    Attributes:
        says: the commands, in words.
        by: ``T`` where it tells models apart, ``D`` where it narrows numbers.
        gain: (2), the logarithm of the factor by which the volume of the intervals shrinks; of
            ``T`` the least of `told`.
        effect: what stands, if it is to be told from others.
        told: (1) of each other effect that would explain the same; empty for ``D``.
        times: (T,) seconds.
        inputs: (T,) by name, each value held until the next.
        initial: states to begin from, by name.
    """

    says: str
    by: Literal["T", "D"]
    gain: float
    effect: str
    told: Mapping[str, float]
    times: Array
    inputs: Mapping[str, Array]
    initial: Mapping[str, float]

    @property
    def split(self) -> tuple[str, ...]:
        """Other effects that would be told from what stands."""
        return tuple(name for name, value in self.told.items() if value > SPLITS)

    @property
    def settles(self) -> bool:
        """Whether nothing would be open afterwards."""
        return len(self.split) == len(self.told)

    @property
    def worth(self) -> float:
        """What it is chosen by: what it tells of each, more than enough counted once."""
        return sum(min(value, ENOUGH) for value in self.told.values()) if self.told else self.gain


def design(models: Models, model: Model, rivals: Sequence[Model], seconds: float) -> Design | None:
    """The best run that could be recorded next; None where none can be simulated.

    Args:
        models: among which all of them are.
        model: the one that stands.
        rivals: what would explain the same; none where nothing is open.
        seconds: how long the run may last.
    """
    world = models.world
    ranked = []
    for run in _runs(world, seconds):
        mine = _simulated(world, run, [model.fit.theta], [run.states])
        if mine is None or not _within(world, mine[0]):
            continue
        if _wild(world, run, model.fit.theta, mine[0]):
            continue
        ranked.append((_plain(models, run, mine[0], rivals), run, mine[0]))
    ranked.sort(key=lambda entry: -entry[0])
    found: list[Design] = []
    # Once for all runs: what the old ones know does not hang on the new one.
    known = [_known(models, one) for one in (rivals or [model])]
    for _, run, mine in ranked[:BEST]:
        if rivals:
            told = {_other(one.model, model): _told(models, run, mine, one) for one in known}
            found.append(_made(world, run, min(told.values()), _other(model, rivals[0]), told))
        else:
            found.append(_made(world, run, _narrowed(models, run, mine, known[0]), "", {}))
    return max(found, key=lambda one: one.worth, default=None)


class _Known(NamedTuple):
    """What the old runs know of a model's numbers: their covariance, and a size of each, 1 sigma
    but no more than a tenth of its bounds.
    """

    model: Model
    covariance: Array
    spread: Array


def _known(models: Models, model: Model) -> _Known:
    own = covariance(models, model)
    bounds = np.array([models.world.parameters[i].bounds for i in model.fit.free]).reshape(-1, 2)
    widest = 0.1 * (bounds[:, 1] - bounds[:, 0])
    sizes = np.sqrt(np.maximum(np.diagonal(own), 1e-300))
    return _Known(model, own, np.minimum(sizes, widest))


def _other(model: Model, than: Model) -> str:
    """The effect that a model has and the other has not."""
    return " and ".join(name for name in model.names if name not in than.names)


def _made(world: World, run: Run, gain: float, effect: str, told: Mapping[str, float]) -> Design:
    times = run.scenario.times - run.scenario.times[0]
    initial = dict(zip(world.states, run.states.tolist(), strict=True))
    by: Literal["T", "D"] = "T" if told else "D"
    inputs = dict(run.scenario.inputs)
    return Design(run.says, by, float(gain), effect, told, times, inputs, initial)


def _runs(world: World, seconds: float) -> Iterator[Run]:
    """Commands of every form and size, one input at a time and all together; without an input,
    other beginnings.
    """
    track = world.tracks[0]
    old = track.scenario
    step = float(np.median(np.diff(old.times)))
    times = np.arange(0.0, seconds, step)
    largest, rest = {}, {}
    for name in old.inputs:
        signals = [track.scenario.inputs[name] for track in world.tracks]
        middle = float(np.median(np.concatenate(signals)))
        largest[name] = max(float(np.abs(values - middle).max()) for values in signals)
        rest[name] = middle
    quiet = {name: np.full(times.size, rest[name]) for name in old.inputs}
    template = replace(old, times=times, inputs=quiet)
    for states, where in _beginnings(world):
        yield Run(f"let it go {where}", template, states)
    driven = [name for name in old.inputs if largest[name] > 0]
    groups = [(name,) for name in driven] + ([tuple(driven)] if len(driven) > 1 else [])
    for names in groups:
        for size in SIZES:
            for words, form in _forms(step, seconds):
                inputs = dict(quiet)
                for number, name in enumerate(names):
                    rng = np.random.default_rng(number)
                    own = size * largest[name] * signal(form, times, rng)
                    inputs[name] = _limited(world, name, rest[name] + own)
                what = names[0] if len(names) == 1 else "all inputs"
                says = f"{what}: {words}, {size:g} times as large as so far"
                yield Run(says, replace(template, inputs=inputs), _resting(world))


def _forms(step: float, seconds: float) -> Iterator[tuple[str, str]]:
    """Signals of size one, in words and as they are written."""
    slow = min(max(1.0 / seconds, 0.1), 0.5)
    fast = max(min(8.0, 0.1 / step), 2.0 * slow)
    yield f"multisine of {slow:.3g} to 1 Hz", f"multisine:1:{slow:g}:1"
    if fast > 1.0:
        yield f"multisine of 1 to {fast:.3g} Hz", f"multisine:1:1:{fast:g}"
    yield f"chirp of {slow:.3g} to {fast:.3g} Hz", f"chirp:1:{slow:g}:{fast:g}"
    yield "steps of 0.5 s", "steps:1:0.5"
    yield "steps of 0.1 s", "steps:1:0.1"
    yield f"slow sine of {slow:.3g} Hz", f"sine:1:{slow:g}"
    yield "square wave of 1 Hz", "square:1:1"


def _beginnings(world: World) -> Iterator[tuple[Array, str]]:
    """Initial states, each coordinate farther from rest."""
    base = _resting(world)
    for place, name in enumerate(world.simulator.system.coordinates):
        for share in (1.0, 2.0, -1.0, 0.3):
            states = base.copy()
            states[place] = share * base[place] if abs(base[place]) > 0.05 else share
            yield states, f"from {name} = {states[place]:.3g}"


def _resting(world: World) -> Array:
    """Where the first run began, at rest: nobody can throw a robot."""
    states = world.tracks[0].guess.copy()
    rates = set(world.simulator.system.rates)
    states[[i for i, name in enumerate(world.states) if name in rates]] = 0.0
    return states


def _limited(world: World, name: str, values: Array) -> Array:
    """A command within what its actuator takes."""
    if not world.kind.has_model:
        return values
    robot: Any = world.kind
    for actuator in robot.robot.actuators:
        if f"u.{actuator.name}" == name and actuator.range is not None:
            return np.asarray(np.clip(values, *actuator.range))
    return values


def _within(world: World, simulated: Array) -> bool:
    """Whether a robot stays within its joints' ranges and touches nothing, and anything stays near
    where it has been.
    """
    limits: dict[str, tuple[float, float]] = {}
    if world.kind.has_model:
        robot: Any = world.kind
        limits = {f"q.{j.name}": j.range for j in robot.robot.joints if j.single and j.range}
    for c, name in enumerate(world.channels):
        values = simulated[:, c]
        if not np.isfinite(values).all():
            return False
        seen = world.observed[..., c]
        low, high = float(np.nanmin(seen)), float(np.nanmax(seen))
        slack = TRAVEL * max(high - low, world.simulator.channels[c].scale)
        low, high = limits.get(name, (low - slack, high + slack))
        if values.min() < low or values.max() > high:
            return False
    return not world.kind.has_model or not _collides(world, simulated)


def _collides(world: World, simulated: Array) -> bool:
    """Whether parts of a robot touch that do not touch in what was recorded."""
    columns = dict(zip(world.channels, simulated.T, strict=True))
    touching = contacts(world.kind, columns)
    if not touching:
        return False
    return bool(touching - contacts(world.kind, world.runs[0].channels))


def _simulated(
    world: World, run: Run, thetas: Sequence[Array], states: Sequence[Array]
) -> Array | None:
    """(L, T, C) the run with each parameter vector and state; None where it fails."""
    # Freed constants are fitted with the parameters, and reach the simulator as constants.
    places = world.base[world.own :]
    names = [parameter.name for parameter in world.freed]
    scenarios = []
    for theta in thetas:
        freed = dict(zip(names, theta[places].tolist(), strict=True))
        constants = {**run.scenario.constants, **freed}
        scenarios.append(replace(run.scenario, constants=constants))
    columns = np.array(states).T
    initial = {name: np.array(own) for name, own in zip(world.states, columns, strict=True)}
    vectors = np.delete(np.stack(thetas), places, axis=1)
    result = world.simulator.simulate_lanes(vectors, scenarios, initial)
    world.simulations += len(thetas)
    return np.asarray(result)


def _wild(world: World, run: Run, theta: Array, simulated: Array) -> bool:
    """Whether a run amplifies where it begins: nobody could say later where it went, or why."""
    count = run.states.size
    moved = run.states + LITTLE * np.eye(count)
    runs = _simulated(world, run, [theta] * count, list(moved))
    if runs is None or not np.isfinite(runs).all():
        return True
    sizes = np.array([channel.scale for channel in world.simulator.channels])
    return bool((np.abs(runs - simulated) / sizes).max() > WILD * LITTLE)


def _plain(models: Models, run: Run, mine: Array, rivals: Sequence[Model]) -> float:
    """What a run shows before any refit: how far rivals are, or how much it moves."""
    sigma = models.noise.sigma
    if not rivals:
        return float(np.square(np.std(mine, axis=0) / sigma).sum())
    values = []
    for rival in rivals:
        other = _simulated(models.world, run, [rival.fit.theta], [run.states])
        if other is None or not np.isfinite(other).all():
            return -np.inf
        values.append(float(np.log1p(np.square((mine - other[0]) / sigma).sum())))
    return sum(values)


class _Slopes(NamedTuple):
    """Derivatives of a run in units of the noise: by numbers, each in units of its own 1 sigma, and
    by its initial state.
    """

    numbers: Array
    states: Array


def _slopes(models: Models, run: Run, known: _Known, at: Array, centre: Array) -> _Slopes | None:
    """Derivatives about a parameter vector `at`, where the run is `centre`; None where there are
    none.
    """
    world, sigma = models.world, models.noise.sigma
    spread = known.spread
    thetas, states = [], []
    for place, size in zip(known.model.fit.free.tolist(), spread.tolist(), strict=True):
        theta = at.copy()
        theta[place] += size
        thetas.append(theta)
        states.append(run.states)
    little = []
    for place in range(run.states.size):
        moved = run.states.copy()
        moved[place] += LITTLE
        little.append(LITTLE)
        thetas.append(at)
        states.append(moved)
    moved_runs = _simulated(world, run, thetas, states)
    if moved_runs is None or not np.isfinite(moved_runs).all():
        return None
    q = len(spread)
    columns = ((moved_runs - centre) / sigma).reshape(len(thetas), -1).T
    return _Slopes(columns[:, :q], columns[:, q:] / np.array(little))


def _told(models: Models, run: Run, mine: Array, rival: _Known) -> float:
    """(1), by a few steps of Gauss and Newton: what the run shows of a rival may be far from it."""
    fit, scale = rival.model.fit, 1.0 / rival.spread
    known = np.linalg.pinv(rival.covariance * np.outer(scale, scale), hermitian=True)
    q, free = known.shape[0], fit.free
    at, states = fit.theta.copy(), run.states.copy()
    gone, least = np.zeros(q), np.inf
    for _ in range(STEPS):
        here = _simulated(models.world, run, [at], [states])
        if here is None or not np.isfinite(here).all():
            break
        left = ((mine - here[0]) / models.noise.sigma).ravel()
        cost = float(left @ left + gone @ known @ gone)
        if not cost < least:
            break
        least = cost
        placed = run._replace(states=states)
        slopes = _slopes(models, placed, rival, at, here[0])
        if slopes is None:
            break
        columns = np.concatenate([slopes.numbers, slopes.states], axis=1)
        normal, pull = columns.T @ columns, columns.T @ left
        normal[:q, :q] += known
        pull[:q] -= known @ gone
        normal += 1e-9 * np.diag(np.diagonal(normal)) + 1e-18 * np.eye(len(normal))
        step = np.linalg.solve(normal, pull)
        gone = gone + step[:q]
        at, states = at.copy(), states + step[q:]
        at[free] += step[:q] / scale
    return least if np.isfinite(least) else 0.0


def _narrowed(models: Models, run: Run, mine: Array, known: _Known) -> float:
    """(2), as a factor."""
    slopes = _slopes(models, run, known, known.model.fit.theta, mine)
    if slopes is None:
        return 0.0
    basis, _ = np.linalg.qr(slopes.states)
    own = slopes.numbers - basis @ (basis.T @ slopes.numbers)
    scale = 1.0 / known.spread
    scaled = known.covariance * np.outer(scale, scale)
    _, value = np.linalg.slogdet(np.eye(len(scaled)) + scaled @ (own.T @ own))
    return float(0.5 * value)
