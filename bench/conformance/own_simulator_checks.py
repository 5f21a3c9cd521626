"""Conformance checks of the methods that only user-defined simulators have."""

from __future__ import annotations

import numpy as np

from bench.conformance.check_base import CheckError, NotApplicable, check, is_bitwise_equal
from sims.core.simulator import Array, InputError, Simulator
from sims.own_simulator import OwnSimulator
from sims.own_simulator_engine import inertia_of, observed

_FORCED_STEPS = 20
"""Number of steps of a run in which a force is applied."""
_MAX_TRIED_FORCE = 1e6
"""Maximum force that is tried, in N, N m or m/s^2; a small force may not overcome friction."""
_CHECKED_STEP = 5
"""Number of steps after which the effect of a force in the first step must not have grown."""
_GROWTH_RATIO = 2.5
"""Ratio of velocity changes above which the effect of a force has grown."""


def _as_own_simulator(kind: type[Simulator]) -> type[OwnSimulator] | None:
    return kind if issubclass(kind, OwnSimulator) else None


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
    user_class = _as_own_simulator(kind)
    if user_class is None:
        return _NOT_OWN
    forced = user_class.apply_force is not OwnSimulator.apply_force
    heavy = user_class.inertia is not OwnSimulator.inertia
    hook = "apply_force" if forced else "inertia"
    if forced or heavy:
        expected = f"the attributes coordinates and rates with {hook}"
        check(bool(user_class.coordinates), expected, "none", user_class.__name__)
    simulator = user_class()
    names = [c.name for c in simulator.channels]
    _start_run(simulator)
    try:
        for _ in range(2):
            observation = simulator.observe()
            for name in dict.fromkeys(
                [*names, *user_class.coordinates, *user_class.rates, *user_class.levels]
            ):
                observed(simulator, observation, name)
            if heavy:
                _check_inertia(user_class, inertia_of(simulator))
            if forced:
                simulator.apply_force(np.zeros(len(user_class.coordinates)))
            _make_step(simulator)
    except InputError as error:
        message = str(error).removeprefix(f"simulator {user_class.name}: ")
        expected_text, _, found_text = message.partition(", found ")
        raise CheckError(
            f"{expected_text}; found {found_text or 'it is not'}; see {user_class.__name__}"
        ) from None
    finally:
        simulator.close()
    return None


def _check_inertia(kind: type[OwnSimulator], value: float | Array) -> None:
    """Check that an inertia is a positive number, or a symmetric positive definite matrix (D, D).

    D is the number of coordinates. Any other inertia would give accelerations without meaning.

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
    """Check that twice as many steps of half the length lead to about the same state."""
    user_class = _as_own_simulator(kind)
    if user_class is None:
        return _NOT_OWN
    simulator = user_class()
    full_change, half_change = (
        _compute_scaled_change(simulator, user_class.time_step / n, _COMPARED_STEPS * n)
        for n in (1, 2)
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
    location = f"{user_class.__name__}.step: the engine must step by `seconds`"
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

    The run has `steps` steps of `seconds` each, with constant inputs.
    """
    inputs = {c.name: c.scale for c in simulator.inputs}

    def observation() -> Array:
        readings = simulator.observe()
        return np.array(
            [observed(simulator, readings, c.name) / c.scale for c in simulator.channels]
        )

    _start_run(simulator)
    initial = observation()
    for _ in range(steps):
        simulator.step(inputs, seconds)
    return observation() - initial


def check_forces_act(kind: type[Simulator]) -> NotApplicable | None:
    """Check that a force along each coordinate changes the motion, and acts for one step only.

    It must not act in the next run.
    """
    user_class = _as_own_simulator(kind)
    if user_class is None:
        return _NOT_OWN
    if user_class.apply_force is OwnSimulator.apply_force:
        return NotApplicable("it takes no forces (it has no method apply_force)")
    simulator, location = user_class(), f"{user_class.__name__}.apply_force"
    unforced = _simulate_motion(simulator, None)
    for place, name in enumerate(user_class.coordinates):
        forced = unforced
        size = 1.0
        while is_bitwise_equal(unforced, forced) and size <= _MAX_TRIED_FORCE:
            force = np.zeros(len(user_class.coordinates))
            force[place] = size
            forced = _simulate_motion(simulator, force)
            size *= 10.0
        found_text = f"the same motion with forces up to {_MAX_TRIED_FORCE:g}"
        check(
            not is_bitwise_equal(unforced, forced),
            f"a force along {name} to change the motion",
            found_text,
            location,
        )
        is_restored = is_bitwise_equal(unforced, _simulate_motion(simulator, None))
        reset = f"{user_class.__name__}.reset: it must remove a force that was applied"
        check(is_restored, "the same run after one with forces", "another", reset)
        velocity = np.abs(forced - unforced)[:, len(user_class.coordinates) + place]
        has_grown = 0.0 < velocity[1] * _GROWTH_RATIO < velocity[_CHECKED_STEP]
        expected = f"a force along {name} to act in the next step alone"
        check(not has_grown, expected, "that it acts in later steps too", location)
    simulator.close()
    return None


def _simulate_motion(simulator: OwnSimulator, force: Array | None) -> Array:
    """Simulate coordinates and rates (K + 1, 2 D) of a run; the force acts in its first step."""
    names = (*simulator.coordinates, *simulator.rates)
    _start_run(simulator)
    rows = []
    for i in range(_FORCED_STEPS + 1):
        observation = simulator.observe()
        rows.append([observed(simulator, observation, name) for name in names])
        if force is not None:
            simulator.apply_force(force if i == 0 else np.zeros_like(force))
        _make_step(simulator)
    return np.array(rows)


def check_levels_can_be_set(kind: type[Simulator]) -> NotApplicable | None:
    """Check that `put` sets a level, which `observe` returns, and leaves other levels unchanged."""
    user_class = _as_own_simulator(kind)
    if user_class is None:
        return _NOT_OWN
    if user_class.put is OwnSimulator.put or not user_class.levels:
        return NotApplicable("its levels cannot be set (it has no method put)")
    simulator, location = user_class(), f"{user_class.__name__}.put"
    for name in user_class.levels:
        _start_run(simulator)
        _make_step(simulator)
        levels_before = {level: float(simulator.observe()[level]) for level in user_class.levels}
        expected_levels = {**levels_before, name: 0.9 * levels_before[name] + 0.01}
        simulator.put({name: expected_levels[name]})
        found_levels = {level: float(simulator.observe()[level]) for level in user_class.levels}
        is_same = np.allclose(
            list(found_levels.values()), list(expected_levels.values()), rtol=1e-9, atol=1e-12
        )
        check(is_same, f"levels {expected_levels} after put({name})", found_levels, location)
    simulator.close()
    return None
