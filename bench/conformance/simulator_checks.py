"""Conformance checks of a simulator, with those that only user-defined simulators have."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from operator import itemgetter

import numpy as np

from bench.conformance.check_base import Check, CheckError, NotApplicable, check, is_bitwise_equal
from sims.core.simulator import Array, Channel, Constant, InputError, Parameter, Scenario, Simulator
from sims.core.unit_cube import UnitCube
from sims.own_simulator import OwnSimulator, get_checked_inertia, get_observed_value
from sims.recording.unit_conversion import is_unit

_FORCED_STEPS = 20
"""Number of steps of a run in which a force is applied."""
_MAX_TRIED_FORCE = 1e6
"""Maximum force that is tried, in N, N m or m/s^2; a small force may not overcome friction."""
_CHECKED_STEP = 5
"""Number of steps after which the effect of a force in the first step must not have grown."""
_GROWTH_RATIO = 2.5
"""Ratio of velocity changes above which the effect of a force has grown."""


_NOT_OWN = NotApplicable("it is not a subclass of OwnSimulator")


def _start_run(simulator: OwnSimulator) -> None:
    """Start a run with nominal parameters, default constants and default states."""
    theta = {p.name: p.nominal for p in simulator.parameters}
    constants = {c.name: c.value for c in simulator.constants}
    simulator.reset(theta, constants, dict(simulator.states))


def _make_step(simulator: OwnSimulator) -> None:
    simulator.step({c.name: 0.0 for c in simulator.inputs}, simulator.time_step)


def check_hooks_have_the_declared_shapes(kind: type[Simulator]) -> NotApplicable | None:
    """Check the types and shapes of the results of `observe`, `inertia` and `apply_force`.

    `observe` must return a number for every channel, coordinate, rate and level. `inertia` must
    return a number or a positive definite matrix (D, D). `apply_force` must accept (D,).
    """
    if not issubclass(kind, OwnSimulator):
        return _NOT_OWN
    # Optional hooks, which the class has if it overrides them.
    has_forces = kind.apply_force is not OwnSimulator.apply_force
    has_inertia = kind.inertia is not OwnSimulator.inertia
    hook = "apply_force" if has_forces else "inertia"
    if has_forces or has_inertia:
        expected = f"the attributes coordinates and rates with {hook}"
        check(bool(kind.coordinates), expected, "none", kind.__name__)
    simulator = kind()
    names = [c.name for c in simulator.channels]
    _start_run(simulator)
    try:
        for _ in range(2):  # before and after the first step
            observation = simulator.observe()
            for name in dict.fromkeys([*names, *kind.coordinates, *kind.rates, *kind.levels]):
                # It raises an InputError unless the value is a number.
                get_observed_value(simulator, observation, name)
            if has_inertia:
                _check_inertia(kind, get_checked_inertia(simulator))
            if has_forces:
                simulator.apply_force(np.zeros(len(kind.coordinates)))
            _make_step(simulator)
    except InputError as error:
        # The message "expected ..., found ..." is given the form of the checks' messages.
        message = str(error).removeprefix(f"simulator {kind.name}: ")
        expected_text, _, found_text = message.partition(", found ")
        raise CheckError(
            f"{expected_text}; found {found_text or 'it is not'}; see {kind.__name__}"
        ) from None
    finally:
        simulator.close()
    return None


def _check_inertia(kind: type[OwnSimulator], value: float | Array) -> None:
    """Check that an inertia is a positive number, or a symmetric positive definite matrix (D, D).

    D is the number of coordinates. Any other inertia would give accelerations without meaning.

    Args:
        kind: class of the simulator.
        value: the inertia that it returns.

    Raises:
        CheckError: it is not.
    """
    inertia = np.atleast_2d(value)
    is_valid = bool(np.isfinite(inertia).all()) and np.allclose(inertia, inertia.T)
    is_valid = is_valid and bool(np.linalg.eigvalsh(inertia).min() > 0)
    expected = "inertia: expected a positive number, or a symmetric positive definite matrix"
    if not is_valid:
        raise CheckError(f"{expected}; found {inertia.tolist()}; see {kind.__name__}.inertia")


def check_step_goes_on_by_its_seconds(kind: type[Simulator]) -> NotApplicable | None:
    """Check that twice as many steps of half the length lead to about the same state.

    A step that ignores its `seconds` would go twice as far.
    """
    if not issubclass(kind, OwnSimulator):
        return _NOT_OWN
    simulator = kind()
    full_change, half_change = (
        _compute_scaled_change(simulator, kind.time_step / n, _COMPARED_STEPS * n) for n in (1, 2)
    )
    simulator.close()
    has_moved = np.abs(full_change) > _MIN_MOTION
    if not has_moved.any():
        return NotApplicable("nothing moves")
    ratio = float(np.min(np.abs(half_change[has_moved] / full_change[has_moved])))
    expected = (
        f"{2 * _COMPARED_STEPS} steps of time_step / 2 to reach the same state as "
        f"{_COMPARED_STEPS} of time_step"
    )
    location = f"{kind.__name__}.step: the engine must step by `seconds`"
    check(ratio < _MAX_DISTANCE_RATIO, expected, f"{ratio:.2g} times as far", location)
    return None


_COMPARED_STEPS = 8
"""Number of steps that are compared with twice as many of half their length."""
_MAX_DISTANCE_RATIO = 1.6
"""Ratio of distances above which the simulator ignores the length of a step.

