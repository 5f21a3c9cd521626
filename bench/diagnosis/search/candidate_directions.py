"""Sensitivity directions of candidate effects along the trajectories.

The coefficients of an effect scale it (a drag), shape it (a period), or modify it (a wind speed,
which only matters if there is drag). Each scaling coefficient gives one direction. Shape parameters
and modifiers are tried on a grid, because trajectories do not depend on them while the effect is
off.

With y(c) the simulated runs at coefficients c, the direction of a scaling coefficient is

    d = (y(c) - y(0)) / c                                                                      (1)

at a c so small that y is linear in it. If an effect has no such c (a limit changes nothing until
the input reaches it), the direction is the whole change at one size, and is valid only there.

The coefficients at which a response is computed are called a probe (`CandidateDirection`). The
runs of a robot without contacts are not simulated for it: their linearised dynamics are used.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from bench.diagnosis.evaluation.noise_model import Mask
from bench.diagnosis.evaluation.parameter_bounds import (
    MIN_CYCLES_PER_RUN,
    compute_coefficient_bounds,
    list_coefficients,
)
from bench.diagnosis.evaluation.run_evaluator import RunEvaluator
from bench.diagnosis.evaluation.time_scaled_ranges import MAX_DECAY_FACTOR, is_instant, is_period
from bench.diagnosis.fitting.levenberg_marquardt import TrajectoryFit
from bench.diagnosis.fitting.trajectory_derivatives import (
    CandidateDirection,
    get_linearisation,
    is_finite_response,
)
from bench.diagnosis.search.reachable_levels import compute_reachable_levels
from sims.core.effect import ALL_PLACES, Effect, Input, members_of
from sims.core.simulator import Array, Parameter

INITIAL_PROBE_SHARE = 1e-4
"""Size at which a direction is first computed, as a share of the plausible range."""
INPUT_LEVEL_SHARES = (0.15, 0.35, 0.6, 0.85, 0.95, 0.99)
"""Sizes of limits, dead bands and backlash that are tried, as shares of the largest input."""
GAP_TRAVEL_SHARES = (0.003, 0.01, 0.03, 0.1, 0.3)
"""Widths of backlash that are tried, as shares of the largest range of motion within one run."""
COMPLIANCE_SHARES = (0.01, 0.09, 0.6)
"""Compliances of a joint that are tried, as shares of the largest plausible one."""
NONLINEAR_COEFFICIENT_KINDS = ("drive", "input/s", "input/s^2", "level", "travel", "stop", "give")
"""Kinds of coefficients for which a small size does not act like a large one.

A small limit removes everything, and within the backlash nothing is transmitted.
"""
RATE_LIMIT_SHARES = (0.015, 0.05, 0.12, 0.3, 0.6, 0.9)
"""Sizes of rate and error limits that are tried, as shares of the largest value.

These quantities, such as the rate of a command or the error of a servo, peak only briefly.
"""
ACCELERATION_LIMIT_SHARES = (1.0, 0.25, 0.06, 0.016, 0.004)
"""Acceleration limits that are tried, as shares of the largest one.

At a quarter of the acceleration, a command takes twice as long.
"""
SHIFTS = (0.01, 0.015, 0.023, 0.035, 0.053, 0.08, 0.12, 0.18)
"""Delays and lags of a robot's commands that are tried, in seconds.

