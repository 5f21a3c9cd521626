"""Conformance checks of an effect, on systems and on a robot.

The effect is tested on every registered system that can have it, and at every place of the robot
arm of `toy_systems`.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from operator import attrgetter
from typing import TYPE_CHECKING

import numpy as np

from bench.conformance.check_base import Check, CheckError, NotApplicable, check, is_bitwise_equal
from bench.conformance.simulator_checks import check_batch_independence
from bench.conformance.toy_systems import (
    OBSERVED_CHANNELS,
    FirstOrderTank,
    make_arm_scenario,
    make_arm_simulator,
)
from bench.core.plugin_registries import PartUnavailableError, simulators
from sims import effects
from sims.core.effect import (
    Contact,
    Effect,
    Force,
    Friction,
    HiddenState,
    HiddenStateEffect,
    Input,
    Level,
    ModelValueEffect,
    Sensor,
    Signal,
)
from sims.core.simulator import Array, InputError, Scenario
from sims.core.system import StateSnapshot, System
from sims.effects import registry
from sims.own_simulator import OwnSimulator
from sims.system_simulator import SystemSimulator

if TYPE_CHECKING:
    import mujoco

    from sims.robot.robot_simulator import RobotSimulator

NO_PLACE = NotApplicable("a robot has no place for it")
_NAME = re.compile(r"[a-z]+(\.[a-z_]+)?$")
"""Pattern of an effect's name: family.form in lower case."""
_SAMPLES_PER_RUN = 60
"""Number of samples of the run of a system."""
_SAMPLING_RATE = 30.0
"""Sampling rate of the run of a system, Hz."""
NO_SUPPORTING_SYSTEM = NotApplicable("no registered system supports it")
_TESTED_RANGE_SHARES = (0.3, 0.9)
"""Fractions of the plausible range at which the effect is tested at a place of the arm."""


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
        scenario = _make_system_scenario(host.system)
        thetas = np.concatenate(
            [_make_system_parameters(simulator, share) for share in (0.05, 0.3, 0.7)]
        )
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
            [_make_system_parameters(simulator, share) for share in (0.2, 0.5, 0.9)]
        )
        scenario = _make_system_scenario(host.system)
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


def _make_system_scenario(system: type[System]) -> Scenario:
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


def _make_system_parameters(simulator: SystemSimulator, share: float) -> Array:
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


def check_places_are_declared(effect: type[Effect]) -> NotApplicable | None:
    """Check that the effect is declared at each place of the robot.

    It needs a name, and for each coefficient a unit and a finite range. A place that does not exist
    must be rejected with a list of those that do.
    """
    classes = list_effect_places(effect)
    for effect_class in classes:
        location = f"{effect.__name__} at {effect_class.place or 'the world'}"
        expected_name = f"{effect.name}@{effect_class.place}" if effect_class.place else effect.name
        check(
            effect_class.name == expected_name, f"name {expected_name}", effect_class.name, location
        )
        for coefficient in effect_class.coefficients:
            is_finite = all(
                np.isfinite([low, high]).all() and low < high for low, high in coefficient.plausible
            )
            expected_range = f"a finite range for {coefficient.name}"
            check(is_finite, expected_range, coefficient.plausible, location)
            check(
                all(coefficient.units),
                f"a unit for {coefficient.name} ('1' for a number)",
                coefficient.units,
                location,
            )
    if not classes:
        return NO_PLACE
    places = [effect_class.place for effect_class in classes if effect_class.place]
    if places:
        _check_place_refusal(effect, places)
    return None


def _check_place_refusal(effect: type[Effect], places: Sequence[str]) -> None:
    """Check that the effect refuses a place that does not exist, and lists those that do.

    Raises:
        CheckError: it accepts the place, or its message does not list all `places`.
    """
    try:
        make_arm_simulator(effect).system.effect(f"{effect.name}@nowhere")
    except InputError as error:
        is_listed = all(place in str(error) for place in places)
        check(is_listed, f"a message that lists {', '.join(places)}", error, effect.__name__)
        return
    raise CheckError(f"expected place nowhere to be refused; found it is not; see {effect.name}")