The ratio is then 2 or more; it is near 1 for any integrator that resolves the motion.
"""
_MIN_MOTION = 1e-9
"""Minimum change of a channel, in units of its scale, that counts as motion."""


def _compute_scaled_change(simulator: OwnSimulator, seconds: float, steps: int) -> Array:
    """Compute the change (C,) of each of C channels over a run, in units of its scale.

    Args:
        simulator: simulator that is started anew; its inputs are constant.
        seconds: length of each step in seconds.
        steps: number of steps.
    """
    inputs = {c.name: c.scale for c in simulator.inputs}

    def observation() -> Array:
        readings = simulator.observe()
        return np.array(
            [get_observed_value(simulator, readings, c.name) / c.scale for c in simulator.channels]
        )

    _start_run(simulator)
    initial = observation()
    for _ in range(steps):
        simulator.step(inputs, seconds)
    return observation() - initial


def check_forces_act(kind: type[Simulator]) -> NotApplicable | None:
    """Check that a force along each coordinate changes the motion, and acts for one step only.

    It must not act in the next run either.

    Args:
        kind: Simulator class under test; the check applies to an `OwnSimulator` with `apply_force`.

    Returns:
        A reason why the check is not applicable; None if it passed.
    """
    if not issubclass(kind, OwnSimulator):
        return _NOT_OWN
    if kind.apply_force is OwnSimulator.apply_force:
        return NotApplicable("it takes no forces (it has no method apply_force)")
    simulator, location = kind(), f"{kind.__name__}.apply_force"
    unforced = _simulate_motion(simulator, None)
    for coordinate, name in enumerate(kind.coordinates):
        forced = unforced
        size = 1.0
        while is_bitwise_equal(unforced, forced) and size <= _MAX_TRIED_FORCE:
            force = np.zeros(len(kind.coordinates))
            force[coordinate] = size
            forced = _simulate_motion(simulator, force)
            size *= 10.0  # a heavy system needs a large force to move visibly
        found_text = f"the same motion with forces up to {_MAX_TRIED_FORCE:g}"
        check(
            not is_bitwise_equal(unforced, forced),
            f"a force along {name} to change the motion",
            found_text,
            location,
        )
        is_restored = is_bitwise_equal(unforced, _simulate_motion(simulator, None))
        reset = f"{kind.__name__}.reset: it must remove a force that was applied"
        check(is_restored, "the same run after one with forces", "another", reset)
        # The columns are the coordinates, then their rates. Row 1 is the state after the first
        # step, in which the force acts. A force that acts on would change the rate more and more.
        rate_change = np.abs(forced - unforced)[:, len(kind.coordinates) + coordinate]
        has_grown = 0.0 < rate_change[1] * _GROWTH_RATIO < rate_change[_CHECKED_STEP]
        expected = f"a force along {name} to act in the next step alone"
        check(not has_grown, expected, "that it acts in later steps too", location)
    simulator.close()
    return None


def _simulate_motion(simulator: OwnSimulator, force: Array | None) -> Array:
    """Simulate coordinates and rates of a run without inputs; the force acts in its first step.

    Shapes: K steps, D coordinates.

    Args:
        simulator: Simulator written by a user, which is stepped here one step at a time.
        force: (D,) generalised force during the first step; None for a run without `apply_force`.

    Returns:
        (K + 1, 2 D) coordinates and rates before the first and after each of K steps.
    """
    names = (*simulator.coordinates, *simulator.rates)
    _start_run(simulator)
    observed_samples = []
    for i in range(_FORCED_STEPS + 1):
        observation = simulator.observe()
        observed_samples.append(
            [get_observed_value(simulator, observation, name) for name in names]
        )
        if force is not None:
            simulator.apply_force(force if i == 0 else np.zeros_like(force))
        _make_step(simulator)
    return np.array(observed_samples)


def check_levels_can_be_set(kind: type[Simulator]) -> NotApplicable | None:
    """Check that `put` sets a level, which `observe` returns, and leaves other levels unchanged.

    Levels are stored quantities of a user's simulator, such as the height of a liquid; `put` sets
    them and `observe` returns them.

    Args:
        kind: Simulator class under test.

    Returns:
        A reason why the check is not applicable; None if it passed.
    """
    if not issubclass(kind, OwnSimulator):
        return _NOT_OWN
    if kind.put is OwnSimulator.put or not kind.levels:
        return NotApplicable("its levels cannot be set (it has no method put)")
    simulator, location = kind(), f"{kind.__name__}.put"
    for name in kind.levels:
        _start_run(simulator)
        _make_step(simulator)
        levels_before = {level: float(simulator.observe()[level]) for level in kind.levels}
        # Another level than before, also if that is zero.
        expected_levels = {**levels_before, name: 0.9 * levels_before[name] + 0.01}
        simulator.put({name: expected_levels[name]})
        found_levels = {level: float(simulator.observe()[level]) for level in kind.levels}
        is_same = np.allclose(
            list(found_levels.values()), list(expected_levels.values()), rtol=1e-9, atol=1e-12
        )
        check(is_same, f"levels {expected_levels} after put({name})", found_levels, location)
    simulator.close()
    return None


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
    """Check that the declaration has valid names and a description, and no duplicates.

    The declaration is the class attributes: parameters, channels, constants, inputs, and the
    sentence `says`.

    Args:
        kind: Simulator class under test.
    """
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
    """Check that every parameter, channel, constant and input has a unit that can be converted.

    Recordings in other units can only be converted if the declared units are known.

    Args:
        kind: Simulator class under test.
    """
    for part in _list_named_parts(kind):
        check(
            is_unit(part.unit),
            f"a unit for {part.name} (such as m/s, rad, N*m; '1' for a number)",
            repr(part.unit),
            kind.__name__,
        )


def check_observations_have_the_declared_shape(kind: type[Simulator]) -> None:
    """Check that observations are (n, T, C) and finite, for several n and T.

    n is the number of parameter vectors, T that of samples and C that of channels.

    Args:
        kind: Simulator class under test.
    """
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
        for channel_index, channel in enumerate(simulator.channels):
            values = observations[:, :, channel_index]
            invalid_values = values[~np.isfinite(values)]
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

        Shapes: T samples, C channels.

        The first call's result is `batch_result`; `kind` is the simulator class under test.

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


def check_batch_independence(
    simulator: Simulator, parameter_sets: Array, scenario: Scenario, location: str
) -> None:
    """Check that a simulation depends neither on the others of its batch nor on their order.

    The parameter sets are simulated in one batch, one by one, and in reversed order.

    Args:
        simulator: simulator with the effect under test.
        parameter_sets: (n, P) parameters.
        scenario: run to simulate.
        location: where the author of the effect should look.

    Raises:
        CheckError: the observations are not equal bit for bit.
    """
    batch_result = simulator.simulate(parameter_sets, scenario)
    single_results = [simulator.simulate(row[None], scenario) for row in parameter_sets]
    reversed_result = simulator.simulate(parameter_sets[::-1], scenario)[::-1]
    is_same = is_bitwise_equal(batch_result, np.concatenate(single_results)) and is_bitwise_equal(
        batch_result, np.ascontiguousarray(reversed_result)
    )
    check(is_same, "bitwise equal results alone, in a batch and in any order", "others", location)


def _describe_first_difference(kind: type[Simulator], expected: Array, observations: Array) -> str:
    """Describe where two observations (n, T, C) first differ in time.

    Shapes: T samples, C channels.

    Args:
        kind: class of the simulator, with the names of its channels.
        expected: (n, T, C) expected observations.
        observations: (n, T, C) observations that were found.
    """
    if expected.shape != observations.shape:
        return f"shape {observations.shape} in place of {expected.shape}"
    is_different = (expected != observations) & ~(np.isnan(expected) & np.isnan(observations))
    if not is_different.any():
        return "zeros of the opposite sign"
    batch_element, sample, channel = min(
        np.argwhere(is_different).tolist(),
        key=itemgetter(1),  # by sample
    )
    expected_value = expected[batch_element, sample, channel]
    found_value = observations[batch_element, sample, channel]
    # All digits are shown if the values differ only by rounding.
    digits = 6 if f"{expected_value:.6g}" != f"{found_value:.6g}" else 17
    name = kind.channels[channel].name
    return (
        f"{name} = {found_value:.{digits}g} in place of {expected_value:.{digits}g} at sample "
        f"{sample}"
    )


def check_arguments_are_not_changed(kind: type[Simulator]) -> None:
    """Check that the simulator does not change `theta` and the scenario.

    The harness passes the same arrays to later calls, which would give other results.

    Args:
        kind: Simulator class under test.
    """
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
    """Check that a NaN parameter makes its own batch element NaN, and no other.

    A tuner may propose NaN; this must not change the results of other parameter vectors in the same
    batch.

    Args:
        kind: Simulator class under test.
    """
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
    """Check that each parameter changes some channel, in a run of ten seconds.

    A parameter without influence on any channel cannot be estimated. All inputs are 1. The base
    point is at 40 % of the training range; each parameter is then increased by 20 % of its range.

    Args:
        kind: Simulator class under test.
    """
    simulator = kind(observe=[c.name for c in kind.channels])
    cube = UnitCube(simulator.parameters)
    # Points inside the training range: outside it, a large friction may prevent all motion.
    low, high = cube.training
    points = np.tile(low + 0.4 * (high - low), (1 + cube.dim, 1))
    # One point for each parameter, changed in that direction alone.
    points[1:] += 0.2 * np.diag(high - low)
    # 600 samples at 60 Hz are ten seconds.
    inputs = {c.name: np.ones(600) for c in simulator.inputs}
    observations = simulator.simulate(
        cube.to_physical(points), Scenario(np.arange(600) / 60.0, inputs=inputs)
    )
    for parameter, changed_observations in zip(simulator.parameters, observations[1:], strict=True):
        check(
            not np.array_equal(changed_observations, observations[0]),
            f"parameter {parameter.name} to change the observations",
            "nothing",
            kind.__name__,
        )
    simulator.close()


def check_initial_states_show(kind: type[Simulator]) -> NotApplicable | None:
    """Check that each initial state changes some channel, in a run of ten seconds.

    Each state is changed by the share `_STATE_CHANGE_SHARE` of its value or of its channel's scale,
    whichever is larger.

    Args:
        kind: Simulator class under test.

    Returns:
        A reason why the check is not applicable; None if it passed.
    """
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
    """Check that `observe` selects and orders columns without changing their values.

    The simulator is run with all channels and with the reversed list of channels; the columns must
    agree bit for bit.

    Args:
        kind: Simulator class under test.

    Returns:
        A reason why the check is not applicable; None if it passed.
    """
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


_SIMULATES = check_observations_have_the_declared_shape
_REPEATS = check_same_proposal_gives_the_same_bits

SIMULATOR_CHECKS: Mapping[Check, tuple[Check, ...]] = {
    check_declaration_is_complete: (),
    check_units_are_known: (),
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
"""Checks in the order in which they run, each with those that must pass for it to be meaningful."""
