"""Contracts of the simulated worlds: parameters, channels, scenarios, simulators.

Nothing in this module knows an engine. A simulator maps *parameters x scenario* to an
*observation*; everything a tuner may change is a `Parameter`, everything the experimenter controls
or knows is in the `Scenario`, everything the sensors give is a `Channel`. All numbers are SI.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sims.limits import LARGEST, MESSAGE, QUOTED, cut

Array = NDArray[np.float64]


class InputError(ValueError):
    """Something the user gave cannot be used; the message is one line: what was expected, found,
    and what to do.
    """

    def __init__(self, message: str) -> None:
        # Names and cells from a user's file may hold anything; what would break the line or a
        # terminal is escaped.
        escaped = [c if c.isprintable() else ascii(c)[1:-1] for c in cut(message, MESSAGE)]
        # Escaped it may be longer again.
        super().__init__(cut("".join(escaped), MESSAGE))


_ALIKE = 0.7
"""Least similarity (0 to 1, `difflib`) of a name that a message proposes in place of another."""


def unknown(kind: str, name: str, known: Sequence[str]) -> InputError:
    """The error for a name that does not exist, with the names that do and those most like it."""
    listed = ", ".join(sorted(known))
    near = similar(str(name), known)
    return InputError(f"unknown {kind} '{cut(str(name))}'; there are: {listed}{near}")


def similar(name: str, known: Iterable[str]) -> str:
    """The end of a message about an unknown name: the names that are most like it, if any are."""
    from difflib import get_close_matches

    # Without case, as users write Pendulum for pendulum, and a family for one of its members.
    names = {one.lower(): one for one in known}
    wanted = name.lower()[:QUOTED]
    begun = [one for one in names if len(wanted) >= 3 and one.startswith(wanted)]
    near = [names[one] for one in (begun or get_close_matches(wanted, names, cutoff=_ALIKE))[:3]]
    return f"; did you mean {' or '.join(near)}?" if near else ""


def frozen(values: ArrayLike) -> Array:
    """A read-only float64 copy of `values`."""
    array = np.array(values, dtype=np.float64)
    array.setflags(write=False)
    return array


@dataclass(frozen=True)
class Parameter:
    """A physical number of a simulator that a tuner may change.

    Attributes:
        name: the parameter's standard name, e.g. ``restitution``.
        unit: SI unit, ``1`` for a pure number.
        nominal: the value one would use knowing nothing of the target.
        bounds: physically possible range; the search box of every tuner.
        training: the part of `bounds` that learned tuners may see while training (default: all of
            it).
        log: whether the unit cube is logarithmic in this parameter.
        says: one sentence a person understands.
    """

    name: str
    unit: str
    nominal: float
    bounds: tuple[float, float]
    training: tuple[float, float] | None = None
    log: bool = False
    says: str = ""

    def __post_init__(self) -> None:
        # In this order: each check may take the ones before it for granted.
        low, high = self.bounds
        if not (np.isfinite([low, high]).all() and low < high):
            raise InputError(
                f"parameter {self.name}: bounds must be finite and increasing, found {self.bounds}"
            )
        if max(-low, high) > LARGEST:
            raise InputError(
                f"parameter {self.name}: bounds must lie within ±{LARGEST:g}, found {self.bounds}"
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
        """The range learned tuners train on, in the parameter's unit."""
        return self.bounds if self.training is None else self.training


@dataclass(frozen=True)
class Channel:
    """One column of an observation.

    Attributes:
        name: e.g. ``z``.
        unit: SI unit.
        scale: a typical magnitude in that unit; weighs channels against each other where no sensor
            noise is known.
        says: one sentence a person understands.
    """

    name: str
    unit: str
    scale: float = 1.0
    says: str = ""


@dataclass(frozen=True)
class Constant:
    """A number of a system that is known, not tuned.

    Attributes:
        name: its standard name.
        unit: SI unit, ``1`` for a pure number.
        value: the default.
        says: one sentence a person understands.
        positive: whether it must be > 0.
        limits: the lowest and the highest value that can be meant, in its unit.
    """

    name: str
    unit: str
    value: float
    says: str = ""
    positive: bool = False
    limits: tuple[float, float] = (-LARGEST, LARGEST)

    def wanted(self, value: float) -> str:
        """What is expected in place of `value`; empty where it can be."""
        if self.positive and value <= 0:
            return f"more than 0 {self.unit}"
        low, high = self.limits
        return "" if low <= value <= high else f"{low:g} to {high:g} {self.unit}"


