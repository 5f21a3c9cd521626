"""Extended simulators: write and load `extended.toml`.

The file is written by explain and names the system, the effects and every number with its interval;
for a robot it names the model file instead of a system. When it is loaded, it is a registered
simulator whose nominal values are the fitted ones, so that `compare`, `simulate` and every tuner
accept it.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from sims import effects as library
from sims.core import files
from sims.core.effect import make_effect_parameters
from sims.core.json_documents import OPTIONAL
from sims.core.simulator import InputError, Parameter, Simulator
from sims.core.toml_validation import (
    check_finite,
    check_known_names,
    check_name_list,
    check_table,
    check_text,
    make_error,
    read_toml,
)
from sims.robot import robot_reference
from sims.robot.robot_reference import RobotReference
from sims.system_simulator import SystemSimulator

FORMAT_VERSION = 1
"""Version of the file format; files with another version are refused."""

MIN_TRAINING_RANGE_SHARE = 0.2
"""Minimum half width of the training range of a fitted number, as a fraction of the number."""

TRAINING_RANGE_HALF_WIDTHS = 3.0
"""Minimum half width of the training range, in half widths of the number's interval."""

MAX_SYSTEM_NAME_LENGTH = 40
"""Maximum number of characters of the system's name in the name of its extension."""

_MIN_HALF_WIDTH = 1e-12
"""Minimum half width of the training range in the number's unit; otherwise it is empty about 0."""

_ALLOWED_KEYS = (
    "format",
    "name",
    "system",
    "engine",
    "title",
    "observe",
    "constants",
    "parameters",
    "effects",
    *robot_reference.ROBOT_KEYS,
)
"""Keys allowed in the file."""

_NUMBER = "a finite number"

EXTENDED_MODEL_FILE = "extended.toml"
"""File of the extended simulator in the folder of an explanation."""


@dataclass(frozen=True)
class FittedValue:
    """Fitted number with its 95 % interval, which is None where the data do not bound it.

    Attributes:
        value: Estimate.
        unit: Unit of the estimate and its interval.
        low: Lower end of the 95 % interval.
        high: Upper end of the 95 % interval.
        at_bound: End of the range at which the estimate is; None inside the range. At a bound there
            is no interval.
        stated: Number of the robot's model file that the estimate changes; None if the file has no
            such number.
        total: Value of that number with the estimate applied.
        total_unit: Unit of `stated` and `total`; empty if it is `unit`.
        usual_range: Expected range of the estimate; None if the estimate is inside it.
    """

    value: float
    unit: str
    low: float | None
    high: float | None
    at_bound: Literal["low", "high"] | None = field(default=None, metadata=OPTIONAL)
    stated: float | None = field(default=None, metadata=OPTIONAL)
    total: float | None = field(default=None, metadata=OPTIONAL)
    total_unit: str = field(default="", metadata=OPTIONAL)
    usual_range: tuple[float, float] | None = field(default=None, metadata=OPTIONAL)

    @property
    def is_result(self) -> bool:
        """True if the data determine the number.

        This is the case if it has an interval, or if it is zero at its lower bound, such as the
        coefficient of a friction that does not exist.
        """
        if self.at_bound is not None:
            return self.at_bound == "low" and self.value == 0.0
        return self.low is not None and self.high is not None

    def to_table(self) -> dict[str, Any]:
        """Return the number as a TOML table, which has no null."""
        table: dict[str, Any] = {"value": self.value, "unit": self.unit}
        if self.low is not None and self.high is not None:
            table |= {"low": self.low, "high": self.high}
        return table


