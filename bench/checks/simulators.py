"""Conformance of a simulator; each check takes the simulator's class, and works on its defaults."""

from __future__ import annotations

import re
from collections.abc import Callable

import numpy as np

from bench.checks.base import CheckError, NotApplicable, require, same_bits
from sims.base import Array, Channel, Constant, InputError, Parameter, Scenario, Simulator, UnitCube

_NAME = re.compile(r"[a-z][a-z0-9_.]*$")


def _scenario(samples: int = 40, rate: float = 60.0) -> Scenario:
    return Scenario(np.arange(samples) / rate)


def _points(simulator: Simulator, n: int, seed: int = 0) -> Array:
    cube = UnitCube(simulator.parameters)
    return cube.physical(np.random.default_rng(seed).uniform(size=(n, cube.dim)))


def check_declaration_is_complete(kind: type[Simulator]) -> None:
    """Names are plain, units and sentences are there, nothing is declared twice."""
    look = kind.__name__
    named: list[Parameter | Channel | Constant] = [
        *kind.parameters,
        *kind.channels,
        *kind.constants,
        *kind.inputs,
    ]
    require(
        bool(kind.parameters and kind.channels and kind.says),
        "parameters, channels and a sentence",
        "none",
        look,
    )
    groups: tuple[tuple[Parameter | Channel | Constant, ...], ...]
    groups = (kind.parameters, kind.channels, kind.constants, kind.inputs)
    for group in groups:
        names = [thing.name for thing in group]
        require(len(set(names)) == len(names), "different names", names, look)
    for thing in named:
        # A robot's are those of its file, whatever that calls them.
        plain = kind.has_model or bool(_NAME.match(thing.name))
        require(plain, "a name in lower case", thing.name, look)
        require(bool(thing.unit), f"a unit for {thing.name} ('1' for a number)", "none", look)


def check_observations_have_the_declared_shape(kind: type[Simulator]) -> None:
    """(n, T, C), finite, for any number of parameter vectors and samples."""
    simulator = kind()
    for n, samples in ((1, 2), (3, 40), (1, 1)):
        seen = simulator.simulate(_points(simulator, n), _scenario(samples))
        shape = (n, samples, len(simulator.channels))
        require(
            seen.shape == shape,
            f"observations of shape {shape}",
            seen.shape,
            f"{kind.__name__}.simulate",
        )
        require(
            bool(np.isfinite(seen).all()),
            "finite observations inside the bounds",
            "others",
            f"{kind.__name__}.simulate",
        )
    simulator.close()


def check_same_proposal_gives_the_same_bits(kind: type[Simulator]) -> None:
    """Whatever was simulated before, here or in a fresh simulator, alone or among others."""
    simulator, other = kind(), kind()
    points, look = (
        _points(simulator, 6),
        f"what {kind.__name__} keeps from one simulation to the next",
    )
    together = simulator.simulate(points, _scenario())
    # In between something else, of another length and rate, which may leave its traces.
    simulator.simulate(_points(simulator, 5, seed=9), _scenario(samples=77, rate=50.0))
    alone = np.concatenate(
        [simulator.simulate(point[None], _scenario()) for point in points[::-1]]
    )[::-1]
    require(same_bits(together, alone), "the same bits after other simulations", "others", look)
    require(
        same_bits(together, other.simulate(points, _scenario())),
        "the same bits in a new simulator",
        "others",
        look,
    )
    simulator.close()
    require(
        same_bits(together, simulator.simulate(points, _scenario())),
        "the same bits after close()",
        "others",
        look,
    )
    simulator.close()
    other.close()


def check_arguments_are_not_changed(kind: type[Simulator]) -> None:
    """`theta` and the scenario are the caller's."""
    simulator, scenario = kind(), _scenario()
    points = _points(simulator, 3)
    before, times = points.copy(), scenario.times.copy()
    simulator.simulate(points, scenario)
    require(
        same_bits(before, points) and same_bits(times, scenario.times),
        "arguments as they were",
        "changed ones",
        kind.__name__,
    )
    simulator.close()


