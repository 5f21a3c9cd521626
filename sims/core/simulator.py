"""Interfaces of simulators: parameters, channels, scenarios, simulators.

This module does not depend on any engine. A simulator maps *parameters x scenario* to an
*observation*. A `Parameter` may be changed by a tuner, a `Scenario` contains what the experimenter
controls or knows, and a `Channel` is a sensor signal. All numbers are in SI units.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sims.core.number_limits import MAX_NUMBER
from sims.core.user_messages import MAX_MESSAGE_LENGTH, MAX_QUOTED_NAME_LENGTH, truncate_text

Array = NDArray[np.float64]
Indices = NDArray[np.intp]


class InputError(ValueError):
    """Error in the user's input, with a one-line message.

    The message states what was expected, what was found, and what to do.
    """

    def __init__(self, message: str) -> None:
        """Make the message safe for one line of a terminal: shorten and escape it.

        Args:
            message: One line that says what is wrong, what was expected and what to do.
        """
        # Names and cells from a user's file may contain anything; escape characters that would
        # break the line or a terminal.
        escaped = [
            c if c.isprintable() else ascii(c)[1:-1]
            for c in truncate_text(message, MAX_MESSAGE_LENGTH)
        ]
        # Escaping may make it longer again.
        super().__init__(truncate_text("".join(escaped), MAX_MESSAGE_LENGTH))


_MIN_NAME_SIMILARITY = 0.7
"""Minimum similarity (0 to 1, `difflib`) of a name that a message proposes instead of another."""


MAX_LISTED_NAMES = 10
"""Maximum number of known names that a message lists although some are similar to the unknown."""


def make_unknown_name_error(kind: str, name: str, known_names: Sequence[str]) -> InputError:
    """Make the error for an unknown name, which proposes similar names.

    It also lists all known names, unless they are many and some are similar.

    Args:
        kind: Kind of the name in the message.
        name: Unknown name.
        known_names: Known names.
    """
    suggestion = similar(str(name), known_names)
    name_list = (
        ""
        if suggestion and len(known_names) > MAX_LISTED_NAMES
        else f"; there are: {', '.join(sorted(known_names))}"
    )
    return InputError(f"unknown {kind} '{truncate_text(str(name))}'{name_list}{suggestion}")


def similar(name: str, known_names: Iterable[str]) -> str:
    """Format the names most similar to an unknown name as the end of a message.

    Args:
        name: Unknown name.
        known_names: Known names.

    Returns:
        A question with the similar names; empty if there are none.
    """
    from difflib import get_close_matches

    # Ignore case and accept prefixes: users write Pendulum for pendulum, or a family for a member.
    names = {known_name.lower(): known_name for known_name in known_names}
    lower_name = name.lower()[:MAX_QUOTED_NAME_LENGTH]
    # Fewer than three letters begin too many names.
    matches = [key for key in names if len(lower_name) >= 3 and key.startswith(lower_name)]
    matches = matches or get_close_matches(lower_name, names, cutoff=_MIN_NAME_SIMILARITY)
    similar_names = [names[key] for key in matches[:3]]
    return f"; did you mean {' or '.join(similar_names)}?" if similar_names else ""


def make_read_only(values: ArrayLike) -> Array:
    """Return a read-only float64 copy of `values`."""
    array = np.array(values, dtype=np.float64)
    array.setflags(write=False)
    return array


@dataclass(frozen=True)
class Parameter:
    """Physical parameter of a simulator that a tuner may change.

    Attributes:
        name: Standard name, e.g. ``restitution``.
        unit: SI unit, ``1`` for a pure number.
        nominal: Value to use without any knowledge of the target.
        bounds: Physically possible range, which is the search range of every tuner.
        training: Part of `bounds` that learned tuners may use in training (default: all of it).
        log: Whether the unit cube is logarithmic in this parameter.
        says: Description in one sentence.
    """

    name: str
    unit: str
    nominal: float
    bounds: tuple[float, float]
    training: tuple[float, float] | None = None
    log: bool = False
    says: str = ""

    def __post_init__(self) -> None:
        """Check that bounds, nominal value and training range are consistent.

        Raises:
            InputError: one of them is not; the message names the parameter.
        """
        # The order matters: each check relies on the previous ones.
        low, high = self.bounds
        if not (np.isfinite([low, high]).all() and low < high):
            raise InputError(
                f"parameter {self.name}: bounds must be finite and increasing, found {self.bounds}"
            )
        if max(-low, high) > MAX_NUMBER:
            raise InputError(
                f"parameter {self.name}: bounds must lie within ±{MAX_NUMBER:g}, "
                f"found {self.bounds}"
            )
        if self.log and low <= 0:
            raise InputError(
                f"parameter {self.name}: a log-scaled parameter needs positive bounds, found"
                f" {self.bounds}"
            )
        if not low <= self.nominal <= high:
            raise InputError(
                f"parameter {self.name}: nominal {self.nominal} lies outside its bounds"
                f" {self.bounds}"
            )
        inner_low, inner_high = self.training_range
        if not low <= inner_low < inner_high <= high:
            raise InputError(
                f"parameter {self.name}: training range {self.training_range} must increase inside"
                f" {self.bounds}"
            )

    @property
    def training_range(self) -> tuple[float, float]:
        """Range on which learned tuners are trained, in the parameter's unit."""
        return self.bounds if self.training is None else self.training