@dataclass(frozen=True)
class ExtendedSimulator:
    """Extended simulator.

    Attributes:
        name: Name under which it is registered.
        system: Registered name of the system, or name of the robot.
        engine: Engine with which it was fitted; None for a user-defined simulator, which steps
            itself.
        title: Title of the recording to which it was fitted.
        parameters: Fitted parameters of the system itself.
        effects: Coefficients by effect, in the order in which a signal passes the effects.
        constants: Constants stated by the recording, and fitted ones.
        observe: Channels of the recording.
        kind: Simulator class of the system without effects, if it is known, as after
            `open_extended` and explain.
        robot: What the file states about a robot: its model file and additions to it; None for
            other systems. (`kind.robot` is the robot itself, as read from that file.)
    """

    name: str
    system: str
    engine: str | None
    title: str
    parameters: Mapping[str, FittedValue]
    effects: Mapping[str, Mapping[str, FittedValue]]
    constants: Mapping[str, float]
    observe: Sequence[str]
    # Not compared: it is not part of the fit, and the file contains only the system's name.
    kind: type[SystemSimulator] | None = field(default=None, compare=False, repr=False)
    robot: RobotReference | None = None

    def simulator(self) -> SystemSimulator:
        """Return the fitted simulator, ready to use.

        The nominal values of its parameters are the fitted ones.

        Raises:
            InputError: The simulator class of the system is unknown.
        """
        if self.kind is None:
            remedy = (
                "open its file with sims.extended_simulator.open_extended, "
                "or use make_simulator_class"
            )
            raise InputError(f"{self.name}: the class of system {self.system} is unknown; {remedy}")
        return make_simulator_class(self, self.kind)()


def make_extended_name(system: str) -> str:
    """Return the name of the extension of a system; special characters are replaced."""
    cleaned_name = re.sub(r"[^A-Za-z0-9_.-]", "_", system)[:MAX_SYSTEM_NAME_LENGTH]
    return f"{cleaned_name if cleaned_name[:1].isalpha() else f'robot_{cleaned_name}'}_extended"


def get_robot_reference(kind: type[SystemSimulator]) -> RobotReference | None:
    """Return the robot data that a file contains for a simulator; None if it is not a robot."""
    robot: Any = kind
    return robot_reference.make_robot_reference(robot) if kind.has_model else None


def write_extended(extended: ExtendedSimulator, path: Path) -> None:
    """Write an extended simulator to a file.

    Args:
        extended: Extended simulator.
        path: Path of the file.
    """
    files.write_atomically(path, format_extended(extended, path.parent))


def format_extended(extended: ExtendedSimulator, folder: Path | None = None) -> str:
    """Format an extended simulator as the text of its file, in TOML.

    Args:
        extended: Extended simulator.
        folder: Folder of the file, to which the path of a robot's model file is relative.
    """
    import tomli_w

    # The base simulator: a registered system, or a robot's model file.
    if extended.robot is None:
        base_entries = {"system": extended.system, **_get_engine_setting(extended)}
    else:
        base_entries = extended.robot.to_document(folder)
    document = {
        "format": FORMAT_VERSION,
        "name": extended.name,
        **base_entries,
        "title": extended.title,
        "observe": list(extended.observe),
        "constants": dict(extended.constants),
        "parameters": {name: number.to_table() for name, number in extended.parameters.items()},
        "effects": {
            name: {coefficient: number.to_table() for coefficient, number in numbers.items()}
            for name, numbers in extended.effects.items()
        },
    }
    return tomli_w.dumps(document)


