"""Simulate recordings with known parameters, for tests.

The recording contains only what a real one would; the true parameters go to a separate file, so
that a blind test stays blind.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, TypeAlias

import numpy as np

from bench.core.input_signals import evaluate_signal
from bench.core.option_dataclasses import option
from bench.core.plugin_registries import make_robot_simulator, simulators
from bench.core.random_streams import make_rng
from bench.core.resource_estimates import check_simulation_size
from sims import effects as library
from sims.core.argument_checks import Expected, Name, Names, check_arguments
from sims.core.files import check_absent
from sims.core.number_limits import (
    MAX_NUMBER,
    MAX_SAMPLING_RATE_HZ,
    MIN_RUN_SECONDS,
    is_plausible_number,
)
from sims.core.simulator import InputError, Scenario, Simulator
from sims.core.system import DefaultRecording
from sims.core.toml_validation import check_known_names
from sims.core.user_messages import append_unit, truncate_text
from sims.recording.recording import Recording, Run
from sims.recording.recording_description import ModelFileReference, get_floating_state_units
from sims.recording.recording_writer import write_recording
from sims.system_simulator import SystemSimulator

_TABLE_DIGITS = 9
"""Number of significant digits in the table: finer than any sensor, but files stay small."""
_MAX_SAMPLES = 1e8
"""Number of samples per run above which a length or rate is considered a typing error."""
ALL_CHANNELS = "*"
"""Name that stands for every channel that is not named."""

EffectCoefficients = float | Sequence[float] | Mapping[str, float]
"""Coefficients of one effect: the first one, several in order, or some by name."""


Effects: TypeAlias = Annotated[
    Mapping[str, EffectCoefficients],
    Expected("coefficients by the names of effects, as {'drag.linear': 2e-4}"),
]
"""Active effects with their coefficients, by name."""
InputSignal: TypeAlias = Annotated[
    float | str, Expected("a number or the text of a signal, as 'sine:2:0.5'")
]
"""Value of an input over time."""
InitialState: TypeAlias = Annotated[
    float | tuple[float, float], Expected("a number or (low, high)")
]
"""Initial state of each run, or the range from which it is drawn."""


@dataclass(frozen=True)
class SimulationSpec:
    """Specification of a recording to simulate; all numbers in SI units.

    Attributes:
        system: Registered name of a simulator, e.g. ``pendulum``; empty if a model is given.
        model: Model file of a robot to simulate instead of a system, MJCF or URDF.
        actuators: Actuators that the model file lacks, by name, as in a recording's
            ``[actuators.NAME]``.
        parameters: Parameters that differ from their nominal values, by name; or all in order.
        effects: Active effects with one coefficient, several in order, or some by name.
        constants: Constants that differ from the system's defaults.
        noise: Sensor noise, 1 sigma, of every channel, or by channel; ``*`` stands for channels not
            named.
        inputs: By name, a constant or the text of a signal, such as ``sine:2:0.5``
            (`bench.core.input_signals`).
        initial: Initial states by name, a value or (low, high) for a uniform draw in each run.
        observe: Channels to record (default: those of the system).
        runs: Number of runs.
        seconds: Length of a run in seconds.
        rate: Samples per second.
        engine: Engine of the simulation, pybullet, mujoco or batch (default: batch).
        seed: Seed of all random numbers.
        held_out: Number of final runs that are marked as held out (default: a third of them, at
            least one if there are several).
        force: Simulate even if it needs more resources than this machine has.
    """

    system: Name = option("", in_command=False)
    _: KW_ONLY
    model: str | Path | None = None
    actuators: Mapping[str, Any] | None = None
    parameters: Mapping[str, float] | Sequence[float] | None = None
    effects: Effects | None = None
    constants: Mapping[str, float] | None = None
    noise: float | Mapping[str, float] = 0.0
    inputs: Mapping[str, InputSignal] | None = None
    initial: Mapping[str, InitialState] | None = None
    observe: Names = ()
    runs: int = option(4, "N")
    seconds: float = option(4.0, "T")
    rate: float = option(100.0, "HZ")
    engine: Name | None = None
    seed: int = 0
    held_out: int | None = option(None, "M")
    force: bool = False


@dataclass(frozen=True)
class SimulatedRecording:
    """A recording made by simulation.

    Attributes:
        recording: The recording, as a real one would be.
        truth: The true parameters and settings, as TOML tables.
        simulator: Simulator that made the recording.
    """

    recording: Recording
    truth: Mapping[str, Any] = field(repr=False)
    simulator: Simulator = field(repr=False)

    @check_arguments
    def write(self, path: str | Path) -> list[Path]:
        """Write the table, its description and its true parameters: all three or none.

        Args:
            path: Path ``NAME.csv``; NAME.toml and NAME.truth.toml are written in the same folder.

        Returns:
            Paths of the three files.

        Raises:
            InputError: A file exists already, or cannot be written.
        """
        import tomli_w

        table_path = Path(path)
        truth = _make_true_parameters_path(table_path)
        truth_file = {truth: tomli_w.dumps(dict(self.truth))}
        write_recording(
            table_path,
            self.recording,
            type(self.simulator),
            digits=_TABLE_DIGITS,
            extra_files=truth_file,
        )
        return [table_path, table_path.with_suffix(".toml"), truth]


def check_output_path(out: Path) -> None:
    """Reject an output path that cannot be used, before the work, which may take minutes.

    Raises:
        InputError: It does not end in ``.csv``, or a file exists already.
    """
    check_absent([out, out.with_suffix(".toml"), _make_true_parameters_path(out)])


def _make_true_parameters_path(table_path: Path) -> Path:
    if table_path.suffix != ".csv":
        raise InputError(f"{table_path}: expected a name that ends in .csv")
    return table_path.with_suffix(".truth.toml")


def simulate_recording(options: SimulationSpec) -> SimulatedRecording:
    """Simulate a recording with known parameters; nothing is written before `write` is called.

    Args:
        options: Specification; `simgap.simulate` takes its attributes as arguments, all but
            `system` by name.

    Raises:
        InputError: The specification contains something impossible; the message is one line.
    """
    return _RecordingSimulation(options).make()


class _RecordingSimulation:
    """A checked specification, and its simulation."""

    def __init__(self, options: SimulationSpec) -> None:
        """Check the specification, and build the simulator with the true effects and constants.

        What the specification leaves open is taken from the default recording of the system
        (`defaults`). `theta` has the true parameters by name, `effects` the true coefficients by
        effect, and `ranges` the interval from which each initial state is drawn.

        Args:
            options: Specification of the recording.

        Raises:
            InputError: The specification names something unknown or has implausible numbers.
        """
        self.options = options
        self.kind = kind = _get_simulator_class(options)
        self.name = options.system or kind.name
        self.defaults = _get_default_recording(kind)
        self.held_out = _count_held_out_runs(options)
        self.theta = _make_parameters(
            {} if options.parameters is None else options.parameters, kind
        )
        self.effects = {
            name: _make_coefficients(name, coefficients, kind)
            for name, coefficients in (options.effects or {}).items()
        }
        self.engine = options.engine
        if not self.engine and issubclass(kind, SystemSimulator) and not kind.own_engine:
            self.engine = "batch"
        self.simulator = self._build_simulator()
        self.noise = _make_noise_table(options.noise, [c.name for c in self.simulator.channels])
        initial, inputs = options.initial or {}, options.inputs or {}
        check_known_names("initial state", initial, list(kind.states))
        stated_ranges = {name: _check_interval(name, value) for name, value in initial.items()}
        self.ranges = {**self.defaults.initial, **stated_ranges}
        check_known_names("input", inputs, [c.name for c in kind.inputs])
        inputs = {**self.defaults.inputs, **inputs}
        # A constant input is stored as the text of a signal, with all digits of its number.
        self.inputs = {
            name: value if isinstance(value, str) else f"{_check_number('input', name, value):.17g}"
            for name, value in inputs.items()
        }
        samples = _count_samples(options)
        check_simulation_size(options.runs, samples, options.seconds, self.simulator, options.force)
        # Rounded as in the table, so that the times read back are the times simulated.
        times = (np.arange(samples) / options.rate).tolist()
        self.times = np.array([float(f"{t:.{_TABLE_DIGITS}g}") for t in times])

    def make(self) -> SimulatedRecording:
        """Simulate all runs, add noise, and return the recording with its true model.

        `truth` has everything that produced the recording, so that a diagnosis can be compared with
        it.
        """
        scenarios = {
            str(number): self._build_scenario(number) for number in range(1, self.options.runs + 1)
        }
        runs = tuple(
            self._simulate_run(int(name), scenario) for name, scenario in scenarios.items()
        )
        stated_noise = {name: sigma for name, sigma in self.noise.items() if sigma}
        constants, system = self.simulator.constant_values, self.name
        path = Path(f"{system}-simulated.csv")  # Used in messages only; there is no such file.
        model_path = Path(self.options.model) if self.options.model else None
        model = None
        if model_path is not None:
            model = ModelFileReference(model_path, self.options.actuators or {}, {})
        title = f"{system}, simulated"
        recording = Recording(path, system, title, constants, stated_noise, runs, model=model)
        truth = {
            "system": system,
            **({"model": str(model_path.resolve())} if model_path else {}),
            "engine": self.engine or "its own",
            "seed": self.options.seed,
            "parameters": self.theta,
            "effects": self.effects,
            "noise": self.noise,
            "constants": constants,
            "inputs": self.inputs,
            "runs": {name: {"initial": dict(s.initial)} for name, s in scenarios.items()},
        }
        self.simulator.close()
        return SimulatedRecording(recording, truth, self.simulator)

    def _build_simulator(self) -> Simulator:
        """Build the simulator with the specified constants, channels, engine and true effects.

        Raises:
            InputError: A constant is unknown or implausible, or the simulator has no effects and
                engines although some are specified.
        """
        constants = self.options.constants or {}
        check_known_names("constant", constants, [c.name for c in self.kind.constants])
        values = {n: _check_number("constant", n, value) for n, value in constants.items()}
        observe = list(self.options.observe) or list(self.defaults.observe) or None
        if issubclass(self.kind, SystemSimulator):
            return self.kind(values, observe, engine=self.engine, fixed=self.effects)
        if self.effects or self.engine:
            raise InputError(f"simulator {self.name} supports neither effects nor engines")
        return self.kind(values, observe)

    def _build_scenario(self, number: int) -> Scenario:
        """Build the scenario of run `number`: its initial states and inputs.

        An initial state is drawn from its interval; equal ends fix it. Each random draw has its own
        stream, so that no draw depends on any other.

        Args:
            number: number of the run from 1.
        """
        initial = {
            name: low if low == high else self._make_rng("initial", name, number).uniform(low, high)
            for name, (low, high) in self.ranges.items()
        }
        inputs = {
            name: evaluate_signal(text, self.times, self._make_rng("input", name, number))
            for name, text in self.inputs.items()
        }
        return Scenario(self.times, initial, inputs)

    def _simulate_run(self, number: int, scenario: Scenario) -> Run:
        """Simulate a run, and add white Gaussian noise to each channel.

        The true initial states are left out, because a diagnosis has to estimate them; only the
        pose of a floating body is given.

        Args:
            number: number of the run from 1; the last ones are held out for validation.
            scenario: times, inputs and initial states of the run.

        Raises:
            InputError: The simulation diverges.
        """
        # (T, C): the simulator takes a batch of parameter vectors, here of one.
        observed = self.simulator.simulate(np.array([list(self.theta.values())]), scenario)[0]
        if not np.isfinite(observed).all():
            raise InputError(
                f"run {number}: the simulation failed; check parameters, effects and initial states"
            )
        channels = {}
        for (name, sigma), values in zip(self.noise.items(), observed.T, strict=True):
            rng = self._make_rng("noise", name, number)
            channels[name] = values + sigma * rng.standard_normal(values.size)
        # The last `self.held_out` runs are held out.
        held_out = number > self.options.runs - self.held_out
        # The pose of a floating body is never estimated, so it need not be hidden.
        states = {**self.kind.states, **scenario.initial}
        initial_poses = {name: states[name] for name in get_floating_state_units(self.kind)}
        return Run(str(number), self.times, channels, scenario.inputs, {}, initial_poses, held_out)

    def _make_rng(self, purpose: str, name: str, number: int) -> np.random.Generator:
        return make_rng("simulate", self.name, purpose, name, self.options.seed, number)


def _get_simulator_class(options: SimulationSpec) -> type[Simulator]:
    """Return the simulator class that a specification names, by its system or its robot model file.

    Args:
        options: Specification of the recording.

    Raises:
        InputError: It names both or neither.
    """
    if bool(options.system) == (options.model is not None):
        found_text = "both" if options.system else "neither"
        raise InputError(
            f"expected a system (see `simgap list systems`) or a model, found {found_text}"
        )
    if options.model is None:
        return simulators.get(options.system)
    return make_robot_simulator(options.model, options.actuators or {})


def _get_default_recording(kind: type[Simulator]) -> DefaultRecording:
    """Return the default initial states, inputs and observed channels of a simulator's system.

    For an extended simulator, which has another name than its system, the default channels are left
    out, because it records the channels of the recording that it was fitted to. A simulator without
    a system has no defaults.

    Args:
        kind: Simulator class.
    """
    if not issubclass(kind, SystemSimulator):
        return DefaultRecording()
    default_recording = kind.system.usual_recording
    if kind.name == kind.system.name:
        return default_recording
    return replace(default_recording, observe=())


def _count_held_out_runs(options: SimulationSpec) -> int:
    """Return how many runs, the last ones, are held out for validation; by default a third.

    Args:
        options: Specification of the recording.

    Raises:
        InputError: There is no run, or as many runs are held out as there are.
    """
    if options.runs < 1:
        raise InputError(f"runs = {options.runs}: expected at least 1")
    if options.held_out is None:
        # A single run is divided when it is read.
        return 0 if options.runs == 1 else max(1, options.runs // 3)
    if not 0 <= options.held_out < options.runs:
        raise InputError(
            f"held_out = {options.held_out}: expected fewer than the {options.runs} runs"
        )
    return options.held_out


def _count_samples(options: SimulationSpec) -> int:
    """Return the number of samples of a run: duration (s) times rate (Hz), rounded.

    Args:
        options: Specification of the recording.

    Raises:
        InputError: The number is below 2 or too large, the run too short, or the rate too high.
    """
    product = options.seconds * options.rate
    samples = round(product) if 0 < product < _MAX_SAMPLES else 0
    if samples < 2 or options.seconds < MIN_RUN_SECONDS or options.rate > MAX_SAMPLING_RATE_HZ:
        raise InputError(
            f"seconds = {options.seconds:g}, rate = {options.rate:g}: expected at least 2 samples "
            f"and below {_MAX_SAMPLES:g}"
        )
    return samples


def _make_parameters(
    values: Mapping[str, float] | Sequence[float], kind: type[Simulator]
) -> dict[str, float]:
    """Return every parameter's value by name, in the simulator's order.

    Parameters that are not named have their nominal value. Values outside of their bounds are
    refused.

    Args:
        values: values by name, or all in order.
        kind: simulator class, which declares the parameters.

    Raises:
        InputError: there are too few or too many values, a name is unknown, or a value is out of
            its bounds.
    """
    names = [p.name for p in kind.parameters]
    if not isinstance(values, Mapping):
        if len(values) != len(names):
            raise InputError(
                f"parameters: expected {len(names)} values ({', '.join(names)}), found "
                f"{len(values)}"
            )
        values = dict(zip(names, values, strict=True))
    check_known_names("parameter", values, names)
    theta = {
        p.name: _check_number("parameter", p.name, values.get(p.name, p.nominal))
        for p in kind.parameters
    }
    for p in kind.parameters:
        low, high = p.bounds
        if not low <= theta[p.name] <= high:
            span = append_unit(f"{low:g} to {high:g}", p.unit)
            raise InputError(f"parameter {p.name} = {theta[p.name]:g}: expected {span}")
    return theta


def _make_coefficients(
    name: str, stated_values: EffectCoefficients, kind: type[Simulator]
) -> list[float]:
    """Return an effect's coefficients in order; coefficients that are not named are zero.

    Args:
        name: name of the effect, with its place on a robot: ``drag.linear@elbow``.
        stated_values: one coefficient, several in order, or some by name.
        kind: class of the simulator.
    """
    if isinstance(stated_values, Mapping):
        names = []
        if issubclass(kind, SystemSimulator):
            coefficients = library.find_effect(name, kind.system).on(kind.system)
            names = [coefficient.name for coefficient in coefficients]
        check_known_names(f"coefficient of effect {name}", stated_values, names)
        return [_check_number(f"effect {name}:", c, stated_values.get(c, 0.0)) for c in names]
    values = [stated_values] if isinstance(stated_values, int | float) else list(stated_values)
    return [
        _check_number("effect", name, value) for value in _repeat_for_places(name, values, kind)
    ]


def _repeat_for_places(name: str, values: list[float], kind: type[Simulator]) -> list[float]:
    """Repeat the coefficients of one place of a robot for all places of an effect family.

    A family, such as a drag at each joint, has a member for each place (joint, body or actuator) at
    which the effect acts. Values that are not the coefficients of exactly one member are returned
    unchanged.

    Args:
        name: name of the effect; that of a family ends with ``@*``.
        values: coefficients of one place, or of all places.
        kind: class of the simulator.
    """
    if not name.endswith("@*") or not issubclass(kind, SystemSimulator):
        return values
    effect = library.find_effect(name, kind.system)
    members = getattr(effect, "members", ())
    member_size = len(members[0].coefficients) if members else 0
    are_for_one_place = len(values) == member_size < len(effect.coefficients)
    return values * len(members) if are_for_one_place else values


def _make_noise_table(
    stated: float | Mapping[str, float], channels: Sequence[str]
) -> dict[str, float]:
    """Return the standard deviation of the noise of each channel, in the channel's unit.

    Args:
        stated: one value for all channels, or values by channel; the name ``*`` stands for all
            channels that are not named, which otherwise have no noise.
        channels: names of the recorded channels.

    Raises:
        InputError: a channel is unknown, or a value is negative or not a number.
    """
    stated_by_name = stated if isinstance(stated, Mapping) else {ALL_CHANNELS: stated}
    check_known_names(
        "recorded channel", [name for name in stated_by_name if name != ALL_CHANNELS], channels
    )
    default = stated_by_name.get(ALL_CHANNELS, 0.0)
    values = {
        name: _check_number("noise of", name, stated_by_name.get(name, default))
        for name in channels
    }
    for name, value in values.items():
        if value < 0:
            raise InputError(f"noise of {name} = {value:g}: expected at least 0")
    return values


def _check_interval(name: str, stated_range: float | tuple[float, float]) -> tuple[float, float]:
    """Return the interval (low, high) from which an initial state is drawn; a value is both ends.

    Args:
        name: name of the initial state.
        stated_range: a value, or lowest and highest value.

    Raises:
        InputError: it is neither, or low is above high.
    """
    limits = (
        (stated_range, stated_range)
        if isinstance(stated_range, int | float)
        else tuple(stated_range)
    )
    if len(limits) != 2:
        raise InputError(
            f"initial state {name}: expected a value or (low, high), found {stated_range!r}"
        )
    low, high = (_check_number("initial state", name, end) for end in limits)
    if low > high:
        raise InputError(f"initial state {name} = {low:g}:{high:g}: expected low <= high")
    return low, high


def _check_number(label: str, name: str, value: object) -> float:
    """Return a value of the specification as a float if it is a plausible number.

    Args:
        label: Kind of the value in the message of an error, such as "parameter".
        name: Name of the value in that message.
        value: The value.

    Raises:
        InputError: The value is not a number, or not a plausible one.
    """
    if isinstance(value, bool) or not isinstance(value, int | float | np.number):
        raise InputError(f"{label} {name}: expected a number, found {value!r:.60}")
    if not is_plausible_number(value):
        raise InputError(
            f"{label} {name} = {truncate_text(str(value))}: "
            f"expected a finite number within ±{MAX_NUMBER:g}"
        )
    return float(value)
