"""Conformance checks of a simulator, with its default options."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping

import numpy as np

from bench.conformance.check_base import Check, CheckError, NotApplicable, check, is_bitwise_equal
from bench.conformance.own_simulator_checks import (
    check_forces_act,
    check_hooks_have_the_declared_shapes,
    check_levels_can_be_set,
    check_step_goes_on_by_its_seconds,
)
from sims.core.simulator import (
    Array,
    Channel,
    Constant,
    InputError,
    Parameter,
    Scenario,
    Simulator,
    UnitCube,
)
from sims.recording.unit_conversion import is_unit

_NAME = re.compile(r"[a-z][a-z0-9_.]*$")


def _make_scenario(
    kind: type[Simulator], samples: int = 40, rate: float = 60.0, size: float = 0.0
) -> Scenario:
    """Make a run from the default initial state.

    Args:
        kind: class of the simulator.
        samples: number of samples.
        rate: samples per second.
        size: amplitude of the inputs, in units of their `scale`.
    """
    times = np.arange(samples) / rate
    waves = {c.name: c.scale * size * np.cos((3.0 + i) * times) for i, c in enumerate(kind.inputs)}
    return Scenario(times, inputs=waves)


def _draw_points(simulator: Simulator, n: int, seed: int = 0) -> Array:
    cube = UnitCube(simulator.parameters)
    return cube.to_physical(np.random.default_rng(seed).uniform(size=(n, cube.dim)))


def _list_named_parts(kind: type[Simulator]) -> list[Parameter | Channel | Constant]:
    return [*kind.parameters, *kind.channels, *kind.constants, *kind.inputs]


def check_declaration_is_complete(kind: type[Simulator]) -> None:
    """Check that the declaration has valid names and a description, and no duplicates."""
    location = kind.__name__
    check(
        bool(kind.parameters and kind.channels and kind.says),
        "parameters, channels and a sentence",
        "none",
        location,
    )
    groups: tuple[tuple[Parameter | Channel | Constant, ...], ...]
    groups = (kind.parameters, kind.channels, kind.constants, kind.inputs)
    for group in groups:
        names = [part.name for part in group]
        check(len(set(names)) == len(names), "different names", names, location)
    for part in _list_named_parts(kind):
        # The names of a robot are those of its model file and may contain any character.
        is_plain_name = kind.has_model or bool(_NAME.match(part.name))
        check(is_plain_name, "a name in lower case", part.name, location)


def check_units_are_known(kind: type[Simulator]) -> None:
    """Check that every parameter, channel, constant and input has a unit that can be converted."""
    for part in _list_named_parts(kind):
        check(
            is_unit(part.unit),
            f"a unit for {part.name} (such as m/s, rad, N*m; '1' for a number)",
            repr(part.unit),
            kind.__name__,
        )


def check_observations_have_the_declared_shape(kind: type[Simulator]) -> None:
    """Check that observations are (n, T, C) and finite, for several n and T."""
    simulator, location = kind(), f"{kind.__name__}.simulate"
    for n, samples in ((1, 2), (3, 40), (1, 1)):
        observations = simulator.simulate(_draw_points(simulator, n), _make_scenario(kind, samples))
        shape = (n, samples, len(simulator.channels))
        check(
            observations.shape == shape,
            f"observations of shape {shape}",
            observations.shape,
            location,
        )
        for place, channel in enumerate(simulator.channels):
            invalid_values = observations[:, :, place][~np.isfinite(observations[:, :, place])]
            expected = f"finite values of {channel.name} for parameters inside the bounds"
            check(not invalid_values.size, expected, invalid_values[:1], location)
    simulator.close()


def check_same_proposal_gives_the_same_bits(kind: type[Simulator]) -> None:
    """Check that a simulation is reproducible bit for bit.

    It must not depend on earlier simulations, in this simulator or another, nor on other parameter
    vectors of the same call.
    """
    simulator, new_simulator = kind(), kind()
    points = _draw_points(simulator, 6)
    # Nonzero inputs, because their lasting effects, such as heat, would not be visible otherwise.
    run, longer_run = _make_scenario(kind, size=1.0), _make_scenario(kind, 300, 50.0, size=3.0)
    batch_result = simulator.simulate(points.copy(), run)

    def compare(observations: Array, after: str) -> None:
        """Raise an error unless observations equal those of the first call bit for bit.

        Args:
            observations: (n, T, C) observations of the same points and scenario.
            after: what was different in this call, for the message.
        """
        if not is_bitwise_equal(batch_result, observations):
            location = f"{kind.__name__}.reset" if hasattr(kind, "reset") else kind.__name__
            difference = _describe_first_difference(kind, batch_result, observations)
            raise CheckError(
                f"expected the same numbers {after}; found {difference}; see {location}: it must "
                "set everything that a run has changed"
            )

    simulator.simulate(_draw_points(simulator, 2, seed=9), longer_run)
    compare(simulator.simulate(points.copy(), run), "after a run with other inputs")
    single_results = [simulator.simulate(point[None].copy(), run) for point in points[::-1]]
    compare(np.concatenate(single_results[::-1]), "one by one as in one batch")
    compare(new_simulator.simulate(points.copy(), run), "in a new simulator")
    simulator.close()
    compare(simulator.simulate(points.copy(), run), "after close()")
    simulator.close()
    new_simulator.close()


def _describe_first_difference(kind: type[Simulator], expected: Array, observations: Array) -> str:
    """Describe where two observations (n, T, C) first differ in time."""
    if expected.shape != observations.shape:
        return f"shape {observations.shape} in place of {expected.shape}"
    is_different = (expected != observations) & ~(np.isnan(expected) & np.isnan(observations))
    if not is_different.any():
        return "zeros of the opposite sign"
    lane, sample, channel = min(np.argwhere(is_different).tolist(), key=lambda index: index[1])
    expected_value, found_value = (
        expected[lane, sample, channel],
        observations[lane, sample, channel],
    )
    # All digits are shown if the values differ only by rounding.
    digits = 6 if f"{expected_value:.6g}" != f"{found_value:.6g}" else 17
    name = kind.channels[channel].name
    found, wanted = f"{found_value:.{digits}g}", f"{expected_value:.{digits}g}"
    return f"{name} = {found} in place of {wanted} at sample {sample}"


def check_arguments_are_not_changed(kind: type[Simulator]) -> None:
    """Check that the simulator does not change `theta` and the scenario."""
    simulator, scenario = kind(), _make_scenario(kind)
    points = _draw_points(simulator, 3)
    points_before, times = points.copy(), scenario.times.copy()
    simulator.simulate(points, scenario)
    check(
        is_bitwise_equal(points_before, points) and is_bitwise_equal(times, scenario.times),
        "unchanged arguments",
        "changed ones",
        kind.__name__,
    )
    simulator.close()


def check_parameters_that_are_not_numbers_spoil_only_their_lane(kind: type[Simulator]) -> None:
    """Check that a NaN parameter makes its own batch element NaN, and no other."""
    simulator, location = kind(), f"{kind.__name__}.simulate"
    points = _draw_points(simulator, 3)
    expected_observations = simulator.simulate(points, _make_scenario(kind))
    # The middle element has neighbours on both sides.
    points[1] = np.nan
    observations = simulator.simulate(points, _make_scenario(kind))
    check(
        bool(np.isnan(observations[1]).all()),
        "a batch element of NaN",
        observations[1][:2],
        location,
    )
    check(
        is_bitwise_equal(expected_observations[[0, 2]], observations[[0, 2]]),
        "unchanged other elements",
        "others",
        location,
    )
    simulator.close()


def check_every_parameter_shows(kind: type[Simulator]) -> None:
    """Check that each parameter changes some channel, in a run of ten seconds."""
    simulator = kind(observe=[c.name for c in kind.channels])
    cube = UnitCube(simulator.parameters)
    # Points inside the training range: outside it, a large friction may prevent all motion.
    low, high = cube.training
    points = np.tile(low + 0.4 * (high - low), (1 + cube.dim, 1))
    # One point for each parameter, changed in that direction alone.
    points[1:] += 0.2 * np.diag(high - low)
    inputs = {c.name: np.ones(600) for c in simulator.inputs}
    observations = simulator.simulate(
        cube.to_physical(points), Scenario(np.arange(600) / 60.0, inputs=inputs)
    )
    for parameter, lane in zip(simulator.parameters, observations[1:], strict=True):
        check(
            not np.array_equal(lane, observations[0]),
            f"parameter {parameter.name} to change the observations",
            "nothing",
            kind.__name__,
        )
    simulator.close()


def check_initial_states_show(kind: type[Simulator]) -> NotApplicable | None:
    """Check that each initial state changes some channel, in a run of ten seconds."""
    if not kind.states:
        return NotApplicable("it has no initial state")
    simulator = kind(observe=[c.name for c in kind.channels])
    scales = {c.name: c.scale for c in kind.channels}
    theta = np.array([[p.nominal for p in simulator.parameters]])
    run = _make_scenario(kind, 600, size=1.0)
    observations = simulator.simulate(theta, run)
    for name, value in kind.states.items():
        changed_value = value + _STATE_CHANGE_SHARE * max(abs(value), scales.get(name, 1.0))
        changed_scenario = Scenario(run.times, {name: changed_value}, run.inputs)
        check(
            not np.array_equal(observations, simulator.simulate(theta, changed_scenario)),
            f"initial state {name} = {changed_value:g} in place of {value:g} to change the "
            "observations",
            "the same observation",
            f"{kind.__name__}.reset" if hasattr(kind, "reset") else kind.__name__,
        )
    simulator.close()
    return None


_STATE_CHANGE_SHARE = 0.01
"""Change of an initial state, as a fraction of its value or of the scale of its channel."""


def check_unknown_names_are_refused(kind: type[Simulator]) -> None:
    """Check that unknown names are rejected by a message that contains them.

    They are names of constants, channels, inputs and initial states.
    """
    scenarios = (
        Scenario(np.arange(3.0), initial={"no_such": 1.0}),
        Scenario(np.arange(3.0), inputs={"no_such": np.zeros(3)}),
        Scenario(np.arange(3.0), constants={"no_such": 1.0}),
    )

    def simulating(scenario: Scenario) -> Callable[[], object]:
        return lambda: kind().simulate(_draw_points(kind(), 1), scenario)

    attempts: list[Callable[[], object]] = [simulating(s) for s in scenarios]
    attempts += [lambda: kind(constants={"no_such": 1.0}), lambda: kind(observe=["no_such"])]
    for attempt in attempts:
        try:
            attempt()
        except InputError as error:
            check("no_such" in str(error), "a message that names it", error, kind.__name__)
            continue
        raise CheckError(
            f"expected InputError for an unknown name; found none; see {kind.__name__}"
        )


def check_chosen_channels_are_the_same_columns(kind: type[Simulator]) -> NotApplicable | None:
    """Check that `observe` selects and orders columns without changing their values."""
    full_simulator = kind()
    names = [c.name for c in full_simulator.channels][::-1]
    if len(names) == 1:
        full_simulator.close()
        return NotApplicable("it has one channel")
    reordered_simulator = kind(observe=names)
    points = _draw_points(full_simulator, 2)
    is_same = is_bitwise_equal(
        np.ascontiguousarray(full_simulator.simulate(points, _make_scenario(kind))[:, :, ::-1]),
        np.ascontiguousarray(reordered_simulator.simulate(points, _make_scenario(kind))),
    )
    check(
        is_same,
        "the same columns in the requested order",
        "others",
        f"{kind.__name__}: self.columns",
    )
    full_simulator.close()
    reordered_simulator.close()
    return None


SIMULATOR_CHECKS: tuple[Check, ...] = (
    check_declaration_is_complete,
    check_units_are_known,
    check_observations_have_the_declared_shape,
    check_arguments_are_not_changed,
    check_same_proposal_gives_the_same_bits,
    check_parameters_that_are_not_numbers_spoil_only_their_lane,
    check_every_parameter_shows,
    check_initial_states_show,
    check_unknown_names_are_refused,
    check_chosen_channels_are_the_same_columns,
    check_hooks_have_the_declared_shapes,
    check_step_goes_on_by_its_seconds,
    check_forces_act,
    check_levels_can_be_set,
)

_SIMULATES = check_observations_have_the_declared_shape
_REPEATS = check_same_proposal_gives_the_same_bits

SIMULATOR_NEEDS: Mapping[Check, tuple[Check, ...]] = {
    _SIMULATES: (check_declaration_is_complete,),
    check_arguments_are_not_changed: (_SIMULATES,),
    _REPEATS: (check_arguments_are_not_changed,),
    check_parameters_that_are_not_numbers_spoil_only_their_lane: (_REPEATS,),
    check_every_parameter_shows: (_REPEATS,),
    check_initial_states_show: (_REPEATS,),
    check_unknown_names_are_refused: (_SIMULATES,),
    check_chosen_channels_are_the_same_columns: (_REPEATS,),
    check_hooks_have_the_declared_shapes: (_SIMULATES,),
    check_step_goes_on_by_its_seconds: (_REPEATS, check_hooks_have_the_declared_shapes),
    check_forces_act: (_REPEATS, check_hooks_have_the_declared_shapes),
    check_levels_can_be_set: (_REPEATS, check_hooks_have_the_declared_shapes),
}
"""For each check, the checks that must pass for it to be meaningful."""
