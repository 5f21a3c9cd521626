"""What a robot's simulator tells without simulating each change: the tangents of its runs, and what
its own step leaves of them.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bench.gap.model.differences import followed
from bench.gap.model.noise import Noise
from bench.gap.model.world import World
from sims.base import Array
from sims.robot.linear import Linear
from sims.robot.series import is_series
from sims.robot.simulator import RobotSimulator

SMALL = 1.0
"""RMS, in units of the noise, below which what the engine's step leaves can be taken out."""


def responses(
    world: World, theta: Array, states: Array, added: Sequence[tuple[str, Array]]
) -> Array:
    """What one more effect changes about the runs, to first order: (K, R, T, C). In single
    precision, since it is the largest array of explain by far, and a derivative.

    Args:
        world: the runs, of a robot.
        theta: (P,) parameters, without the effects that are added.
        states: (R, s) initial states.
        added: K effects with their coefficients.
    """
    runs, length, channels = world.observed.shape
    result: Array = np.full((len(added), runs, length, channels), np.nan, dtype=np.float32)
    kept = world.simulated
    keys = [(name, c.tobytes()) for name, c in added]
    asked = [i for i, key in enumerate(keys) if key not in kept]
    calls = [(run, theta, states[run], [added[i] for i in asked]) for run in range(runs)]
    for run, (values, looks) in world.crew.each(world, _responses, calls):
        # what explodes is infinite then
        with np.errstate(over="ignore"):
            result[asked, run, : values.shape[1]] = values
        world.simulations += looks
    result[~followed(result)] = np.nan
    for i, key in enumerate(keys):
        if key in kept:
            result[i] = kept[key]
        elif is_series(world.effects[key[0]]):
            # What is simulated for want of a tangent acts alike in all models near the data.
            kept[key] = result[i].copy()
    return result


def _responses(
    world: World, run: int, theta: Array, states: Array, added: Sequence[tuple[str, Array]]
) -> tuple[Array, int]:
    """The same of one run (K, T, C), and how many simulations it cost."""
    about = _about(world, run, theta, states)
    return about.responses([(world.effects[name], c) for name, c in added])


def begun(world: World, theta: Array, states: Array, anew: bool = False) -> Array:
    """Derivatives of the runs by their initial states, (R, T, C, s): those about the first
    model that was asked for, or about this one.

    Initial states act alike in all models that are near the data, and a fit that has their
    derivatives about another of them comes to the same end.

    Args:
        world: the runs, of a robot.
        theta: (P,) parameters.
        states: (R, s) initial states.
        anew: take them about this model, and keep them.
    """
    if world.derivatives is None or anew:
        world.derivatives = begun_about(world, theta, states)
    return world.derivatives


def begun_about(world: World, theta: Array, states: Array) -> Array:
    """Return the derivatives (R, T, C, s) of the runs by their initial states about one model.

    Args:
        world: the runs, of a robot.
        theta: (P,) its parameters.
        states: (R, s) its initial states.
    """
    runs, length, channels = world.observed.shape
    result = np.zeros((runs, length, channels, len(world.states)))
    calls = [(run, theta, states[run]) for run in range(runs)]
    for run, values in world.crew.each(world, _begun, calls):
        result[run, : values.shape[1]] = np.moveaxis(values, 0, -1)
    result[~followed(result)] = 0.0
    return result


def _begun(world: World, run: int, theta: Array, states: Array) -> Array:
    """The same of one run, (s, T, C)."""
    return _about(world, run, theta, states).begun()


def _about(world: World, run: int, theta: Array, states: Array) -> Linear:
    """The neighbourhood of one run of a model, which is asked more than once about most."""
    key = run, theta.tobytes(), states.tobytes()
    kept = world.neighbourhoods
    about: Linear | None = kept.pop(key, None)
    if about is None:
        half = len(world.states) // 2
        scenario = world.tracks[run].scenario
        about = Linear(world.simulator, theta, scenario, states[:half], states[half:])
    kept[key] = about
    # Those that have not been asked for longest go.
    for old in list(kept)[: -len(world.tracks)]:
        del kept[old]
    return about


def correct(world: World, noise: Noise, theta: Array, states: Array) -> None:
    """Take out of all that is simulated from now on what the engine's own step leaves of a model's
    motion.

    With q(h) the motion at a step h, what is left by it is

        2 q(h / 4) - q(h / 2) - q(h)                                                           (1)

    to first order of h (L. F. Richardson, 1911, doi:10.1098/rsta.1911.0009), and nearly so of any
    higher order. Below what would be asked about as a cause it is no cause, and yet would look like
    one: dry friction that stops within a step and not at its end, a servo that is nearly too quick.

    Args:
        world: the runs, of a robot.
        noise: of each channel.
        theta: (P,) parameters of a model that is near the data.
        states: (R, s) its initial states.
    """
    if not world.linear:
        return
    assert issubclass(world.kind, RobotSimulator)
    effects = [*world.library, *world.extra]
    runs = len(world.tracks)
    scenarios = [track.scenario for track in world.tracks]
    lanes = np.tile(theta, (runs, 1))
    begun = dict(zip(world.states, states.T, strict=True))
    half = world.kind.halved()
    seen = [world.simulator.simulate_lanes(lanes, scenarios, begun)]
    for kind in (half, half.halved()):
        finer = kind(world.recording.constants, world.channels, effects=effects)
        seen.append(finer.simulate_lanes(lanes, scenarios, begun))
    world.simulations += 7 * runs
    left = 2.0 * seen[2] - seen[1] - seen[0]  # (1)
    sizes = np.square(left / noise.sigma)[np.isfinite(world.observed)]
    # What is not small is none that could be taken out.
    if float(np.sqrt(sizes.mean())) < SMALL:
        world.correction = np.nan_to_num(left)