def read_extended(path: Path) -> ExtendedSimulator:
    """Read and check the file of an extended simulator, a base simulator with fitted effects.

    The base is a registered system, or a robot with its model file.

    Raises:
        InputError: The file is missing, malformed, or has another format.
    """
    document = read_toml(path)
    if document.get("format") != FORMAT_VERSION:
        expected = f"an extended simulator with format = {FORMAT_VERSION}"
        raise make_error(path, "", expected, document.get("format"))
    check_known_names(f"key of {path}", document, _ALLOWED_KEYS)
    name = _check_text(path, "name", document.get("name"))
    if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_.-]*", name):  # it is also used for files
        raise make_error(path, "name", "letters, digits, '_', '.' and '-'", name)
    robot = robot_reference.read_robot_reference(path, document) if "model" in document else None
    # A robot has the name of its model file, and states its engine in its own entries.
    system, engine = (robot.path.stem, None) if robot else _read_system(path, document)
    expected = "a list of channel names"
    observe = check_name_list(path, "observe", document.get("observe", []), expected)
    if not observe:
        raise make_error(path, "observe", expected, document.get("observe", []))
    constants = check_table(path, "constants", document.get("constants", {}))
    effects = check_table(path, "effects", document.get("effects", {}))
    return ExtendedSimulator(
        name=name,
        system=system,
        engine=engine,
        title=str(document.get("title", "")),
        parameters=_read_fitted_values(path, "parameters", document.get("parameters", {})),
        # The order matters: a signal passes the effects one after another.
        effects={
            effect: _read_fitted_values(path, f"effects.{effect}", numbers)
            for effect, numbers in effects.items()
        },
        constants={
            constant: check_finite(path, f"constants.{constant}", value, _NUMBER)
            for constant, value in constants.items()
        },
        observe=list(observe),
        robot=robot,
    )


def _read_system(path: Path, document: Mapping[str, Any]) -> tuple[str, str | None]:
    """Return the name of the registered system, and of the engine if the file states one.

    Args:
        path: path of the file.
        document: its content.

    Raises:
        InputError: A name is missing or not a text, or an entry is allowed for robots only.
    """
    for key in document:
        if key in robot_reference.ROBOT_KEYS and key != "engine":
            raise InputError(f"{path}: {key} is for a robot; expected model too, found none")
    engine = _check_text(path, "engine", document["engine"]) if "engine" in document else None
    return _check_text(path, "system", document.get("system")), engine


def _read_fitted_values(path: Path, key: str, value: Any) -> dict[str, FittedValue]:
    """Read a table of fitted numbers with their units, by name.

    Args:
        path: path of the file.
        key: key of the table in the file.
        value: the table.
    """
    table = check_table(path, key, value)
    return {
        name: _read_fitted_value(path, f"{key}.{name}", number) for name, number in table.items()
    }


def _read_fitted_value(path: Path, key: str, value: Any) -> FittedValue:
    """Read a fitted number with its unit, and its interval where the file states one.

    Args:
        path: path of the file.
        key: key of the entry in the file.
        value: the entry, a table with value and unit.
    """
    table = check_table(path, key, value, "a table with value and unit")
    fitted = check_finite(path, f"{key}.value", table.get("value"), _NUMBER)
    low, high = (
        check_finite(path, f"{key}.{end}", table[end], _NUMBER) if end in table else None
        for end in ("low", "high")
    )
    return FittedValue(fitted, _check_text(path, "unit", table.get("unit")), low, high)


def _check_text(path: Path, key: str, value: Any) -> str:
    """Check that an entry is a text that is not empty.

    Args:
        path: path of the file.
        key: key of the entry in the file.
        value: value of the entry.

    Raises:
        InputError: it is no text, or an empty one.
    """
    result = check_text(path, key, value, "a text")
    if not result:
        raise make_error(path, key, "a text", value)
    return result


def make_simulator_class(
    extended: ExtendedSimulator, kind: type[SystemSimulator]
) -> type[SystemSimulator]:
    """Make the extended simulator as a class that can be registered.

    An instance made without arguments is the fitted simulator: its parameters are those of the
    system and the coefficients of the effects, with the fitted values as nominal ones.

    Args:
        extended: Content of the file.
        kind: Simulator class of the system without effects.

    Raises:
        InputError: A parameter, effect, coefficient, constant or channel does not exist.
    """
    check_known_names(f"parameter of system {extended.system}", extended.parameters, _names(kind))
    fitted = extended.parameters
    base_parameters = [
        _set_nominal(p, fitted[p.name]) if p.name in fitted else p for p in kind.parameters
    ]
    coefficients = _list_coefficients(extended, kind)
    # Make one instance, so that wrong settings are refused here; its parameters include those of
    # the effects, with their bounds.
    effects, observed = list(extended.effects), list(extended.observe)
    settings = _get_engine_setting(extended)
    extended_simulator = kind(extended.constants, observed, effects=effects, **settings)
    # The parameters of the effects follow those of the system.
    effect_parameters = extended_simulator.parameters[len(base_parameters) :]
    added_parameters = [
        _set_nominal(p, number) for p, number in zip(effect_parameters, coefficients, strict=True)
    ]
    extended_simulator.close()
    return _make_subclass(extended, kind, (*base_parameters, *added_parameters))


