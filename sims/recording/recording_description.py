"""Read and check the description `NAME.toml` of a recording.

It states the signal and unit of each column and what is known about each run.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from sims.core.files import require_file
from sims.core.simulator import Array, Channel, InputError, Simulator
from sims.core.system import System
from sims.core.toml_validation import (
    check_finite,
    check_known_names,
    check_name_list,
    check_table,
    check_text,
    check_type,
    get_subtable,
    join_nested_names,
    list_nested_names,
    make_error,
    read_toml,
)
from sims.recording.column_mapping import RecordingSources, read_sources
from sims.recording.drive_switches import (
    DriveSwitch,
    check_switches,
    read_switches,
    remove_switch_keys,
)
from sims.recording.recorded_poses import ANGLES, QUATERNION_ENTRIES, find_recorded_bases
from sims.recording.unit_conversion import UnitScale, compute_unit_scale

DeclaredSignals: TypeAlias = type[Simulator] | type[System]
"""System or simulator that declares the channels, inputs, constants and states of a recording."""

_TOP_LEVEL_KEYS = (
    "system",
    "model",
    "actuators",
    "engine",
    "free",
    "title",
    "channels",
    "inputs",
    "constants",
    "runs",
    "extra",
    "time",
)
"""Keys allowed at the top level of the file."""

_COLUMN_KEYS = ("unit", "scale", "offset", "column", "matrix", "file")
"""Keys allowed in the table of a channel or an input."""

HOLD_MODES = ("zero", "linear")
"""How an input continues between two samples: it is held (zero order) or interpolated linearly."""

_MAX_NOISE_FACTOR = 1e12
"""Limit of plausible sensor noise, as a factor above and below the typical size of its channel."""


class _Column(NamedTuple):
    """Conversion of a column to SI units, and the table of the description that states it."""

    scale: UnitScale
    table: Mapping[str, Any]


@dataclass(frozen=True)
class RunMetadata:
    """Metadata of one run in the description; `held_out` is None where it is not stated."""

    constants: Mapping[str, float]
    initial: Mapping[str, float]
    held_out: bool | None


@dataclass(frozen=True)
class RecordingDescription:
    """Checked description of a recording.

    Attributes:
        system: Name of the system.
        title: Title in one line.
        channels: Conversion of each channel's column to SI units.
        inputs: Conversion of each input's column to SI units.
        noise: Standard deviation of each channel's noise where stated, SI units.
        constants: Known constants, SI units.
        runs: Metadata by run name, only for the runs that the description mentions.
        extra: Units, as written, of columns that belong to no channel or input.
        initial_pose_scales: Conversion to SI units of those extra columns that hold poses of
            floating bodies. The first cell in a run is the initial state, which no channel shows.
        linear: Inputs that are interpolated linearly between samples.
        sources: Files and columns from which the signals are read.
        wrapped: Angles whose whole turns are restored, each with the input that determines the
            turn.
        switches: Columns that say when drives are on.
        orientations: Floating bodies whose orientation is recorded as a quaternion, with the
            orientation (4,) in the model file. The four columns are among the channels.
    """

    system: str
    title: str
    channels: Mapping[str, UnitScale]
    inputs: Mapping[str, UnitScale]
    noise: Mapping[str, float]
    constants: Mapping[str, float]
    runs: Mapping[str, RunMetadata]
    extra: Mapping[str, str]
    initial_pose_scales: Mapping[str, UnitScale]
    linear: frozenset[str]
    sources: RecordingSources
    switches: tuple[DriveSwitch, ...] = ()
    wrapped: Mapping[str, str] = field(default_factory=dict)
    orientations: Mapping[str, Array] = field(default_factory=dict)


@dataclass(frozen=True)
class ModelFileReference:
    """Model file of the robot that was recorded, with the settings of the description.

    Attributes:
        path: Path of the model file.
        actuators: Actuators that are missing in the file, by name.
        engine: Time step and integrator, where they differ from those of the file, and floating
            joints whose pose is recorded.
        free: Unknown parameters that are estimated unless others are requested.
        description: File that states all this, for messages; None without one.
    """

    path: Path
    actuators: Mapping[str, Any]
    engine: Mapping[str, Any]
    free: tuple[str, ...] = ()
    description: Path | None = None


def read_model_reference(
    path: str | Path, model: str | Path | None = None
) -> ModelFileReference | None:
    """Read the model file that a recording's description states; None if it states a system.

    Args:
        path: Table of the recording, `NAME.csv`.
        model: Model file to use instead of the stated one.

    Raises:
        InputError: The description is missing or malformed, or states both system and model.
    """
    return get_model_reference(*read_meta(Path(path)), model)


def get_model_reference(
    description: Path, meta: Mapping[str, Any], model: str | Path | None = None
) -> ModelFileReference | None:
    """Return the model file that a description states; None if it states a system.

    It comes with what the description adds to the file: actuators, engine settings (among them the
    floating joints whose pose is recorded), and free parameters.

    Args:
        description: Path of the description, for messages; the path of the model file is relative
            to its folder.
        meta: Content of the description.
        model: Model file to use instead of the stated one.

    Raises:
        InputError: The description is malformed, or states both system and model.
    """
    if model is None and "model" not in meta:
        return None
    if model is None:
        if "system" in meta:
            raise InputError(f"{description}: expected system or model, found both; leave one out")
        model = description.parent / check_text(description, "model", meta["model"])
    actuators = remove_switch_keys(get_subtable(description, meta, "actuators"))
    engine = dict(get_subtable(description, meta, "engine"))
    bases = find_recorded_bases(list_nested_names(get_subtable(description, meta, "channels")))
    # A body whose pose is recorded gets six joints with one coordinate each, unless it is fixed.
    if bases and not engine.get("fix_base"):
        engine["recorded_bases"] = bases
    free = check_name_list(description, "free", meta.get("free", []), 'names, as ["damping@*"]')
    return ModelFileReference(Path(model), actuators, engine, free, description)


def read_system_name(path: str | Path) -> str:
    """Read the name of the system that a recording's description states.

    Args:
        path: Table of the recording, `NAME.csv`.

    Raises:
        InputError: The description is missing or malformed, or states no system.
    """
    description, meta = read_meta(Path(path))
    return _check_system_name(description, meta)


def get_description_path(table: Path) -> Path:
    """Return the path of the description `NAME.toml` of a table.

    A path of the description itself is returned unchanged.

    Raises:
        InputError: The path has no file name.
    """
    if not table.name:
        raise InputError(f"expected a recording's table, NAME.csv, found '{table}'")
    return table.with_suffix(".toml")


def read_stated_columns(
    path: Path, declared: DeclaredSignals
) -> dict[str, tuple[str, float, float]]:
    """Read the unit and the conversion to SI units of each channel and input.

    Args:
        path: Table of the recording, `NAME.csv`.
        declared: System of the recording, or simulator of it.

    Returns:
        Three entries by channel and input: the stated unit, the factor from the numbers of the
        column to SI units, and the stated `scale`, which is part of that factor.

    Raises:
        InputError: The description is missing or malformed.
    """
    description = get_description_path(path)
    reader = _DescriptionReader(description, read_toml(description), declared)
    columns = {**reader.read_channels(), **reader.read_columns("input", declared.inputs)}
    return {
        name: (
            str(column.table["unit"]),
            column.scale.gain,
            float(column.table.get("scale", 1.0)),
        )
        for name, column in columns.items()
    }


def read_meta(table: Path) -> tuple[Path, dict[str, Any]]:
    """Read the description of a recording.

    Args:
        table: `NAME.csv`, or `NAME.toml` itself.

    Returns:
        Path and content of the description.

    Raises:
        InputError: The recording or its description is missing, or it is not TOML.
    """
    description = get_description_path(table)
    try:
        missing = not description.exists()
    except (OSError, ValueError):  # not a valid path; `require_file` reports the reason
        missing = True
    if missing:
        # The message refers to the file that the user named.
        require_file(table, "a recording, NAME.csv with NAME.toml next to it")
        raise InputError(
            f"{description}: no such file; expected the description of {table.name}: its system or "
            "model, its channels and their units"
        )
    return description, read_toml(description)


def check_description(
    path: Path, meta: Mapping[str, Any], declared: DeclaredSignals
) -> RecordingDescription:
    """Check a description against the system's channels, inputs, constants and states.

    Args:
        path: Path of the description, for messages.
        meta: Content of the description, as in `NAME.toml`.
        declared: System, or simulator of it.

    Returns:
        The checked description.

    Raises:
        InputError: The description is malformed; the message is one line.
    """
    return _DescriptionReader(path, meta, declared).read()


def _check_system_name(path: Path, meta: Mapping[str, Any]) -> str:
    """Return the name of the system that a description states."""
    system = meta.get("system")
    if not isinstance(system, str):
        raise make_error(path, "", 'system = "NAME"', system)
    return system


def _get_system(declared: DeclaredSignals) -> object:
    """Return the system of a simulator, or the system itself."""
    return getattr(declared, "system", declared)


def get_floating_state_units(declared: DeclaredSignals) -> Mapping[str, str]:
    """Return the units of the states of floating bodies, by name; empty if there are none."""
    units: Mapping[str, str] = getattr(_get_system(declared), "floating_state_units", {})
    return units


def get_required_state_units(declared: DeclaredSignals) -> Mapping[str, str]:
    """Return the units of the states that every run has to state, by name; usually none.

    They are those of floating bodies whose pose does not follow from closed loops.

    Args:
        declared: System, or simulator of it.
    """
    units: Mapping[str, str] = getattr(_get_system(declared), "required_state_units", {})
    return units


class _DescriptionReader:
    """Reader of the tables of one description, which are checked against a system."""

    def __init__(self, path: Path, meta: Mapping[str, Any], declared: DeclaredSignals) -> None:
        """Store the description, and list the signals that it may state.

        `orientations` has the orientation in the model file of each floating body whose pose is
        recorded. Some channels of such a body are computed from its quaternion, so the entries of
        the quaternion are possible channels, too.

        Args:
            path: Path of the description, for messages.
            meta: Content of the description.
            declared: System, or simulator of it.
        """
        self.path, self.meta, self.declared = path, meta, declared
        self.system = _get_system(declared)
        self.pose_units = get_floating_state_units(declared)
        self.orientations: Mapping[str, tuple[float, ...]] = getattr(
            self.system, "base_orientations", {}
        )
        quaternions = [
            Channel(f"q.{base}.{entry}", "1")
            for base in self.orientations
            for entry in QUATERNION_ENTRIES
        ]
        self.possible_channels = {c.name: c for c in (*declared.channels, *quaternions)}

    def read(self) -> RecordingDescription:
        """Read and check all tables.

        They are checked in this order: channels, inputs, constants, runs, extra columns (which are
        neither channel nor input), and columns that switch drives.

        Raises:
            InputError: The description is malformed; the message is one line.
        """
        path, meta, declared = self.path, self.meta, self.declared
        self._check_known_names("", meta, _TOP_LEVEL_KEYS)
        if "free" in meta and "model" not in meta:
            raise make_error(
                path, "free", "it with model = FILE alone (else --free A,B)", meta["free"]
            )
        title = check_text(path, "title", meta.get("title", path.stem))
        channels = self.read_channels()
        orientations = self._find_orientations(channels)
        # A robot has inputs that cannot be recorded, since their effect depends on quantities that
        # a recording does not contain.
        refusal_reasons: Mapping[str, str] = getattr(self.system, "refused_inputs", {})
        input_tables = self._get_tables("inputs", refusal_reasons)
        for name, reason in refusal_reasons.items():
            if name in input_tables:
                raise InputError(f"{path}: input {name}: {reason}")
        inputs = self.read_columns("input", declared.inputs)
        if not channels:
            raise InputError(f"{path}: expected at least one [channels.NAME] table, found none")
        constants = self._read_constants("constants", meta.get("constants", {}))
        self._check_constants_possible("constants", constants)
        # Which runs exist is known only after the table was read; their names are checked then.
        runs = {
            name: self._read_run(name, table)
            for name, table in get_subtable(path, meta, "runs").items()
        }
        extra = self._read_extra_columns()
        switches = self._read_drive_switches()
        # A column that switches drives need not be stated as an extra column.
        extra = {**{switch.column: {"unit": "1"} for switch in switches}, **extra}
        sources = read_sources(
            path,
            meta,
            {name: column.table for name, column in (*channels.items(), *inputs.items())},
            extra,
        )
        return RecordingDescription(
            # A robot has no system name: its model file is stated instead.
            system=declared.name if declared.has_model else _check_system_name(path, meta),
            title=title,
            channels={name: column.scale for name, column in channels.items()},
            inputs={name: column.scale for name, column in inputs.items()},
            noise=self._read_noises(channels, orientations),
            constants=constants,
            runs=runs,
            extra={name: str(table["unit"]) for name, table in extra.items()},
            initial_pose_scales={
                name: self._compute_scale(f"extra {name}", str(extra[name]["unit"]), unit)
                for name, unit in self.pose_units.items()
                if name in extra
            },
            linear=frozenset(
                name for name, column in inputs.items() if self._is_interpolated(name, column)
            ),
            sources=sources,
            switches=switches,
            wrapped=self._read_wrapped_channels(channels, inputs),
            orientations=orientations,
        )

    def _check_known_names(
        self, table_name: str, entry_names: Iterable[str], allowed_names: Iterable[str]
    ) -> None:
        location = f"in [{table_name}] " if table_name else ""
        check_known_names(f"entry {location}of {self.path}", entry_names, allowed_names)

    def _get_tables(self, key: str, names: Collection[str]) -> dict[str, Any]:
        """Return the tables below a key of the description, by their full names."""
        return join_nested_names(get_subtable(self.path, self.meta, key), names)

    def _compute_scale(self, location: str, unit: str, target: str) -> UnitScale:
        """Return the conversion of a stated unit, with the location in the message of an error."""
        try:
            return compute_unit_scale(unit, target)
        except InputError as error:
            raise InputError(f"{self.path}: {location}: {error}") from None

    # -- columns

    def read_channels(self) -> dict[str, _Column]:
        """Return the columns of the channels by name.

        Raises:
            InputError: A channel is malformed, unknown, or a state of a floating body; the message
                explains where to state the latter.
        """
        tables = self._get_tables("channels", self.pose_units)
        for name in self.pose_units:
            if name in tables:
                raise InputError(
                    f"{self.path}: channel {name}: expected a joint or a sensor, found where a "
                    f'body floats; as [extra."{name}"] the column\'s first cell says where a run '
                    "begins"
                )
        return self.read_columns("channel", list(self.possible_channels.values()))

    def read_columns(self, kind: str, signals: Sequence[Channel]) -> dict[str, _Column]:
        """Return the columns that the description states for channels or inputs, by signal.

        Args:
            kind: ``channel`` or ``input``.
            signals: signals of this kind that may be stated.

        Returns:
            Conversion to SI units and table of each column.
        """
        units = {signal.name: signal.unit for signal in signals}
        tables = self._get_tables(f"{kind}s", units)
        check_known_names(f"{kind} in {self.path}", tables, units)
        return {
            name: self._read_column(kind, name, table, units[name])
            for name, table in tables.items()
        }

    def _read_column(self, kind: str, name: str, value: Any, unit: str) -> _Column:
        """Check the table of one channel or input, and compute its conversion to SI units.

        The table states a unit, and perhaps a scale s and an offset o, such as those of an encoder.
        With the conversion y -> g y + b of the unit to the SI unit, a value x of the log becomes
        g (s x + o) + b.

        Args:
            kind: ``channel`` or ``input``.
            name: Name of the signal.
            value: Table from the description.
            unit: SI unit of the signal.

        Raises:
            InputError: An entry is unknown or malformed, or the unit does not convert.
        """
        path, location = self.path, f"{kind} {name}"
        expected = f'unit = "{unit}"'
        table = check_table(path, location, value, f"a table with {expected}")
        # Noise of an input is not allowed, because simulations cannot use it.
        own_keys = ("noise", "unwrap") if kind == "channel" else ("hold",)
        self._check_known_names(f"{kind}s.{name}", table, (*_COLUMN_KEYS, *own_keys))
        # The unit is required: a log in degrees without a unit would be read as radians.
        stated_unit = check_text(
            path, location, table.get("unit"), f"{expected} or one that converts to it"
        )
        unit_scale = self._compute_scale(location, stated_unit, unit)
        if not {"scale", "offset"} & table.keys():
            return _Column(unit_scale, table)
        factor = check_finite(path, f"{kind}s.{name}.scale", table.get("scale", 1.0))
        if factor == 0:
            raise make_error(
                path, f"{kind}s.{name}.scale", "a factor that is not zero", table["scale"]
            )
        # The offset is in the stated unit, so that the zero of an encoder can be copied from its
        # log.
        offset = check_finite(path, f"{kind}s.{name}.offset", table.get("offset", 0.0))
        scale = UnitScale(
            gain=factor * unit_scale.gain,
            offset=unit_scale.gain * offset + unit_scale.offset,
        )
        return _Column(scale, table)

    def _is_interpolated(self, name: str, column: _Column) -> bool:
        """Return whether an input is interpolated linearly between samples."""
        hold_mode = column.table.get("hold", "zero")
        if hold_mode not in HOLD_MODES:
            expected = " or ".join(f'"{mode}"' for mode in HOLD_MODES)
            raise make_error(self.path, f"inputs.{name}.hold", expected, hold_mode)
        return bool(hold_mode == "linear")

    def _read_wrapped_channels(
        self, channels: Mapping[str, _Column], inputs: Mapping[str, _Column]
    ) -> dict[str, str]:
        """Return the channels whose whole turns are restored: angles recorded within one turn.

        Such a channel has an entry `unwrap`: true, or the name of the command that determines its
        turn.

        Args:
            channels: Columns of the channels.
            inputs: Columns of the inputs.

        Returns:
            By channel, the name of the command; "" for true.

        Raises:
            InputError: The entry is of another type, the command is unknown, or the channel is not
                an angle.
        """
        commands_by_channel = {}
        for name, column in channels.items():
            value, key = column.table.get("unwrap", False), f"channels.{name}.unwrap"
            if not isinstance(value, (bool, str)):
                expected = "true, or the name of the command that determines the turn"
                raise make_error(self.path, key, expected, value)
            if isinstance(value, str):
                check_known_names(f"{key} of {self.path}", [value], inputs)
            if not value:
                continue
            unit = self.possible_channels[name].unit
            if unit != "rad":
                expected = f"it with an angle alone ({name} is in {unit})"
                raise make_error(self.path, key, expected, value)
            commands_by_channel[name] = value if isinstance(value, str) else ""
        return commands_by_channel

    def _find_orientations(self, channels: Mapping[str, _Column]) -> dict[str, Array]:
        """Return the floating bodies whose orientation is recorded as a quaternion.

        A motion capture system, for example, records quaternions. They are converted later to
        angles relative to the orientation in the model file. Bodies without such channels are left
        out.

        Args:
            channels: Columns of the channels.

        Returns:
            By the floating joint of the body, its orientation in the model file, a quaternion (4,).

        Raises:
            InputError: A quaternion is incomplete, or the angles are recorded in addition.
        """
        orientations = {}
        for base, reference in self.orientations.items():
            names = [f"q.{base}.{entry}" for entry in QUATERNION_ENTRIES]
            missing = [name for name in names if name not in channels]
            if len(missing) == len(names):
                continue
            if missing:
                raise InputError(
                    f"{self.path}: expected all of {', '.join(names)}, found no {missing[0]}"
                )
            angles = [f"q.{base}.{angle}" for angle in ANGLES if f"q.{base}.{angle}" in channels]
            if angles:
                raise InputError(
                    f"{self.path}: expected {names[0]} or {angles[0]}, found both; leave one out"
                )
            orientations[base] = np.array(reference)
        return orientations

    def _read_noises(
        self, channels: Mapping[str, _Column], orientations: Collection[str]
    ) -> dict[str, float]:
        """Return the standard deviation of each channel's noise where stated, in SI units.

        It is stated in the unit of the column. The noise of a quaternion is replaced by that of the
        three angles, which is twice as large: a small rotation by an angle changes an entry of the
        quaternion by half of it.

        Args:
            channels: columns of the channels.
            orientations: floating joints whose orientation is recorded as a quaternion.

        Raises:
            InputError: a noise is not positive, or beyond plausible sizes, since its unit is then
                probably wrong.
        """
        noises = {}
        for name, column in channels.items():
            if "noise" not in column.table:
                continue
            key, value = f"channels.{name}.noise", column.table["noise"]
            noise = check_finite(self.path, key, value)
            if noise <= 0:
                raise make_error(self.path, key, "more than 0 (leave it out if unknown)", value)
            # A standard deviation has no offset and no sign.
            noises[name] = abs(column.scale.gain) * noise
            typical_size = self.possible_channels[name].scale
            if not 1 / _MAX_NOISE_FACTOR < noises[name] / typical_size < _MAX_NOISE_FACTOR:
                expected = f"that of values of about {typical_size:g} in SI units"
                raise make_error(self.path, key, expected, value)
        for base in orientations:
            largest = max(noises.pop(f"q.{base}.{entry}", 0.0) for entry in QUATERNION_ENTRIES)
            if largest > 0:
                noises |= {f"q.{base}.{angle}": 2.0 * largest for angle in ANGLES}
        return noises

    def _read_extra_columns(self) -> dict[str, Mapping[str, Any]]:
        """Return the tables of the columns that belong to no channel or input, by name.

        Raises:
            InputError: A table is malformed, or has the name of a channel or an input.
        """
        # A forgotten channel must not be accepted as an unused column.
        input_names = (signal.name for signal in self.declared.inputs)
        used_names = ["run", "t", *self.possible_channels, *input_names]
        tables = self._get_tables("extra", self.pose_units)
        for name, table in tables.items():
            if name in used_names:
                raise InputError(
                    f"{self.path}: extra.{name}: is declared as a column already; declare it as "
                    "channel or input"
                )
            unit = table.get("unit") if isinstance(table, dict) else None
            if not isinstance(unit, str):
                raise make_error(self.path, f"extra {name}", 'a table with unit = "TEXT"', table)
            self._check_known_names(f"extra.{name}", table, ("unit", "file", "column"))
        return tables

    def _read_drive_switches(self) -> tuple[DriveSwitch, ...]:
        """Read and check the columns that say when drives are on."""
        switches = read_switches(self.path, self.meta)
        names = [signal.name for signal in (*self.declared.channels, *self.declared.inputs)]
        actuators = [name.removeprefix("u.") for name in names if name.startswith("u.")]
        check_switches(self.path, switches, actuators, ["run", "t", *names])
        return switches

    # -- runs and constants

    def _read_run(self, name: str, value: Any) -> RunMetadata:
        """Check the table of one run: constants, initial state, and whether it is held out.

        Its folder or file is read elsewhere.

        Args:
            name: name of the run.
            value: its entry in the description, which must be a table.

        Raises:
            InputError: an entry is unknown, malformed, impossible, or a constant is given twice.
        """
        location = f"runs.{name}"
        table = check_table(self.path, location, value)
        constant_names = [c.name for c in self.declared.constants]
        self._check_known_names(
            location,
            table,
            ("constants", "initial", "held_out", "folder", "file", *constant_names),
        )
        held_out = table.get("held_out")
        if held_out is not None:
            check_type(self.path, f"{location}.held_out", held_out, bool, "true or false")
        # The constants of a run may be in a table of their own or among its other entries.
        constants = self._read_constants(f"{location}.constants", table.get("constants", {}))
        direct_constants = {key: number for key, number in table.items() if key in constant_names}
        for repeated_name in constants.keys() & direct_constants.keys():
            raise InputError(f"{self.path}: {location}: constant {repeated_name} is given twice")
        constants |= self._read_constants(location, direct_constants)
        self._check_constants_possible(location, constants)
        # The filters of a robot's actuators have states, too (activations).
        states = [*self.declared.states, *getattr(self.system, "activations", ())]
        initial = self._read_numbers(f"{location}.initial", table.get("initial", {}), states)
        return RunMetadata(constants, initial, held_out)

    def _read_constants(self, key: str, value: Any) -> dict[str, float]:
        return self._read_numbers(key, value, [c.name for c in self.declared.constants])

    def _read_numbers(
        self, key: str, value: Any, allowed_names: Collection[str]
    ) -> dict[str, float]:
        """Read a table of finite numbers, whose names must be among the allowed ones.

        Args:
            key: key of the table, for messages.
            value: the table; names with dots may be written as nested tables.
            allowed_names: names that may occur in it.

        Raises:
            InputError: it is not such a table.
        """
        entries = join_nested_names(check_table(self.path, key, value), allowed_names)
        self._check_known_names(key, entries, allowed_names)
        return {
            name: check_finite(self.path, f"{key}.{name}", number)
            for name, number in entries.items()
        }

    def _check_constants_possible(self, key: str, constants: Mapping[str, float]) -> None:
        """Check that constants are physically possible, such as a positive mass.

        Args:
            key: key of their table in the description, for messages.
            constants: constants by name, SI units.
        """
        for constant in self.declared.constants:
            value = constants.get(constant.name)
            # `wanted` states in words what the constant must be; it is empty for a possible value.
            if value is not None and (expected := constant.wanted(value)):
                raise InputError(
                    f"{self.path}: {key}.{constant.name}: expected {expected}, found {value:g}"
                )