@dataclass(frozen=True)
class Channel:
    """One column of an observation.

    Attributes:
        name: Name, e.g. ``z``.
        unit: SI unit.
        scale: Typical magnitude in that unit, which weights channels if no sensor noise is known.
        says: Description in one sentence.
    """

    name: str
    unit: str
    scale: float = 1.0
    says: str = ""


@dataclass(frozen=True)
class Constant:
    """Known number of a system, which is not tuned.

    Attributes:
        name: Standard name.
        unit: SI unit, ``1`` for a pure number.
        value: Default value.
        says: Description in one sentence.
        positive: Whether it must be > 0.
        limits: Minimum and maximum plausible value, in its unit.
    """

    name: str
    unit: str
    value: float
    says: str = ""
    positive: bool = False
    limits: tuple[float, float] = (-MAX_NUMBER, MAX_NUMBER)

    def wanted(self, value: float) -> str:
        """Return the expected range if `value` is not possible; empty if it is possible."""
        if self.positive and value <= 0:
            return f"more than 0 {self.unit}"
        low, high = self.limits
        return "" if low <= value <= high else f"{low:g} to {high:g} {self.unit}"


@dataclass(frozen=True)
class Scenario:
    """Conditions of one run that the experimenter controls or knows.

    Attributes:
        times: (T,) sample times, increasing, s; the state at ``times[0]`` is the initial state.
        initial: Initial state by name, SI units; the system's defaults are used for missing ones.
        inputs: Input signals by name, each (T,), held constant between samples.
        constants: Constants that differ from the simulator's own in this run.
        linear: Inputs that are interpolated linearly between samples instead.
        offset: Delay of the inputs relative to their stamps, s.
        before: Known inputs before the run by name, (2, K): times relative to ``times[0]`` (s,
            negative and increasing), and values. Other inputs had their first value.
        off: Whether actuators of a robot are switched off, (T,) by name, held between samples;
            missing actuators are on.
    """

    times: Array
    initial: Mapping[str, float] = field(default_factory=dict)
    inputs: Mapping[str, Array] = field(default_factory=dict)
    constants: Mapping[str, float] = field(default_factory=dict)
    linear: frozenset[str] = frozenset()
    offset: float = 0.0
    before: Mapping[str, Array] = field(default_factory=dict)
    off: Mapping[str, NDArray[np.bool_]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Check times, inputs, histories of inputs and switches, and store read-only copies.

        Raises:
            InputError: times do not increase, or a signal does not have one value for each of them.
        """
        # Read-only copies, because batch elements and methods share scenarios.
        times = make_read_only(self.times)
        is_series = times.ndim == 1 and times.size > 0
        if not is_series or not np.isfinite(times).all() or (np.diff(times) <= 0).any():
            raise InputError(
                "a scenario's times must be finite and increasing, at least one sample"
            )
        inputs = {name: make_read_only(signal) for name, signal in self.inputs.items()}
        for name, signal in inputs.items():
            if signal.shape != times.shape:
                raise InputError(
                    f"input '{name}' has shape {signal.shape}, the scenario has {times.size}"
                    " samples"
                )
        histories = {
            name: make_read_only(signal) for name, signal in self.before.items() if signal.size
        }
        # A history (2, K) has times relative to the start of the run, and values.
        for name, (stamps, _) in histories.items():
            if not (np.diff(stamps, append=0.0) > 0).all():
                raise InputError(
                    f"input '{name}' before the run: its instants must be negative and increasing"
                )
        for name, mask in self.off.items():
            if mask.shape != times.shape:
                raise InputError(
                    f"actuator '{name}' is off in {mask.shape} samples, the scenario has "
                    f"{times.size}"
                )
        # Fields of a frozen dataclass can only be set in this way.
        object.__setattr__(self, "before", histories)
        object.__setattr__(self, "times", times)
        object.__setattr__(self, "inputs", inputs)
        object.__setattr__(self, "initial", {k: float(v) for k, v in self.initial.items()})
        object.__setattr__(self, "constants", {k: float(v) for k, v in self.constants.items()})


class Simulator(ABC):
    """Map from parameters and scenario to observations, for many parameter vectors at once.

    A subclass declares its interface in class attributes and implements `simulate`. The same
    parameters and scenario must give the same observation bit for bit, regardless of earlier
    simulations.

    Attributes:
        parameters: Tunable parameters, in the order of the entries of a parameter vector.
        channels: Columns of an observation, in order.
        constants: Known numbers, with their defaults.
        inputs: Input signals that a scenario may contain, as channels.
        states: Names of the initial states with their defaults (SI).
        requires: Importable packages without which this simulator is skipped.
        has_model: Whether it is made from a robot's model file.
    """

    name: ClassVar[str]
    says: ClassVar[str] = ""
    parameters: tuple[Parameter, ...] = ()
    channels: tuple[Channel, ...] = ()
    constants: tuple[Constant, ...] = ()
    inputs: tuple[Channel, ...] = ()
    states: Mapping[str, float] = {}
    requires: ClassVar[tuple[str, ...]] = ()
    has_model: ClassVar[bool] = False

    def __init__(
        self, constants: Mapping[str, float] | None = None, observe: Sequence[str] | None = None
    ) -> None:
        """Set the constants and select the observed channels.

        Args:
            constants: Values of `constants` that differ from their defaults.
            observe: Names of the channels to return, in this order (default: all of the system).
                `channels` then contains these, and `columns` their positions among the system's
                channels.

        Raises:
            InputError: A constant or channel does not exist, or a value is impossible.
        """
        defaults = {c.name: c.value for c in self.constants}
        self.constant_values = self._check_constants(defaults, constants or {})
        names = [c.name for c in self.channels]
        chosen_names = names if observe is None else list(observe)
        for name in chosen_names:
            if name not in names:
                raise make_unknown_name_error(f"channel of simulator {self.name}", name, names)
        if not chosen_names or len(set(chosen_names)) < len(chosen_names):
            raise InputError(
                f"simulator {self.name}: observe needs one or more different channels, found"
                f" {truncate_text(str(chosen_names))}"
            )
        self.columns = [names.index(name) for name in chosen_names]
        self.channels = tuple(self.channels[i] for i in self.columns)

    @abstractmethod
    def simulate(self, theta: Array, scenario: Scenario) -> Array:
        """Simulate each parameter vector in one scenario.

        If a simulation fails numerically, its observation is NaN, and the others are not affected.

        Shapes: n parameter vectors, T samples, C channels.

        Args:
            theta: Parameter vectors (n, dim), physical units.
            scenario: Conditions of the run.

        Returns:
            Observations (n, T, C), SI units.

        Raises:
            InputError: The scenario names a constant, input or initial state that the simulator
                does not have.
        """

    def close(self) -> None:
        """Release resources such as engine worlds; the simulator may be used again."""

    def run_constants(self, scenario: Scenario) -> dict[str, float]:
        """Return the constants of one run: the simulator's, overridden by the scenario's."""
        return self._check_constants(self.constant_values, scenario.constants)

    def run_initial(self, scenario: Scenario) -> dict[str, float]:
        """Return the initial state of one run: the defaults, overridden by the scenario's."""
        return self._check_values("initial state", self.states, scenario.initial)

    def run_inputs(self, scenario: Scenario) -> dict[str, Array]:
        """Return the input signals of one run, each (T,); missing inputs are zero."""
        default_signals = {c.name: np.zeros(scenario.times.size) for c in self.inputs}
        return self._check_values("input", default_signals, scenario.inputs)

    def _check_constants(
        self, defaults: Mapping[str, float], given_values: Mapping[str, float]
    ) -> dict[str, float]:
        """Return the constants with their given values, after checking their limits.

        Args:
            defaults: default values of all constants.
            given_values: values that differ, from the user or a scenario.

        Raises:
            InputError: a constant is unknown, not finite, or outside its limits.
        """
        values = self._check_values("constant", defaults, given_values)
        # `wanted` states in words what a constant must be.
        for constant in self.constants:
            value = values[constant.name]
            if constant.positive and value <= 0:
                condition = "be > 0"
            elif not constant.limits[0] <= value <= constant.limits[1]:
                condition = f"lie in {constant.wanted(value)}"
            else:
                continue
            subject = f"constant '{constant.name}' of simulator {self.name}"
            raise InputError(f"{subject} must {condition}, found {value}")
        return values

    def _check_values(
        self, kind: str, defaults: Mapping[str, Any], given_values: Mapping[str, Any]
    ) -> dict[str, Any]:
        """Return known values, replaced by the given ones.

        Args:
            kind: word for these values in messages: constant, initial state or input.
            defaults: default values by name.
            given_values: values that replace them.

        Raises:
            InputError: a name is unknown, or a value is not finite.
        """
        for name, value in given_values.items():
            if name not in defaults:
                raise make_unknown_name_error(
                    f"{kind} of simulator {self.name}", name, list(defaults) or ["none"]
                )
            if not np.isfinite(value).all():
                subject = f"{kind} '{name}' of simulator {self.name}"
                raise InputError(f"{subject} must be finite, found {truncate_text(str(value))}")
        return {**defaults, **given_values}
