"""Conformance checks of the methods that only user-defined simulators have."""

from __future__ import annotations

import numpy as np

from bench.conformance.check_base import CheckError, NotApplicable, check, is_bitwise_equal
from sims.core.simulator import Array, InputError, Simulator
from sims.own_simulator import OwnSimulator
from sims.own_simulator_engine import inertia_of, observed

_STEPS = 20
"""Number of steps of a run in which a force is applied."""
_LARGEST = 1e6
"""Maximum force that is tried, in N, N m or m/s^2; a small force may not overcome friction."""
_LATER = 5
"""Number of steps after which the effect of a force in the first step must not have grown."""
_GROWN = 2.5
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
    own = _as_own_simulator(kind)
    if own is None:
        return _NOT_OWN
    forced = own.apply_force is not OwnSimulator.apply_force
    heavy = own.inertia is not OwnSimulator.inertia
    hook = "apply_force" if forced else "inertia"
    if forced or heavy:
        what = f"the attributes coordinates and rates beside {hook}"
        check(bool(own.coordinates), what, "none", own.__name__)
    simulator = own()
    names = [c.name for c in simulator.channels]
    _start_run(simulator)
    try:
        for _ in range(2):
            observation = simulator.observe()
            for name in dict.fromkeys([*names, *own.coordinates, *own.rates, *own.levels]):
                observed(simulator, observation, name)
            if heavy:
                _check_inertia(own, inertia_of(simulator))
            if forced:
                simulator.apply_force(np.zeros(len(own.coordinates)))
            _make_step(simulator)
    except InputError as error:
        message = str(error).removeprefix(f"simulator {own.name}: ")
        wanted, _, found = message.partition(", found ")
        raise CheckError(f"{wanted}; found {found or 'it is not'}; see {own.__name__}") from None
    finally:
        simulator.close()
    return None


def _check_inertia(kind: type[OwnSimulator], given: float | Array) -> None:
    """Check that an inertia is a positive number, or a symmetric positive definite matrix (D, D).

    D is the number of coordinates. Any other inertia would give accelerations without meaning.

    Raises:
        CheckError: it is not.
    """
    inertia = np.atleast_2d(given)
    sound = bool(np.isfinite(inertia).all()) and np.allclose(inertia, inertia.T)
    sound = sound and bool(np.linalg.eigvalsh(inertia).min() > 0)
    wanted = "inertia: expected a positive number, or a symmetric positive definite matrix"
    if not sound:
        raise CheckError(f"{wanted}; found {inertia.tolist()}; see {kind.__name__}.inertia")


def check_step_goes_on_by_its_seconds(kind: type[Simulator]) -> NotApplicable | None:
    """Check that twice as many steps of half the length lead to about the same state."""
    own = _as_own_simulator(kind)
    if own is None:
        return _NOT_OWN
    simulator = own()
    whole, half = (_compute_scaled_change(simulator, own.time_step / n, _FEW * n) for n in (1, 2))
    simulator.close()
    moved = np.abs(whole) > _ROUNDING
    if not moved.any():
        return NotApplicable("nothing moves")
    ratio = float(np.min(np.abs(half[moved] / whole[moved])))
    what = f"{2 * _FEW} steps of time_step / 2 to lead as far as {_FEW} of time_step"
    look = f"{own.__name__}.step: the engine must step by `seconds`"
    check(ratio < _FARTHER, what, f"{ratio:.2g} times as far", look)
    return None


_FEW = 8
"""Number of steps that are compared with twice as many of half their length."""
_FARTHER = 1.6
"""Ratio of distances above which the simulator ignores the length of a step.

The ratio is then 2 or more; it is near 1 for any integrator that resolves the motion.
"""
_ROUNDING = 1e-9
"""Minimum change of a channel, in units of its scale, that counts as motion."""


def _compute_scaled_change(simulator: OwnSimulator, seconds: float, steps: int) -> Array:
    """Compute the change (C,) of each of C channels over a run, in units of its scale.

    The run has `steps` steps of `seconds` each, with constant inputs.
    """
    inputs = {c.name: c.scale for c in simulator.inputs}

    def observation() -> Array:
        now = simulator.observe()
        return np.array([observed(simulator, now, c.name) / c.scale for c in simulator.channels])

    _start_run(simulator)
    before = observation()
    for _ in range(steps):
        simulator.step(inputs, seconds)
    return observation() - before


def check_forces_act(kind: type[Simulator]) -> NotApplicable | None:
    """Check that a force along each coordinate changes the motion, and acts for one step only.

    It must not act in the next run.
    """
    own = _as_own_simulator(kind)
    if own is None:
        return _NOT_OWN
    if own.apply_force is OwnSimulator.apply_force:
        return NotApplicable("it takes no forces (it has no method apply_force)")
    simulator, look = own(), f"{own.__name__}.apply_force"
    still = _simulate_motion(simulator, None)
    for place, name in enumerate(own.coordinates):
        moved = still
        size = 1.0
        while is_bitwise_equal(still, moved) and size <= _LARGEST:
            force = np.zeros(len(own.coordinates))
            force[place] = size
            moved = _simulate_motion(simulator, force)
            size *= 10.0
        found = f"the same motion with forces up to {_LARGEST:g}"
        check(
            not is_bitwise_equal(still, moved),
            f"a force along {name} to change the motion",
            found,
            look,
        )
        again = is_bitwise_equal(still, _simulate_motion(simulator, None))
        reset = f"{own.__name__}.reset: it must take away a force that was applied"
        check(again, "the same run after one with forces", "another", reset)
        velocity = np.abs(moved - still)[:, len(own.coordinates) + place]
        grown = 0.0 < velocity[1] * _GROWN < velocity[_LATER]
        what = f"a force along {name} to act in the next step alone"
        check(not grown, what, "that it acts in later steps too", look)
    simulator.close()
    return None


def _simulate_motion(simulator: OwnSimulator, force: Array | None) -> Array:
    """Simulate coordinates and rates (K + 1, 2 D) of a run; the force acts in its first step."""
    names = (*simulator.coordinates, *simulator.rates)
    _start_run(simulator)
    rows = []
    for i in range(_STEPS + 1):
        observation = simulator.observe()
        rows.append([observed(simulator, observation, name) for name in names])
        if force is not None:
            simulator.apply_force(force if i == 0 else np.zeros_like(force))
        _make_step(simulator)
    return np.array(rows)


def check_levels_can_be_set(kind: type[Simulator]) -> NotApplicable | None:
    """Check that `put` sets a level, which `observe` returns, and leaves other levels unchanged."""
    own = _as_own_simulator(kind)
    if own is None:
        return _NOT_OWN
    if own.put is OwnSimulator.put or not own.levels:
        return NotApplicable("its levels cannot be set (it has no method put)")
    simulator, look = own(), f"{own.__name__}.put"
    for name in own.levels:
        _start_run(simulator)
        _make_step(simulator)
        before = {level: float(simulator.observe()[level]) for level in own.levels}
        wanted = {**before, name: 0.9 * before[name] + 0.01}
        simulator.put({name: wanted[name]})
        found = {level: float(simulator.observe()[level]) for level in own.levels}
        same = np.allclose(list(found.values()), list(wanted.values()), rtol=1e-9, atol=1e-12)
        check(same, f"levels {wanted} after put({name})", found, look)
    simulator.close()
    return None