A command that jumps is not nearly linear in time, so the response to a small lag does not show that
to a large one. A delay is recognised if it differs by less than a quarter.
"""
ROUNDING_SHARE = 1e-11
"""Minimum change of the observations that is not rounding, as a share of the largest one."""
SHAPE_GRID_SIZE = 12
"""Number of values tried of a shape parameter."""
MAX_FREQUENCIES = 96
"""Maximum number of frequencies tried."""
FREQUENCY_SPACING_EXPONENT = 1.5
"""Exponent of the spacing of frequencies, so that low ones are closer together."""
MODIFIER_SHARES = (-0.7, -0.25, 0.0, 0.25, 0.7)
"""Values of a modifier that are tried, as shares of its plausible range."""
END_STOP_DEPTH_SHARES = (0.005, 0.02, 0.08, 0.2)
"""Depths of end stops that are tried, as shares of the range of the coordinate."""
END_STOP_STIFFNESS_SHARES = (0.003, 0.03, 0.3, 3.0)
"""Stiffnesses of end stops that are tried, as shares of the largest plausible one."""
EVENT_TIME_COUNT = 24
"""Number of times tried for a single event."""


@dataclass(frozen=True)
class DirectionSet:
    """Candidate directions and their responses.

    Attributes:
        candidates: the K candidates.
        responses: (R, T, C, K) changes of the runs, per unit of the scaling coefficient, or the
            whole change for a fixed candidate.
    """

    candidates: tuple[CandidateDirection, ...]
    responses: Array


def compute_directions(
    evaluator: RunEvaluator, fit: TrajectoryFit, names: Sequence[str]
) -> DirectionSet:
    """Compute how the simulated runs respond to each effect that a fitted model lacks.

    The score test compares these responses with the residual of the model. A probe is an effect
    with the coefficients at which its response is computed.

    1. Compute the responses to scaling coefficients, and to limits of several sizes.
    2. Combine those that change the runs with modifiers: coefficients that act only together with
       another one.
    3. Discard the responses that change nothing.

    Args:
        evaluator: evaluator that simulates the recorded runs.
        fit: fit of the model, at which the responses are computed.
        names: names of effects that the model does not contain.

    Returns:
        The probes that change the runs, followed by those with modifiers, and the responses
        (R, T, C, K) of all K of them in R runs of T samples and C channels.
    """
    probes = [
        probe for name in names for probe in iterate_first_probes(evaluator, fit.effects, name)
    ]
    # 1. Responses.
    responses = _compute_directions(evaluator, fit, probes)
    is_acting = _find_observable_probes(evaluator, probes, responses)
    # 2. Modifiers.
    # The first responses show which coefficients change nothing alone. These are discarded below,
    # and appear only together with an acting coefficient.
    modifier_probes = list(_make_modifier_probes(evaluator, probes, is_acting))
    # 3. Responses that change something.
    active_indices = np.flatnonzero(is_acting)
    probes = [probes[i] for i in active_indices] + modifier_probes
    # This is the largest array of an explanation, so it is not copied: the rows of active probes
    # are moved up within it.
    for row, index in enumerate(active_indices.tolist()):
        if row < index:
            responses[row] = responses[index]
    responses = responses[: active_indices.size]
    if modifier_probes:
        responses = np.concatenate(
            [responses, _compute_directions(evaluator, fit, modifier_probes)]
        )
    # The probes become the last axis.
    return DirectionSet(tuple(probes), np.moveaxis(responses, 0, -1))


def list_probes(
    evaluator: RunEvaluator, model_effects: Sequence[str], names: Sequence[str]
) -> list[CandidateDirection]:
    """Return trial coefficients (probes) of effects, whose responses are regressors.

    An effect has a probe for each of its coefficients in which it is linear, and these for each of
    its shapes, for example for each period of a periodic force.

    Args:
        evaluator: the runs.
        model_effects: names of the effects that the model contains.
        names: names of the candidates.
    """
    probes: list[CandidateDirection] = []
    for name in names:
        bounds = compute_coefficient_bounds(evaluator, name)
        for probe in iterate_first_probes(evaluator, model_effects, name):
            # The value in the model file may be too large, so the correction may be negative.
            low, _ = bounds[probe.coefficient_index]
            can_be_negative = probe.can_be_negative or (low < 0 and not probe.is_single_size)
            probes.append(replace(probe, can_be_negative=can_be_negative))
    return probes


def iterate_first_probes(
    evaluator: RunEvaluator, model_effects: Collection[str], name: str
) -> Iterator[CandidateDirection]:
    """Yield the coefficients at which the responses of an effect are computed.

    A scaling coefficient is the strength of an effect, and zero switches the effect off. A shape
    parameter, such as a frequency, cannot be zero.

    1. If the effect names its own points, these are used.
    2. Each scaling coefficient gets a small value, with each shape: each combination of the values
       that are tried of the shape parameters.
    3. Effects that do not respond in proportion to their coefficients, such as end stops and
       limits, get several full sizes instead. Commands of a robot get delays of several sizes in
       addition.

    Args:
        evaluator: evaluator that simulates the recorded runs.
        model_effects: names of the effects that the model contains.
        name: name of the effect, with its place on a robot: ``drag.linear@elbow``.
    """
    parameters = list_coefficients(evaluator, name)
    effect = evaluator.available_effects[name]
    # What the first coefficient means, such as "stop" for an end stop.
    kind = effect.coefficients[0].of
    # 1. Points of the effect.
    for values in effect.probe_points():
        # All points act together. A regression finds a weight of either sign for each of them, from
        # which `Effect.combine` computes the coefficients of the effect.
        yield CandidateDirection(
            effect=name,
            grid_point=0,
            coefficient_index=0,
            coefficients=values,
            can_be_negative=True,
        )
    # A coefficient that cannot be zero is a shape parameter, and does not scale the effect.
    shape_indices = [i for i, p in enumerate(parameters) if p.bounds[0] > 0]
    shapes = _list_shapes(evaluator, model_effects, name, shape_indices)
    # 2. Small values for each shape.
    # A small limit of a force or a rate would remove all of it.
    if kind not in NONLINEAR_COEFFICIENT_KINDS and not effect.probe_points():
        yield from _make_small_probes(name, parameters, shape_indices, shapes)
    # 3. Full sizes, numbered after the shapes.
    next_grid_point = len(shapes)
    lowest, highest = parameters[0].bounds
    if kind == "stop":
        yield from _make_end_stop_candidates(evaluator, name, next_grid_point)
        return
    # Only robots without contacts have a linearisation.
    if kind == "shift" and evaluator.has_linearisation:
        yield from _make_shift_probes(effect, highest, next_grid_point)
    # A small limit does not act like a large one, so limits are tried at values that the input
    # reaches.
    if kind in NONLINEAR_COEFFICIENT_KINDS or (kind in ("input", "error") and lowest == 0):
        yield from _make_limit_probes(
            evaluator, name, next_grid_point, np.array(shapes) if shape_indices else None
        )


def _list_shapes(
    evaluator: RunEvaluator,
    model_effects: Collection[str],
    name: str,
    shape_indices: Sequence[int],
) -> list[tuple[float, ...]]:
    """Return all combinations of the values that are tried of an effect's shape parameters.

    A shape parameter, such as a frequency, does not scale the effect. Without shape parameters,
    there is one combination, which is empty.

    Args:
        evaluator: evaluator with the recorded runs.
        model_effects: names of the effects that the model contains.
        name: name of the effect, with its place on a robot: ``drag.linear@elbow``.
        shape_indices: indices of the shape parameters among the coefficients of the effect.
    """
    parameters = list_coefficients(evaluator, name)
    coefficients = evaluator.available_effects[name].coefficients
    travel = evaluator.get_effect_travel(name)
    # "rotor" is the share of a joint's inertia that its rotor has. If the model has this inertia as
    # an effect already, it is taken over from there, so only the smallest value is tried.
    grids = [
        parameters[i].bounds[:1]
        if coefficients[i].of == "rotor" and _is_contained_in_model(evaluator, model_effects, name)
        else _make_shape_grid(evaluator, parameters[i], coefficients[i].tried, travel)
        for i in shape_indices
    ]
    return list(product(*grids))


def _make_small_probes(
    name: str,
    parameters: Sequence[Parameter],
    shape_indices: Sequence[int],
    shapes: Sequence[tuple[float, ...]],
) -> Iterator[CandidateDirection]:
    """Yield a small value of each scaling coefficient of an effect, with each of its shapes.

    The values are so small that the runs respond to them in proportion. All other scaling
    coefficients are zero.

    Args:
        name: name of the effect.
        parameters: the k coefficients of the effect, with their plausible ranges.
        shape_indices: indices of the coefficients that are shape parameters, such as frequencies.
        shapes: combinations of values of the shape parameters.
    """
    for grid_point, shape in enumerate(shapes):
        for index, parameter in enumerate(parameters):
            if index in shape_indices:
                continue
            low, high = parameter.bounds
            values = np.zeros(len(parameters))
            values[shape_indices] = shape
            values[index] = INITIAL_PROBE_SHARE * high
            # Those with the same grid point act together, such as a sine and a cosine.
            yield CandidateDirection(
                effect=name,
                grid_point=grid_point,
                coefficient_index=index,
                coefficients=values,
                can_be_negative=low < 0,
            )


def _make_shift_probes(
    effect: Effect, highest: float, first_grid_point: int
) -> Iterator[CandidateDirection]:
    """Yield delays and lags of commands of several sizes, in addition to a small one.

    Each is proposed for a fit on its own, and not selected together with other effects: a selection
    that begins with a lag in place of a wrong servo goes astray. Nothing is yielded for effects
    that are not on an input, such as sensors that read late.

    Args:
        effect: the effect.
        highest: largest plausible coefficient, in s.
        first_grid_point: number of the first candidate; the following ones count up from it.
    """
    if not isinstance(effect, Input):
        return
    sizes = [shift for shift in SHIFTS if shift < highest]
    for grid_point, size in enumerate(sizes, start=first_grid_point):
        yield CandidateDirection(
            effect=effect.name,
            grid_point=grid_point,
            coefficient_index=0,
            coefficients=np.array([size]),
            can_be_negative=False,
            is_only_proposed=True,
        )


def _is_contained_in_model(
    evaluator: RunEvaluator, model_effects: Collection[str], name: str
) -> bool:
    """Return whether the model already has a simpler effect that the effect `name` contains.

    An effect contains another one if it acts like it at some values of its coefficients, as
    Stribeck friction contains Coulomb friction. The simpler effect may also be in the model as a
    member of a family (one effect at all places).

    Args:
        evaluator: the runs, with all available effects.
        model_effects: names of the effects that the model contains.
        name: name of the candidate effect.
    """
    effects = [evaluator.available_effects[effect_name] for effect_name in model_effects]
    members = {m.name for effect in effects for m in members_of(effect)}
    return bool(members & set(evaluator.available_effects[name].contains))


def _make_end_stop_candidates(
    evaluator: RunEvaluator, name: str, first_grid_point: int
) -> Iterator[CandidateDirection]:
    """Yield end stops of several depths and stiffnesses at both ends of the range of a coordinate.

    The response to an end stop is not proportional to its coefficients: the coordinate touches it
    only beyond a position. So a derivative at zero says nothing, and each combination is simulated
    as it is, as one candidate.

    Args:
        evaluator: evaluator of the recorded runs.
        name: name of the end-stop effect.
        first_grid_point: number of the first candidate; the following ones count up from it.
    """
    # The side is 1 for the upper end of the range, and -1 for the lower end.
    end_stops = [
        coefficients
        for side in (1.0, -1.0)
        for coefficients in generate_end_stops(
            evaluator, name, side, END_STOP_STIFFNESS_SHARES, END_STOP_DEPTH_SHARES
        )
    ]
    for grid_point, coefficients in enumerate(end_stops, start=first_grid_point):
        yield CandidateDirection(
            effect=name,
            grid_point=grid_point,
            coefficient_index=0,
            coefficients=coefficients,
            # Its score is not restricted to a positive sign: the sign of the first coefficient
            # tells the end of the range, and both are valid.
            can_be_negative=True,
            is_single_size=True,
        )


def generate_end_stops(
    evaluator: RunEvaluator,
    name: str,
    side: float,
    stiffness_shares: Sequence[float],
    depth_shares: Sequence[float],
) -> Iterator[Array]:
    """Yield coefficients (k,) of end stops at one end of a coordinate's range.

    All combinations of stiffness and depth are tried, because the response to an end stop is not
    linear. There are none if the range of the coordinate is not recorded.

    The first coefficient is the stiffness, positive for an upper and negative for a lower end stop,
    the second one its position. All others are zero.

    Args:
        evaluator: evaluator with the recorded runs.
        name: name of an end-stop effect, with its place on a robot.
        side: 1 for the upper end, -1 for the lower end.
        stiffness_shares: stiffnesses, as fractions of the largest plausible one.
        depth_shares: depths within the range of the coordinate, as fractions of the range.
    """
    # Both are zero if the coordinate is not recorded.
    low, high = evaluator.get_coordinate_range(name)
    if not low < high:
        return
    parameters = list_coefficients(evaluator, name)
    max_stiffness = parameters[0].bounds[1]
    end = high if side > 0 else low
    for stiffness_share, depth_share in product(stiffness_shares, depth_shares):
        coefficients = np.zeros(len(parameters))
        coefficients[0] = side * stiffness_share * max_stiffness
        coefficients[1] = end - side * depth_share * (high - low)
        yield coefficients


def _make_limit_probes(
    evaluator: RunEvaluator, name: str, first_grid_point: int, shapes: Array | None
) -> Iterator[CandidateDirection]:
    """Yield limits, dead bands and backlash of several sizes that the motion or the input reaches.

    These effects change nothing below or above a size, so they are not linear in it, and several
    full sizes are simulated. A smaller or a larger size would change nothing or everything, so the
    sizes are fractions of the largest value that occurs in the recording.

    Args:
        evaluator: evaluator that simulates the recorded runs.
        name: name of the effect, with its place on a robot: ``drag.linear@elbow``.
        first_grid_point: number of the first candidate; the following ones count up from it.
        shapes: (n, k - 1) values of the shape parameters, such as a rotor's share of the
            inertia, to combine with each size; None if the effect has no shape parameters.
    """
    # One value for each member of a family, otherwise a single one.
    largest = compute_reachable_levels(evaluator, name)
    # A limit of a quantity that is always zero has no effect.
    if not largest.any():
        return
    # Fractions by the kind of quantity that is limited (`Coefficient.of`): the rate and the
    # acceleration of an input, the error of a servo, the travel of a joint (backlash), and a
    # compliance ("give"). All other kinds are levels of an input. The error of a servo peaks
    # briefly after a jump, as the rate of a command does.
    shares_by_kind = {
        "input/s": RATE_LIMIT_SHARES,
        "input/s^2": ACCELERATION_LIMIT_SHARES,
        "error": RATE_LIMIT_SHARES,
        "travel": GAP_TRAVEL_SHARES,
        "give": COMPLIANCE_SHARES,
    }
    kind = evaluator.available_effects[name].coefficients[0].of
    shares = shares_by_kind.get(kind, INPUT_LEVEL_SHARES)
    if kind == "travel" and evaluator.has_linearisation:
        # Simulating a robot costs a hundred times as much, so the extreme sizes are left out.
        shares = GAP_TRAVEL_SHARES[1:4]
    sizes = [share * largest for share in shares]
    if shapes is not None:
        sizes = [np.append(size, shape) for shape in shapes for size in sizes]
    for grid_point, size_and_shape in enumerate(sizes, start=first_grid_point):
        yield CandidateDirection(
            effect=name,
            grid_point=grid_point,
            coefficient_index=0,
            coefficients=size_and_shape,
            can_be_negative=False,
            is_single_size=True,
        )


def _make_shape_grid(
    evaluator: RunEvaluator,
    parameter: Parameter,
    specified_values: tuple[float, ...],
    travel: float,
) -> Array:
    """Return the values of a shape parameter at which the response to an effect is computed.

    A shape parameter, such as a frequency, cannot be fitted from zero: all its values are tried.
    Frequencies and periods have a grid fine enough to find any of them, event times are spread over
    the recording, and all other parameters have a geometric grid.

    Args:
        evaluator: evaluator with the recorded runs.
        parameter: shape parameter, with its unit and bounds.
        specified_values: values that the coefficient specifies itself, if any.
        travel: largest range of the position in one run, in m or rad.
    """
    if specified_values:
        return np.array(specified_values)
    low, high = parameter.bounds
    if parameter.unit == "Hz":
        # A periodic effect must complete a cycle within a run, otherwise any slow change would be
        # periodic.
        min_frequency = max(low, MIN_CYCLES_PER_RUN / evaluator.longest_duration)
        lowest_frequency = min(min_frequency, high / 2.0)
        return _make_frequency_grid(lowest_frequency, high, evaluator.longest_duration)
    # A period over position, such as that of cogging: its inverse is spaced like a frequency.
    if is_period(parameter, travel):
        frequencies = _make_frequency_grid(1.0 / high, 1.0 / low, travel)
        return 1.0 / frequencies
    if is_instant(parameter):
        clock_start, clock_end = evaluator.time_span
        # An event at the ends of the recording would have nothing before or after it.
        return np.linspace(clock_start, clock_end, EVENT_TIME_COUNT + 2)[1:-1]
    if parameter.unit == "s":
        # A decay much longer than the runs is constant within them; successive times differ by at
        # most a factor of two.
        high = max(min(high, MAX_DECAY_FACTOR * evaluator.longest_duration), 2.0 * low)
        return np.geomspace(low, high, int(np.ceil(np.log2(high / low))) + 1)
    return np.geomspace(low, high, SHAPE_GRID_SIZE)


def _make_frequency_grid(low: float, high: float, extent: float) -> Array:
    """Return a grid of frequencies from `low` to `high`, about half a cycle over `extent` apart.

    Two frequencies that differ by less are nearly the same signal in a run. `extent` is the length
    of the longest run in seconds, or the range of the position for frequencies over position.
    """
    half_cycle_count = 2.0 * (high - low) * extent
    count = int(np.clip(half_cycle_count, 4, MAX_FREQUENCIES))
    # Low frequencies are closer together, because their periods would be far apart otherwise.
    shares = np.linspace(0.0, 1.0, count) ** FREQUENCY_SPACING_EXPONENT
    frequencies: Array = low + (high - low) * shares
    return frequencies


def _find_observable_probes(
    evaluator: RunEvaluator, probes: Sequence[CandidateDirection], values: Array
) -> Mask:
    """Return the mask (K,) of the probes that change the runs by more than rounding errors.

    Shapes: R runs, T samples, C channels.

    Args:
        evaluator: run evaluator with the recorded runs.
        probes: K effects, each with the coefficients at which its response was computed.
        values: (K, R, T, C) change of the runs by each probe, divided by the size of the probe
            (`_compute_probe_sizes`).
    """
    # Rounding error (C,) of each channel.
    rounding = ROUNDING_SHARE * np.nanmax(np.abs(evaluator.observed), axis=(0, 1))
    # One changed channel is sufficient, because effects of a sensor show only in its channel.
    changes = [
        bool((np.abs(size * value) > rounding).any())
        for value, size in zip(values, _compute_probe_sizes(probes).tolist(), strict=True)
    ]
    acting: Mask = np.array(changes, dtype=bool)
    return acting


def _compute_probe_sizes(probes: Sequence[CandidateDirection]) -> Array:
    """Return the size c (K,) of each probe, by which the change of the runs is divided.

    With the runs y(c) at the scaling coefficient c, the direction is d = (y(c) - y(0)) / c, eq. (1)
    of the module docstring. If it is valid at one size only, it is the whole change, and c is one.
    """
    return np.array(
        [
            1.0 if probe.is_single_size else probe.coefficients[probe.coefficient_index]
            for probe in probes
        ]
    )


def _make_modifier_probes(
    evaluator: RunEvaluator, probes: Sequence[CandidateDirection], acting: Mask
) -> Iterator[CandidateDirection]:
    """Yield combinations with modifiers: coefficients that act only together with another one.

    An example is a wind speed, which only matters if there is drag. A coefficient counts as a
    modifier if its response is zero although another coefficient of its effect has one.

    Args:
        evaluator: evaluator, which has the coefficients of the effects.
        probes: K single coefficients whose responses were computed.
        acting: (K,) mask of the coefficients that change the runs.
    """
    # By name of the effect: its first acting coefficient, and its idle ones, which change nothing
    # alone.
    acting_probes: dict[str, CandidateDirection] = {}
    idle_probes: dict[str, list[CandidateDirection]] = {}
    for probe, acts in zip(probes, acting, strict=True):
        if acts:
            acting_probes.setdefault(probe.effect, probe)
        # The first shape (grid point 0) already shows whether a coefficient acts by itself. A limit
        # that is never reached is no modifier, and members of a family (an effect at all places)
        # do not modify each other.
        elif (
            probe.grid_point == 0
            and not probe.is_single_size
            and evaluator.available_effects[probe.effect].place != ALL_PLACES
        ):
            idle_probes.setdefault(probe.effect, []).append(probe)
    for name, modifiers in idle_probes.items():
        # An effect that does not act at all cannot be modified.
        if name in acting_probes:
            yield from _iterate_grid_points(evaluator, acting_probes[name], modifiers)


def _iterate_grid_points(
    evaluator: RunEvaluator, first: CandidateDirection, modifiers: Sequence[CandidateDirection]
) -> Iterator[CandidateDirection]:
    """Yield an active coefficient of an effect together with all combinations of modifier values.

    Each combination has a grid point of its own, because only one of them can be right.

    Args:
        evaluator: evaluator, which has the bounds of the coefficients.
        first: probe of the first coefficient of the effect with a response.
        modifiers: probes of the coefficients that act only together with it.
    """
    parameters = list_coefficients(evaluator, first.effect)
    points = product(MODIFIER_SHARES, repeat=len(modifiers))
    for grid_point, modifier_shares in enumerate(points, start=1):
        # All modifiers at zero give the effect that was already tried, as grid point 0.
        if not any(modifier_shares):
            continue
        grid_coefficients = first.coefficients.copy()
        for modifier, share in zip(modifiers, modifier_shares, strict=True):
            _, high = parameters[modifier.coefficient_index].bounds
            grid_coefficients[modifier.coefficient_index] = share * high
        yield CandidateDirection(
            effect=first.effect,
            grid_point=grid_point,
            coefficient_index=first.coefficient_index,
            coefficients=grid_coefficients,
            can_be_negative=first.can_be_negative,
        )


def _compute_directions(
    evaluator: RunEvaluator, fit: TrajectoryFit, probes: Sequence[CandidateDirection]
) -> Array:
    """Compute the directions (K, R, T, C): change of the runs per unit of a coefficient.

    A direction is d = (y(c) - y(0)) / c, with the simulated runs y(c) at a small coefficient c, eq.
    (1) of the module docstring. For a candidate that is valid at one size only, it is the whole
    change y(c) - y(0).

    Shapes: R runs, T samples, C channels.

    Args:
        evaluator: evaluator that simulates the recorded runs.
        fit: fit of the model without the candidates.
        probes: K coefficients at which to compute the response.
    """
    added = [(probe.effect, probe.coefficients) for probe in probes]
    # These are the largest arrays of a search, so all operations are in place.
    values = compute_responses(evaluator, fit, added)
    is_finite = is_finite_response(values)
    # A probe that the simulator cannot follow gets a direction of zeros.
    if not is_finite.all():
        values[~is_finite] = 0.0
    # A probe that is valid at one size only has the size 1.
    values /= _compute_probe_sizes(probes)[:, None, None, None]  # (1)
    return values


def compute_responses(
    evaluator: RunEvaluator, fit: TrajectoryFit, added: Sequence[tuple[str, Array]]
) -> Array:
    """Compute how the runs of a fitted model change if one effect is added, for each of K effects.

    Linearised responses are used if the simulator provides them, because they cost less.

    Shapes: R runs, T samples, C channels.

    Args:
        evaluator: evaluator that simulates the recorded runs.
        fit: fit of the model without these effects.
        added: K effects with their coefficients.

    Returns:
        Changes (K, R, T, C).
    """
    if evaluator.has_linearisation:
        return compute_effect_responses(evaluator, fit.theta, fit.initial_states, added)
    values = simulate_with_effect(evaluator, fit, added)
    values -= fit.simulated
    return values


def compute_effect_responses(
    evaluator: RunEvaluator, theta: Array, states: Array, added: Sequence[tuple[str, Array]]
) -> Array:
    """Compute how the runs of a robot change to first order if one effect is added, for K effects.

    Linearised dynamics cost much less than a simulation for each effect. Series effects (a further
    joint in series with a joint, such as backlash) cannot be linearised; they are simulated, and
    the result is cached. The result has single precision, because it is by far the largest array of
    an explanation and only a derivative.

    Shapes: R runs, T samples, C channels, P parameters, s states of a run.

    Args:
        evaluator: evaluator of the recorded runs of a robot.
        theta: (P,) parameters, without the added effects.
        states: (R, s) initial states.
        added: K effects with their coefficients.

    Returns:
        Changes of the runs (K, R, T, C); NaN where they are not finite.
    """
    # This import is needed for robots only.
    from sims.robot.dynamics.series_joints import is_series_effect

    runs, length, channels = evaluator.observed.shape
    responses: Array = np.full((len(added), runs, length, channels), np.nan, dtype=np.float32)
    cached_responses = evaluator.cached_responses
    keys = [(name, coefficients.tobytes()) for name, coefficients in added]
    missing_indices = [i for i, key in enumerate(keys) if key not in cached_responses]
    worker_arguments = [
        (run, theta, states[run], [added[i] for i in missing_indices]) for run in range(runs)
    ]
    for run, (values, simulation_count) in evaluator.worker_pool.map_unordered(
        evaluator, _compute_responses_of_run, worker_arguments
    ):
        # Values that overflow single precision become infinite here. A run may be shorter than the
        # longest one; its further samples stay NaN.
        with np.errstate(over="ignore"):
            responses[missing_indices, run, : values.shape[1]] = values
        evaluator.simulation_count += simulation_count
    responses[~is_finite_response(responses)] = np.nan
    for i, (name, _) in enumerate(added):
        key = keys[i]
        if key in cached_responses:
            responses[i] = cached_responses[key]
        elif is_series_effect(evaluator.available_effects[name]):
            # Simulated responses cost more, and are similar in all models near the data.
            cached_responses[key] = responses[i].copy()
    return responses


def _compute_responses_of_run(
    evaluator: RunEvaluator,
    run: int,
    theta: Array,
    states: Array,
    added: Sequence[tuple[str, Array]],
) -> tuple[Array, int]:
    """Compute how one run changes by each of K added effects (K, T, C); runs in a worker.

    Also return the number of simulations that were needed, since not all effects have a
    linearisation.

    Shapes: T samples, C channels, P parameters, s states of a run.

    Args:
        evaluator: run evaluator of all runs.
        run: index of the run.
        theta: (P,) parameters of the model without the added effects.
        states: (s,) initial state of the run.
        added: name and coefficients of each added effect.
    """
    linearisation = get_linearisation(evaluator, run, theta, states)
    return linearisation.compute_effect_responses(
        [(evaluator.available_effects[name], c) for name, c in added]
    )


def simulate_with_effect(
    evaluator: RunEvaluator, fit: TrajectoryFit, added: Sequence[tuple[str, Array]]
) -> Array:
    """Simulate the runs of a fitted model with one added effect, for each of K effects.

    Shapes: R runs, T samples, C channels.

    Args:
        evaluator: evaluator that simulates the recorded runs.
        fit: fit of the model without these effects.
        added: K effects with their coefficients.

    Returns:
        Observations (K, R, T, C).
    """
    run_count = len(evaluator.prepared_runs)
    # One row of parameters for each effect.
    theta = np.tile(fit.theta, (len(added), 1))
    for row, (name, coefficients) in zip(theta, added, strict=True):
        row[evaluator.coefficient_slices[name]] = coefficients
    # All candidates and runs are simulated in one engine call, as one batch.
    effect_count = len(added)
    simulated = evaluator.simulate(
        theta=np.repeat(theta, run_count, axis=0),
        runs=np.tile(np.arange(run_count), effect_count),
        states=np.tile(fit.initial_states, (effect_count, 1)),
    )
    return simulated.reshape(effect_count, run_count, *simulated.shape[1:])