def check_nothing_at_zero_at_a_place(effect: type[Effect]) -> NotApplicable | None:
    """Check that the effect at a place has no influence at zero, bit for bit.

    It must add no force and change neither the model nor the motion, whatever other batch elements
    do.
    """
    classes = list_effect_places(effect)
    if not classes:
        return NO_PLACE
    kind = make_arm_simulator(effect)
    base_observations = _simulate_arm(kind, np.empty((1, 0)))
    for effect_class in classes:
        location = f"{effect.__name__} at {effect_class.place or 'the world'}"
        c = np.zeros((len(effect_class.coefficients), 2, 1))
        # A family of effects, such as friction in all joints, has one part for each place; any
        # other effect is its only part.
        for part, coefficients in effect_class().parts(c):
            has_no_influence = _find_affected_quantities(part, coefficients, kind) == ()
            check(has_no_influence, "no contribution at zero", "one", location)
        # A batch of two: no effect, and the effect at 0.7 of its plausible range.
        thetas = np.concatenate(
            [_make_coefficients(effect_class, 0.0), _make_coefficients(effect_class, 0.7)]
        )
        observations = _simulate_arm(kind, thetas, [effect_class])
        # Adding zero turns -0.0 into 0.0.
        check(
            is_bitwise_equal(observations[:1] + 0.0, base_observations + 0.0),
            "the plain motion at zero",
            "other",
            location,
        )
    return None


def check_it_acts_at_its_place_alone(effect: type[Effect]) -> NotApplicable | None:
    """Check that the effect is observable, stays finite, and acts only at its place.

    For each place (joint, body, motor, channel or contact of the arm):

    * the observations are finite at 0.9 of the plausible range,
    * they change, but for a sensor effect only in its own channel, if that is observed,
    * no two places change the same model fields, coordinates or signals.
    """
    classes = list_effect_places(effect)
    if not classes:
        return NO_PLACE
    kind = make_arm_simulator(effect)
    base_observations = _simulate_arm(kind, np.empty((1, 0)))
    fields_by_part = {}
    for effect_class in classes:
        location = f"{effect.__name__} at {effect_class.place or 'the world'}"
        thetas = np.concatenate(
            [_make_coefficients(effect_class, share) for share in (0.05, *_TESTED_RANGE_SHARES)]
        )
        observations = _simulate_arm(kind, thetas, [effect_class])
        # Only the last element is tested: at the low end of its range, a force may destabilise a
        # joint.
        check(bool(np.isfinite(observations[-1]).all()), "finite observations", "others", location)
        signal = effect_class.signal if issubclass(effect_class, Sensor) else ""
        is_observable = signal in ("", *OBSERVED_CHANNELS)
        changed = (observations != base_observations).any(axis=(0, 1))
        check(
            bool(changed.any()) == is_observable,
            "a change in the channels it affects",
            "none",
            location,
        )
        if signal and is_observable:
            other_channels = [i for i, name in enumerate(OBSERVED_CHANNELS) if name != signal]
            is_unchanged = not changed[other_channels].any()
            check(is_unchanged, "other channels unchanged", "changes", location)
        # A family of effects has one part for each place; any other effect is its only part.
        for part, coefficients in effect_class().parts(
            np.ones((len(effect_class.coefficients), 2, 1))
        ):
            fields_by_part[part.name] = _find_affected_quantities(part, coefficients, kind)
    changing = [fields for fields in fields_by_part.values() if fields]
    check(
        len(set(changing)) == len(changing),
        "each place to be changed by one effect only",
        fields_by_part,
        effect.__name__,
    )
    return None


def check_family_is_the_sum_of_its_members(effect: type[Effect]) -> NotApplicable | None:
    """Check that an effect family equals its members with the same coefficients, bit for bit.

    A family is an effect at all places of one kind, such as friction in all joints; its members are
    the effects at single places.
    """
    kind = make_arm_simulator(effect)
    families = [
        effect_class
        for effect_class in list_effect_places(effect)
        if hasattr(effect_class, "members")
    ]
    for family in families:
        members = [type(member) for member in family.members]
        # A family with one coefficient applies it at every place.
        shared = len(family.coefficients) < sum(len(member.coefficients) for member in members)
        theta = _make_coefficients(family, 0.3)
        member_theta = np.tile(theta, len(members)) if shared else theta
        check(
            is_bitwise_equal(
                _simulate_arm(kind, theta, [family]), _simulate_arm(kind, member_theta, members)
            ),
            "the motion of all members of the family together",
            "another",
            family.name,
        )
    return None if families else NotApplicable("it has no family")