def _get_engine_setting(extended: ExtendedSimulator) -> dict[str, Any]:
    """Return the setting that selects the engine; user-defined simulators have none."""
    return {"engine": extended.engine} if extended.engine else {}


def _make_subclass(
    extended: ExtendedSimulator, kind: type[SystemSimulator], parameters: tuple[Parameter, ...]
) -> type[SystemSimulator]:
    """Make a subclass of `kind` whose instances are the fitted simulator.

    Constants, observed channels and settings may be given when an instance is made; the effects
    are fixed.

    Args:
        extended: extended simulator of a diagnosis: fitted parameters, constants and effects.
        kind: simulator class of its system.
        parameters: parameters with the fitted values as nominal ones.
    """
    effects, observed = list(extended.effects), list(extended.observe)

    def __init__(  # noqa: N807
        self: SystemSimulator,
        constants: Mapping[str, float] | None = None,
        observe: Sequence[str] | None = None,
        **settings: Any,
    ) -> None:
        """Create the simulator with the fitted constants and effects of the file.

        Args:
            constants: Constants that differ from those of the file.
            observe: Names of the observed channels; those of the fitted recording if None.
            settings: Settings of the engine, which take precedence over those of the file.
            self: Instance of the subclass.
        """
        # Engine, sensors and constants may be changed; the effects are fixed.
        stated_constants = {**extended.constants, **(constants or {})}
        engine_settings = {**_get_engine_setting(extended), **settings}
        kind.__init__(
            self, stated_constants, observe or observed, effects=effects, **engine_settings
        )
        # A user-defined simulator refuses to set this attribute twice, so bypass the check.
        object.__setattr__(self, "parameters", parameters)

    body = {
        "__init__": __init__,
        "system": kind.system,
        # By this attribute, other code recognises an extended simulator.
        "extends": extended.system,
        # These classes have the same source code and may have the same name. The digest of their
        # numbers distinguishes them; otherwise a tuner trained in one would count as trained in
        # another.
        "source_digest": hashlib.sha256(format_extended(extended).encode()).hexdigest(),
        # The registered effects: an effect at a place of a robot is named EFFECT@PLACE.
        "made_of": tuple(library.get_effect(name.partition("@")[0]) for name in effects),
    }
    simulator: type[SystemSimulator] = type(re.sub(r"\W", "_", extended.name), (kind,), body)
    # The base class copies these from the system; replace them by the fitted ones.
    additions = ", ".join(extended.effects) or "nothing added"
    fitted_attributes = {
        "name": extended.name,
        "says": f"{extended.system} with {additions}, fitted to: {extended.title}",
        "parameters": parameters,
    }
    for name, value in fitted_attributes.items():
        setattr(simulator, name, value)
    return simulator


def _names(kind: type[SystemSimulator]) -> list[str]:
    return [parameter.name for parameter in kind.parameters]


def check_not_extended(kind: type[SystemSimulator]) -> None:
    """Refuse a simulator that is extended already, since effects cannot be added to it again.

    Raises:
        InputError: The simulator is extended already.
    """
    if hasattr(kind, "extends"):
        extended: Any = kind  # whose additional attributes are not typed
        advice = f"system it extends, {extended.extends}"
        if kind.has_model:
            advice = f"model file it extends, --model {extended.robot.path}"
        raise InputError(f"simulator {kind.name} is extended already; name the {advice}")