@dataclass(frozen=True)
class Scenario:
    """What the experimenter controls or knows of one run.

    Attributes:
        times: sample times (T,) in seconds, increasing; the state at ``times[0]`` is the initial
            state.
        initial: initial state by name, SI units; what is left out takes the system's default.
        inputs: input signals by name, each (T,), held constant from one sample to the next.
        constants: constants that differ from the simulator's own in this run.
        linear: inputs that go straight from one sample to the next instead.
        offset: seconds by which inputs act later than their stamps say.
        before: inputs before the run, by name where they are known: instants in seconds from
            ``times[0]``, negative and increasing, and values, (2, K). Else they had their first
            value.
        off: whether actuators of a robot are switched off, (T,) by name, held from one sample to
            the next; what is left out is on.
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
        # Copies that nobody can write to: scenarios are shared by lanes and by methods.
        times = frozen(self.times)
        row = times.ndim == 1 and times.size > 0
        if not row or not np.isfinite(times).all() or (np.diff(times) <= 0).any():
            raise InputError(
                "a scenario's times must be finite and increasing, at least one sample"
            )
        inputs = {name: frozen(signal) for name, signal in self.inputs.items()}
        for name, signal in inputs.items():
            if signal.shape != times.shape:
                raise InputError(
                    f"input '{name}' has shape {signal.shape}, the scenario has {times.size}"
                    " samples"
                )
        before = {name: frozen(signal) for name, signal in self.before.items() if signal.size}
        for name, (stamps, _) in before.items():
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
        # The class is frozen; this is how it sets its own fields.
        object.__setattr__(self, "before", before)
        object.__setattr__(self, "times", times)
        object.__setattr__(self, "inputs", inputs)
        object.__setattr__(self, "initial", {k: float(v) for k, v in self.initial.items()})
        object.__setattr__(self, "constants", {k: float(v) for k, v in self.constants.items()})


class UnitCube:
    """The map between physical parameters and the unit cube in which every tuner works.

    0..1 spans each parameter's `bounds`, linearly, or logarithmically for log-scaled parameters.
    With bounds a and b, a parameter p and its place u in the cube,

        p = a + u (b - a),    or    p = exp(log a + u (log b - log a))     (1)

    This is the only place where that map is made.
    """

    def __init__(self, parameters: Sequence[Parameter]) -> None:
        self.parameters = tuple(parameters)
        self._log = np.array([p.log for p in self.parameters])
        self._any_log = bool(self._log.any())
        pairs = [p.bounds for p in self.parameters]
        bounds = np.array(pairs, dtype=np.float64).reshape(-1, 2)  # also where there are none
        self._low, self._high = self._scaled(bounds.T)
        self._span = self._high - self._low
        self.training: Array = frozen(
            self.inverse(np.array([p.training_range for p in self.parameters]).T)
        )

    @property
    def dim(self) -> int:
        """Number of parameters."""
        return len(self.parameters)

    def _scaled(self, theta: Array) -> Array:
        if not self._any_log:
            return theta
        # The logarithm of 1 where none is asked for: that of a negative number warns.
        positive = np.where(self._log, theta, 1.0)
        scaled: Array = np.where(self._log, np.log(positive), theta)
        return scaled

    def physical(self, points: Array) -> Array:
        """Unit-cube points (..., dim) as physical parameter vectors."""
        scaled: Array = self._low + points * self._span  # (1)
        if not self._any_log:
            return scaled
        logarithm = np.where(self._log, scaled, 0.0)
        mixed: Array = np.where(self._log, np.exp(logarithm), scaled)  # (1)
        return mixed

    def inverse(self, theta: Array) -> Array:
        """Physical parameter vectors (..., dim) as unit-cube points."""
        result: Array = (self._scaled(np.asarray(theta, dtype=np.float64)) - self._low) / self._span
        return result

    def training_widths(self) -> Array:
        """Widths (dim,) of the training ranges, in the parameters' units; `param_error` counts in
        them.
        """
        ranges = np.array([p.training_range for p in self.parameters], dtype=np.float64)
        return ranges[:, 1] - ranges[:, 0]


class Simulator(ABC):
    """Parameters x scenario -> observation, many parameter vectors at once.

    A subclass declares what it is in class attributes and implements `simulate`. The same
    parameters and scenario must give the same observation bit for bit, whatever was simulated
    before.

    Attributes:
        parameters: what may be tuned, in the order of a parameter vector's entries.
        channels: columns of an observation, in order.
        constants: known numbers, with their defaults.
        inputs: input signals a scenario may give, as channels.
        states: initial state names with their defaults (SI).
        requires: importable packages without which this simulator is skipped.
        has_model: whether it comes from a robot's model file.
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
        """Set the constants and choose what is observed.

        Args:
            constants: values for `constants` other than their defaults.
            observe: names of the channels to return, in this order (default: all the system has);
                `channels` then holds these, and `columns` where they stand among the system's.

        Raises:
            InputError: for a constant or channel the simulator does not have, or an impossible
                value.
        """
        defaults = {c.name: c.value for c in self.constants}
        self.constant_values = self._constants(defaults, constants or {})
        names = [c.name for c in self.channels]
        chosen = names if observe is None else list(observe)
        for name in chosen:
            if name not in names:
                raise unknown(f"channel of simulator {self.name}", name, names)
        if not chosen or len(set(chosen)) < len(chosen):
            raise InputError(
                f"simulator {self.name}: observe needs one or more different channels, found"
                f" {cut(str(chosen))}"
            )
        self.columns = [names.index(name) for name in chosen]
        self.channels = tuple(self.channels[i] for i in self.columns)

    @abstractmethod
    def simulate(self, theta: Array, scenario: Scenario) -> Array:
        """Simulate each row of `theta` (n, dim), physical units; returns observations (n, T, C), SI
        units.

        A lane whose simulation fails numerically is filled with NaN; it never spoils its
        neighbours.

        Raises:
            InputError: the scenario names a constant, input or initial state that the simulator
                does not have.
        """

    def close(self) -> None:
        """Give back what the simulator holds (engine worlds); it may be used again."""

    def run_constants(self, scenario: Scenario) -> dict[str, float]:
        """The constants of one run: the simulator's, overridden by the scenario's."""
        return self._constants(self.constant_values, scenario.constants)

    def run_initial(self, scenario: Scenario) -> dict[str, float]:
        """The initial state of one run: the system's defaults, overridden by the scenario's."""
        return self._checked("initial state", self.states, scenario.initial)

    def run_inputs(self, scenario: Scenario) -> dict[str, Array]:
        """The input signals of one run, each (T,); what the scenario leaves out is zero."""
        known = {c.name: np.zeros(scenario.times.size) for c in self.inputs}
        return self._checked("input", known, scenario.inputs)

    def _constants(
        self, known: Mapping[str, float], given: Mapping[str, float]
    ) -> dict[str, float]:
        values = self._checked("constant", known, given)
        for c in self.constants:
            value = values[c.name]
            if c.positive and value <= 0:
                wanted = "be > 0"
            elif not c.limits[0] <= value <= c.limits[1]:
                wanted = f"lie in {c.wanted(value)}"
            else:
                continue
            who = f"constant '{c.name}' of simulator {self.name}"
            raise InputError(f"{who} must {wanted}, found {value}")
        return values

    def _checked(
        self, kind: str, known: Mapping[str, Any], given: Mapping[str, Any]
    ) -> dict[str, Any]:
        for name, value in given.items():
            if name not in known:
                raise unknown(f"{kind} of simulator {self.name}", name, list(known) or ["none"])
            if not np.isfinite(value).all():
                who = f"{kind} '{name}' of simulator {self.name}"
                raise InputError(f"{who} must be finite, found {cut(str(value))}")
        return {**known, **given}