def check_lanes_of_a_robot_are_independent(effect: type[Effect]) -> NotApplicable | None:
    """Check that observations do not depend on other elements of the batch, bit for bit.

    The order of the batch elements must not matter either. The simulator has the effect at all
    places; in each element, it acts at one of them, and in the first one nowhere.
    """
    classes = list_effect_places(effect)
    simulator = make_arm_simulator(effect)(observe=OBSERVED_CHANNELS, effects=classes)
    parameter_rows = [np.zeros((1, len(simulator.parameters)))]
    start = 0
    for effect_class in classes:
        end = start + len(effect_class.coefficients)
        for share in _TESTED_RANGE_SHARES:
            row = parameter_rows[0].copy()
            row[:, start:end] = _make_coefficients(effect_class, share)
            parameter_rows.append(row)
        start = end
    check_batch_independence(
        simulator, np.concatenate(parameter_rows), make_arm_scenario(), effect.__name__
    )
    return None if classes else NO_PLACE


def list_effect_places(effect: type[Effect]) -> tuple[type[Effect], ...]:
    """Return the classes of an effect at all places of the arm where it can act.

    They include families, which act at all places of one kind together. The result is empty if
    MuJoCo is not installed. An effect that is not registered yet is registered.
    """
    from importlib.util import find_spec

    if find_spec("mujoco") is None:
        return ()
    if effect.name not in registry.names():
        registry.register(effect)
    return tuple(make_arm_simulator(effect).system.placed(effect))


def _simulate_arm(
    kind: type[RobotSimulator], parameter_sets: Array, effects: Sequence[type[Effect]] = ()
) -> Array:
    """Simulate observations (n, T, C) of the arm.

    Args:
        kind: simulator class of the arm.
        parameter_sets: (n, P) parameters of the effects.
        effects: effects that the arm has.
    """
    simulator = kind(observe=OBSERVED_CHANNELS, effects=effects)
    return simulator.simulate(parameter_sets, make_arm_scenario())


def _make_coefficients(effect: type[Effect], share: float) -> Array:
    """Return coefficients (1, K) at a fraction of their plausible ranges; all zero for 0.

    Args:
        effect: class of the effect.
        share: position between the bounds of the plausible ranges, from 0 to 1.
    """
    low, high = np.array([coefficient.plausible[0] for coefficient in effect.coefficients]).T
    theta: Array = low + share * (high - low)
    # The lower bound may differ from zero.
    return theta[None] * (share != 0.0)


def _find_affected_quantities(effect: Effect, c: Array, kind: type) -> tuple[object, ...]:
    """Return what an effect at one place changes.

    Args:
        effect: effect of the library: a force, friction, input, sensor or contact law.
        c: (K, 2, 1) values of its K coefficients for two batch elements.
        kind: simulator class of the robot.

    Returns:
        Model fields with indices, coordinates with forces, or the signal; empty if nothing changes.
    """
    from sims.robot.model_field_effects import MODEL_FIELD_EFFECTS

    # `of` is the name of the effect in the library, without its place.
    if effect.of in MODEL_FIELD_EFFECTS and isinstance(effect, ModelValueEffect | Force | Friction):
        return _find_changed_fields(effect, c, kind)
    # Coefficients `between` are those of an element in series between a drive and its load.
    if isinstance(effect, HiddenStateEffect) and effect.between:
        return _find_series_joint_fields(effect, c, kind)
    if isinstance(effect, Force | Friction | HiddenStateEffect):
        return _find_forced_coordinates(effect, c, kind)
    return (effect.signal,) if c.any() else ()


