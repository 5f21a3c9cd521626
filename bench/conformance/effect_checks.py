"""Conformance checks of an effect on every system that can have it."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from contextlib import suppress

import numpy as np

from bench.conformance.check_base import Check, CheckError, NotApplicable, check, is_bitwise_equal
from bench.conformance.robot_place_checks import (
    check_family_is_the_sum_of_its_members,
    check_it_acts_at_its_place_alone,
    check_lanes_of_a_robot_are_independent,
    check_nothing_at_zero_at_a_place,
    check_places_are_declared,
)
from bench.conformance.sample_subjects import FirstOrderTank, list_effect_places
from bench.conformance.simulator_checks import check_batch_independence
from bench.core.plugin_registries import PartUnavailableError, simulators
from sims import effects
from sims.core.effect import (
    Contact,
    Effect,
    Force,
    Friction,
    HiddenStateEffect,
    Input,
    Level,
    Sensor,
    Signal,
)
from sims.core.simulator import Array, InputError, Scenario
from sims.core.system import StateSnapshot, System
from sims.own_simulator import OwnSimulator
from sims.system_simulator import SystemSimulator

_NAME = re.compile(r"[a-z]+(\.[a-z_]+)?$")
_SAMPLES_PER_RUN = 60
"""Number of samples of a run."""
_SAMPLING_RATE = 30.0
"""Sampling rate of a run, Hz."""


def _iterate_systems() -> Iterator[type[SystemSimulator]]:
    """Yield the registered simulators of declared systems (`SystemSimulator`).

    Simulators whose packages are not installed are left out.
    """
    for name in simulators.names():
        with suppress(PartUnavailableError):
            kind = simulators.get(name)
            if issubclass(kind, SystemSimulator):
                yield kind


def _find_supporting_systems(effect: type[Effect]) -> Iterator[type[SystemSimulator]]:
    """Return the simulators whose systems can have the effect."""
    kinds: tuple[type[SystemSimulator], ...] = (*_iterate_systems(), FirstOrderTank)
    return (kind for kind in kinds if not effect.misses(kind.system))


def _make_simulator_with_effect(
    host: type[SystemSimulator], effect: type[Effect]
) -> SystemSimulator:
    """Make a simulator with the effect, and register the effect if necessary.

    It uses the batch engine, or its own engine if it is a user-defined simulator.

    Args:
        host: simulator class.
        effect: class of the effect.

    Raises:
        CheckError: another effect has the same name.
    """
    if effect.name not in effects.list_names():
        effects.register_effect(effect)
    elif effects.get_effect(effect.name) is not effect:
        raise CheckError(f"expected a unique name; found {effect.name}; see {effect.__name__}.name")
    return host(engine=_choose_engine(host), effects=[effect.name])


def _choose_engine(host: type[SystemSimulator]) -> str | None:
    return None if issubclass(host, OwnSimulator) else "batch"


def _make_scenario(system: type[System]) -> Scenario:
    """Make a run with nonzero velocities in all directions and inputs that change.

    Every effect of the library must have a chance to act on this run.

    Args:
        system: System whose states and inputs the run has.
    """
    times = np.arange(_SAMPLES_PER_RUN) / _SAMPLING_RATE
    # Initial values of states that are neither coordinates nor rates, such as levels, are among the
    # rates.
    initial = dict.fromkeys(system.rates, 0.7) | dict.fromkeys(system.coordinates, 0.4)
    # A system that strikes the ground with its last coordinate starts above it.
    if system.bounces:
        initial[system.coordinates[-1]] = 2.0
    # Both signs and a change every 0.4 s, so that dead bands, delays and lags are observable.
    inputs = {c.name: np.where(times % 0.8 < 0.4, 1.1, -0.3) for c in system.inputs}
    return Scenario(times, initial, inputs)


def _make_parameters(simulator: SystemSimulator, share: float) -> Array:
    """Return parameters (1, P) for one simulation with the effect.

    The system's own parameters are nominal; each coefficient of the effect is at the fraction
    `share` (0 to 1) of its plausible range.

    Args:
        simulator: Simulator with the effect.
        share: Fraction of the plausible range of each coefficient, 0 to 1.
    """
    # The coefficients of the effect follow the parameters of the system.
    base_count = len(simulator.system.parameters)
    values = [parameter.nominal for parameter in simulator.parameters[:base_count]]
    for coefficient in simulator.parameters[base_count:]:
        low, high = coefficient.bounds
        values.append(low + share * (high - low))
    return np.array([values])


def check_declaration_is_complete(effect: type[Effect]) -> None:
    """Check that the declaration of the effect is complete.

    It needs a name, a description and a source, and for each coefficient a unit and a range on at
    least one kind of system.
    """
    location = effect.__name__
    check(bool(_NAME.match(effect.name)), "a name family.form in lower case", effect.name, location)
    check(
        bool(effect.says) and bool(effect.source),
        "a sentence and a source",
        (effect.says, effect.source),
        location,
    )
    check(bool(effect.coefficients), "at least one coefficient", "none", location)
    for coefficient in effect.coefficients:
        # One unit and range for each kind of system; without a unit the kind does not have it.
        for unit, (low, high) in zip(coefficient.units, coefficient.plausible, strict=True):
            check(
                unit is None or low < high,
                f"a plausible range for {coefficient.name}",
                (low, high),
                location,
            )
    has_host = any(True for _ in _find_supporting_systems(effect)) or bool(
        list_effect_places(effect)
    )
    check(has_host, "a registered system or robot that supports it", "none", location)


def check_contribution_is_nothing_at_zero(effect: type[Effect]) -> NotApplicable | None:
    """Check that the effect contributes nothing at zero, bit for bit.

    The hook itself is called: engines skip effects that are zero, so a simulation would not show a
    contribution.
    """
    hosts = list(_find_supporting_systems(effect))
    for host in hosts:
        system, active_effect = host.system(), effect()
        c = np.zeros((len(effect.coefficients), 2, 1))
        is_same = all(
            is_bitwise_equal(contribution, inactive)
            for contribution, inactive in _compute_contributions(active_effect, c, host, system)
        )
        check(is_same, f"no contribution on {host.name} at zero", "one", effect.__name__)
    return None if hosts else NO_SUPPORTING_SYSTEM


def _compute_contributions(
    active_effect: Effect, c: Array, host: type[SystemSimulator], system: System
) -> list[tuple[Array, Array]]:
    """Return pairs of the hook's result and the expected result of an inactive effect.

    An inactive effect must do nothing: a force must be zero, and a sensor must return its input.

    Args:
        active_effect: the effect, with one of the hooks of its kind.
        c: (K, 2, 1) values of the K coefficients for two batch elements, all zero.
        host: simulator, which declares constants and inputs.
        system: system on which the effect acts.

    Returns:
        Pairs of arrays that must be equal bit for bit; none for an effect with a hidden state.
    """
    moment = _make_state_snapshot(host, system)
    # Arbitrary impact speeds (m/s), restitutions, signals and times (s) of two batch elements.
    speed, e = np.array([[0.3], [2.0]]), np.array([[0.4], [0.8]])
    values = np.array([[0.3, -0.2, 0.5], [0.1, 0.4, -0.6]])
    times = np.cumsum(np.full((2, 3), 0.1), axis=1)
    signal = Signal(values, np.full((2, 3), 0.1), np.array([[0.7], [0.2]]), times)
    # Adding zero turns -0.0, the result of a product with zero, into 0.0, and gives a scalar the
    # shape of the expected result.
    if isinstance(active_effect, Force):
        return [(active_effect.force(c, moment) + 0.0, np.zeros_like(moment.x))]
    if isinstance(active_effect, Friction):
        return [(active_effect.limit(c, moment) + np.zeros((2, 1)), np.zeros((2, 1)))]
    if isinstance(active_effect, Contact):
        return [
            (active_effect.restitution(c, e, speed), e),
            (active_effect.friction(c) + np.zeros((2, 1)), np.zeros((2, 1))),
        ]
    if isinstance(active_effect, Input):
        return [(active_effect.times(c, times), times), (active_effect.feel(c, signal), values)]
    if isinstance(active_effect, HiddenStateEffect):
        return []  # engines do not call it if its first coefficient is zero
    if isinstance(active_effect, Sensor):
        return [(active_effect.times(c, times), times), (active_effect.read(c, signal), values)]
    if isinstance(active_effect, Level):
        return [(active_effect.keep(c, e), e)]
    raise CheckError(
        f"expected one of the hook classes; found {type(active_effect).__mro__}; see "
        "sims.core.effect"
    )


def _make_state_snapshot(host: type[SystemSimulator], system: System) -> StateSnapshot:
    """Make the state of two batch elements in motion, for direct calls of an effect's hook.

    Coordinates and rates are arbitrary, but not zero, and different for each element.

    Args:
        host: simulator that declares constants and inputs.
        system: the system on which the effect acts.
    """
    theta = np.repeat([[p.nominal for p in system.parameters]], 2, axis=0)
    constants = {c.name: np.full((2, 1), c.value) for c in host.constants}
    # Inputs, and all other numbers here, are arbitrary and not zero, SI units.
    inputs = {c.name: np.full((2, 1), 0.3) for c in host.inputs}
    positions = np.linspace(0.2, 1.1, 2 * len(system.coordinates)).reshape(2, -1)
    times = np.full((2, 1), 0.4)
    return StateSnapshot(system, theta, constants, times, positions, -positions, inputs)


def check_it_shows_and_stays_finite(effect: type[Effect]) -> NotApplicable | None:
    """Check that the effect changes the observations and keeps them finite.

    Each system is simulated at 0.05, 0.3 and 0.7 of the plausible range. The observations must
    change at one of them at least, because a limit acts only at the low end of its range; those at
    0.7 must be finite.

    Args:
        effect: Effect class under test.

    Returns:
        A reason why the check is not applicable; None if it passed.
    """
    hosts = list(_find_supporting_systems(effect))
    for host in hosts:
        simulator = _make_simulator_with_effect(host, effect)
        base_simulator = host(engine=_choose_engine(host))
        scenario = _make_scenario(host.system)
        thetas = np.concatenate([_make_parameters(simulator, share) for share in (0.05, 0.3, 0.7)])
        observations = simulator.simulate(thetas, scenario)
        location = f"{effect.__name__} on {host.name}"
        check(bool(np.isfinite(observations[-1]).all()), "finite observations", "others", location)
        base_observations = base_simulator.simulate(
            thetas[:1, : len(host.system.parameters)], scenario
        )
        check(
            bool((observations != base_observations).any()),
            "a change inside the plausible range",
            "none",
            location,
        )
    return None if hosts else NO_SUPPORTING_SYSTEM


def check_lanes_are_independent(effect: type[Effect]) -> NotApplicable | None:
    """Check that observations do not depend on other elements of the batch, bit for bit.

    The same three parameter sets are simulated in one batch and one by one.

    Args:
        effect: Effect class under test.

    Returns:
        A reason why the check is not applicable; None if it passed.
    """
    hosts = list(_find_supporting_systems(effect))
    for host in hosts:
        simulator = _make_simulator_with_effect(host, effect)
        # Shares of the ranges of the parameters.
        parameter_sets = np.concatenate(
            [_make_parameters(simulator, share) for share in (0.2, 0.5, 0.9)]
        )
        scenario = _make_scenario(host.system)
        check_batch_independence(simulator, parameter_sets, scenario, effect.__name__)
    return None if hosts else NO_SUPPORTING_SYSTEM


def check_impossible_hosts_are_refused(effect: type[Effect]) -> NotApplicable | None:
    """Check that a system that cannot have the effect is rejected by name.

    A host is a simulator to which the effect is added. `misses` says what a system lacks for the
    effect. Adding the effect anyway must raise an `InputError` whose message names the effect.

    Args:
        effect: Effect class under test.

    Returns:
        A reason why the check is not applicable; None if it passed.
    """
    impossible = [host for host in _iterate_systems() if effect.misses(host.system)]
    for host in impossible:
        try:
            _make_simulator_with_effect(host, effect)
        except InputError as error:
            is_named = effect.name in str(error)
            check(is_named, "a message that names the effect", error, effect.__name__)
            continue
        raise CheckError(
            f"expected {host.name} to refuse it; found that it did not; see {effect.__name__}.needs"
        )
    return None if impossible else NotApplicable("every registered system supports it")


NO_SUPPORTING_SYSTEM = NotApplicable("no registered system supports it")

EFFECT_CHECKS: Mapping[Check, tuple[Check, ...]] = {
    check_declaration_is_complete: (),
    check_contribution_is_nothing_at_zero: (check_declaration_is_complete,),
    check_it_shows_and_stays_finite: (check_declaration_is_complete,),
    check_lanes_are_independent: (check_declaration_is_complete,),
    check_impossible_hosts_are_refused: (check_declaration_is_complete,),
    check_places_are_declared: (check_declaration_is_complete,),
    check_nothing_at_zero_at_a_place: (
        check_places_are_declared,
        check_contribution_is_nothing_at_zero,
    ),
    check_it_acts_at_its_place_alone: (check_places_are_declared, check_it_shows_and_stays_finite),
    check_family_is_the_sum_of_its_members: (
        check_places_are_declared,
        check_lanes_are_independent,
    ),
    check_lanes_of_a_robot_are_independent: (
        check_places_are_declared,
        check_lanes_are_independent,
    ),
}
"""Checks in the order in which they run, each with those that must pass for it to be meaningful."""