def _list_coefficients(
    extended: ExtendedSimulator, kind: type[SystemSimulator]
) -> list[FittedValue]:
    """Return all coefficients in the order of the simulator's parameters; zero if not stated.

    Args:
        extended: extended simulator of a diagnosis: fitted parameters, constants and effects.
        kind: simulator class of its system.
    """
    values = []
    for name, numbers in extended.effects.items():
        effect = library.find_effect(name, kind.system)
        coefficients = effect.on(kind.system)
        check_known_names(f"coefficient of effect {name}", numbers, [c.name for c in coefficients])
        parameters = make_effect_parameters(effect, kind.system, extended.observe)
        for parameter, coefficient in zip(parameters, coefficients, strict=True):
            zero = FittedValue(0.0, parameter.unit, low=None, high=None)
            values.append(numbers.get(coefficient.name, zero))
    return values


def _set_nominal(parameter: Parameter, number: FittedValue) -> Parameter:
    """Set the nominal value of a parameter to a fitted number, with a training range around it.

    Learned tuners are trained in this range. Its half width is the larger of two: a share of the
    number, and a multiple of the half width of its 95 % interval, if it has one.

    Args:
        parameter: parameter with its bounds.
        number: fitted value, with its interval.

    Returns:
        The parameter with the number as nominal value, and bounds that include it.
    """
    reach = max(MIN_TRAINING_RANGE_SHARE * abs(number.value), _MIN_HALF_WIDTH)
    if number.low is not None and number.high is not None:
        reach = max(reach, TRAINING_RANGE_HALF_WIDTHS * (number.high - number.low) / 2.0)
    low, high = parameter.bounds
    # The fitted value may be outside the plausible range; extend the bounds to include it.
    low, high = min(low, number.value), max(high, number.value)
    training_range = (max(low, number.value - reach), min(high, number.value + reach))
    # Bounds on both sides of the number may leave no range; then the bounds are used (None).
    training = training_range if training_range[0] < training_range[1] else None
    return replace(parameter, nominal=number.value, bounds=(low, high), training=training)


SimulatorLookup = Callable[[str], type[Simulator]]
"""Function that returns the simulator registered under a name."""


def load_extended(path: Path, find: SimulatorLookup) -> type[SystemSimulator]:
    """Load the extended simulator from a file.

    Args:
        path: Path of extended.toml.
        find: Function that returns the simulator of a system.

    Raises:
        InputError: The file, or the system that it names, is not usable.
    """
    _, _, simulator = open_extended(path, find)
    return simulator


def open_extended(
    path: Path, find: SimulatorLookup
) -> tuple[ExtendedSimulator, type[SystemSimulator], type[SystemSimulator]]:
    """Load a file together with the simulator of its system.

    Args:
        path: Path of extended.toml.
        find: Function that returns the simulator of a system.

    Returns:
        Content of the file, the simulator class of its system, and the extended simulator class.

    Raises:
        InputError: The file, or the system that it names, is not usable.
    """
    extended = read_extended(path)
    try:
        kind = extended.robot.make_simulator() if extended.robot else find(extended.system)
        if not issubclass(kind, SystemSimulator):
            raise InputError(f"system {extended.system} takes no effects")
        check_not_extended(kind)
        return replace(extended, kind=kind), kind, make_simulator_class(extended, kind)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def list_effect_coefficients(
    extended: ExtendedSimulator, kind: type[Simulator]
) -> dict[str, list[float]]:
    """List the coefficients of an extended simulator by effect, in the order of the effect.

    Coefficients that its file does not state are zero.

    Args:
        extended: extended simulator of a diagnosis: fitted parameters, constants and effects.
        kind: class of the simulator.

    Raises:
        InputError: the simulator does not support effects.
    """
    if not issubclass(kind, SystemSimulator):
        raise InputError(f"simulator {kind.name} takes no effects, and cannot be extended")
    coefficients = {}
    for name, numbers in extended.effects.items():
        declared_coefficients = library.find_effect(name, kind.system).on(kind.system)
        coefficients[name] = [
            numbers[c.name].value if c.name in numbers else 0.0 for c in declared_coefficients
        ]
    return coefficients