def _find_changed_fields(effect: Effect, c: Array, kind: type) -> tuple[object, ...]:
    """Return the model fields that an effect changes, with the indices of the changed numbers.

    They show where in the robot the effect acts. `c` are its coefficients, `kind` the simulator
    class.

    Raises:
        CheckError: an effect of one place changes several places.
    """
    from sims.robot.dynamics.added_elements import add_elements, list_added_elements
    from sims.robot.model_field_effects import MODEL_FIELD_EFFECTS

    # The effect as changes of fields of MuJoCo's model, for some of which bodies must be added.
    native = MODEL_FIELD_EFFECTS[effect.of]
    robot = add_elements(kind.robot, list_added_elements(effect))  # type: ignore[attr-defined]
    changed = _compare_fields(
        robot.compiled,
        native.fields,
        lambda fields: native.write(fields, robot, effect.place, c[:, :, 0]),
    )
    changes = [(name, index) for name, indices in changed.items() for index in indices]
    # Fields indexed by place must change at one place; fields of the world are indexed by axis.
    if effect.place and len({index for _, index in changes}) > 1:
        raise CheckError(f"expected one place; found {changes}; see {effect.name}")
    return tuple(changes)


def _find_series_joint_fields(
    effect: HiddenStateEffect, c: Array, kind: type
) -> tuple[object, ...]:
    """Return the model fields that an effect changes on the joint in series with its own joint.

    An elastic or loose transmission is simulated by a second joint between drive and link.

    Args:
        effect: effect at a joint.
        c: its coefficients; all zero if it is off.
        kind: simulator class of the robot.
    """
    from sims.robot.dynamics import series_joints

    if not c.any():
        return ()
    robot = series_joints.add_series_joints(kind.robot, ((effect.place, effect.of),))  # type: ignore[attr-defined]
    changed = _compare_fields(
        robot.compiled,
        series_joints.USED_FIELDS,
        lambda fields: series_joints.write_series_effects(fields, robot, ((effect, c),)),
    )
    return tuple((name, effect.place) for name in changed)


def _compare_fields(
    model: mujoco.MjModel, names: Sequence[str], write: Callable[[dict[str, Array]], None]
) -> dict[str, list[int]]:
    """Return the fields of a model that a function changes, with the indices that it changes.

    Args:
        model: model with the initial values.
        names: names of the fields that may change, such as ``dof_damping`` or ``opt.gravity``.
        write: changes fields (2, ...) of two batch elements.
    """
    values_before = {
        name: np.repeat(np.array(attrgetter(name)(model))[None], 2, axis=0) for name in names
    }
    fields = {name: values.copy() for name, values in values_before.items()}
    write(fields)
    # The first axis is that of the batch elements, the second one that of joints, bodies or axes.
    changed = {
        name: np.unique(np.nonzero(fields[name] != values)[1]).tolist()
        for name, values in values_before.items()
    }
    return {name: indices for name, indices in changed.items() if indices}


def _find_forced_coordinates(
    effect: Force | Friction | HiddenStateEffect, c: Array, kind: type
) -> tuple[object, ...]:
    """Return the coordinates on which an effect exerts a force or friction.

    The effect is called at one state in motion. `c` are the values of its K coefficients for two
    batch elements (K, 2, 1), `kind` is the simulator class of the arm.

    Returns:
        Indices of the joints on which a force acts, or the name of the coordinate with friction;
        empty if nothing acts.
    """
    from sims.robot.dynamics.effect_forces import make_snapshot

    system = kind.system()  # type: ignore[attr-defined]
    # All numbers are arbitrary and not zero, SI units: two batch elements of two joints.
    x = np.array([[0.3, -0.4], [0.8, 0.2]])
    moment = make_snapshot(
        system,
        t=np.full((2, 1), 0.4),
        x=x,
        v=1.0 - x,
        inputs={channel.name: np.full((2, 1), 0.3) for channel in system.inputs},
        carried=np.stack([0.5 + x, 0.4 + x]),
        stiffness=np.ones_like(x),
    )
    if isinstance(effect, Friction):
        return (effect.coordinate,) if np.any(effect.limit(c, moment)) else ()
    if isinstance(effect, HiddenStateEffect):
        force, _ = effect.act(c, moment, HiddenState(np.full((2, 1), 0.1), np.full((2, 1), 0.5)))
    else:
        force = effect.force(c, moment)
    _, joints = np.nonzero(force)
    return tuple(int(joint) for joint in np.unique(joints))


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