def check_parameters_that_are_not_numbers_spoil_only_their_lane(kind: type[Simulator]) -> None:
    """A lane with a NaN parameter is all NaN, its neighbours are as without it."""
    simulator, look = kind(), f"{kind.__name__}.simulate"
    points = _points(simulator, 3)
    clean = simulator.simulate(points, _scenario())
    # The middle one, so that it has neighbours on both sides.
    points[1] = np.nan
    seen = simulator.simulate(points, _scenario())
    require(bool(np.isnan(seen[1]).all()), "a lane of NaN", seen[1][:2], look)
    require(same_bits(clean[[0, 2]], seen[[0, 2]]), "neighbours as they were", "others", look)
    simulator.close()


def check_every_parameter_shows(kind: type[Simulator]) -> None:
    """Each parameter changes some channel, in a run of ten seconds."""
    simulator = kind()
    cube = UnitCube(simulator.parameters)
    points = np.full((1 + cube.dim, cube.dim), 0.4)
    # One point for each parameter, moved in that direction alone.
    points[1:] += 0.2 * np.eye(cube.dim)
    inputs = {c.name: np.ones(600) for c in simulator.inputs}
    seen = simulator.simulate(cube.physical(points), Scenario(np.arange(600) / 60.0, inputs=inputs))
    for parameter, lane in zip(simulator.parameters, seen[1:], strict=True):
        require(
            not np.array_equal(lane, seen[0]),
            f"parameter {parameter.name} to change something",
            "nothing",
            kind.__name__,
        )
    simulator.close()


def check_unknown_names_are_refused(kind: type[Simulator]) -> None:
    """Constants, channels, inputs and initial states that do not exist give one line that lists
    those that do.
    """
    scenarios = (
        Scenario(np.arange(3.0), initial={"no_such": 1.0}),
        Scenario(np.arange(3.0), inputs={"no_such": np.zeros(3)}),
        Scenario(np.arange(3.0), constants={"no_such": 1.0}),
    )

    def simulating(scenario: Scenario) -> Callable[[], object]:
        return lambda: kind().simulate(_points(kind(), 1), scenario)

    attempts: list[Callable[[], object]] = [simulating(s) for s in scenarios]
    attempts += [lambda: kind(constants={"no_such": 1.0}), lambda: kind(observe=["no_such"])]
    for attempt in attempts:
        try:
            attempt()
        except InputError as error:
            require("no_such" in str(error), "a message that names it", error, kind.__name__)
            continue
        raise CheckError(
            f"expected InputError for an unknown name; found none; see {kind.__name__}"
        )


def check_chosen_channels_are_the_same_columns(kind: type[Simulator]) -> NotApplicable | None:
    """`observe` picks and orders columns, and changes no number."""
    everything = kind()
    names = [c.name for c in everything.channels][::-1]
    if len(names) == 1:
        everything.close()
        return NotApplicable("it has one channel")
    chosen = kind(observe=names)
    points = _points(everything, 2)
    same = same_bits(
        np.ascontiguousarray(everything.simulate(points, _scenario())[:, :, ::-1]),
        np.ascontiguousarray(chosen.simulate(points, _scenario())),
    )
    require(
        same, "the same columns in the order asked for", "others", f"{kind.__name__}: self.columns"
    )
    everything.close()
    chosen.close()
    return None


SIMULATOR_CHECKS: tuple[Callable[[type[Simulator]], NotApplicable | None], ...] = (
    check_declaration_is_complete,
    check_observations_have_the_declared_shape,
    check_same_proposal_gives_the_same_bits,
    check_arguments_are_not_changed,
    check_parameters_that_are_not_numbers_spoil_only_their_lane,
    check_every_parameter_shows,
    check_unknown_names_are_refused,
    check_chosen_channels_are_the_same_columns,
)