def adjusted(
    parameters: Sequence[Parameter], changes: Mapping[str, Mapping[str, Any]]
) -> tuple[Parameter, ...]:
    """`parameters` with some attributes replaced by an experiment's: ``{"restitution": {"training":
    (0.3, 0.7)}}``.

    Raises:
        InputError: unknown parameter or attribute name.
    """
    names = [p.name for p in parameters]
    allowed = ("nominal", "bounds", "training", "log")
    for name, change in changes.items():
        if name not in names:
            raise unknown("parameter", name, names)
        for attribute in change:
            if attribute not in allowed:
                raise unknown(f"attribute of parameter {name}", attribute, allowed)
    pairs = ("bounds", "training")  # lists in an experiment's file
    result = []
    for p in parameters:
        change = changes.get(p.name, {})
        new: dict[str, Any] = {k: tuple(v) if k in pairs else v for k, v in change.items()}
        changed = replace(p, **new)  # which checks the parameter anew
        # What is positive by its nature, as a mass, is so whatever an experiment makes of it.
        low, lowest = p.bounds[0], changed.bounds[0]
        if low >= 0 and (lowest < 0 or (low > 0 and lowest == 0)):
            wanted = "more than 0" if low > 0 else "at least 0"
            raise InputError(f"parameter {p.name}: bounds must be {wanted}, found {changed.bounds}")
        result.append(changed)
    return tuple(result)
