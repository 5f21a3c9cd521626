"""Python API: `simgap.simulate`, `simgap.read_recording` and `simgap.import_logs`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, TypeAlias

from bench.api.explain import RecordingSource, list_sources
from bench.logs.data_frames import FrameDescription, Units
from bench.logs.importing.log_import import (
    ImportOptions,
    ImportResult,
    describe_logs,
    write_checked_description,
)
from bench.logs.inspection import load_recording
from bench.logs.synthetic_recording import (
    EffectCoefficients,
    SimulatedRecording,
    SimulationSpec,
    simulate_recording,
)
from sims.core.argument_checks import Expected, Name, Names, check_arguments
from sims.core.simulator import InputError
from sims.recording.recording import Recording
from sims.recording.recording_writer import check_absent
from sims.robot.parsing.read_model_file import read_robot

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
Logs: TypeAlias = Annotated[
    str | Path | Sequence[str | Path], Expected("the path of a log, or a list of paths")
]
"""Files of one run, or folders with the files of one run each."""


@check_arguments
def simulate(
    system: Name = "",
    *,
    model: str | Path | None = None,
    actuators: Mapping[str, Any] | None = None,
    parameters: Mapping[str, float] | Sequence[float] | None = None,
    effects: Effects | None = None,
    constants: Mapping[str, float] | None = None,
    noise: float | Mapping[str, float] = 0.0,
    inputs: Mapping[str, InputSignal] | None = None,
    initial: Mapping[str, InitialState] | None = None,
    observe: Names = (),
    runs: int = 4,
    seconds: float = 4.0,
    rate: float = 100.0,
    engine: Name | None = None,
    seed: int = 0,
    held_out: int | None = None,
    force: bool = False,
) -> SimulatedRecording:
    """Simulate a recording with known truth; nothing is written before `write` is called.

    Args:
        system: Registered name of a simulator, e.g. ``pendulum``; empty if a model is given.
        model: A robot's model file, MJCF or URDF.
        actuators: Actuators that the model file lacks, by name, as in a recording's
            ``[actuators.NAME]``.
        parameters: Parameters that differ from their nominal values, by name; or all in order.
        effects: Active effects with one coefficient, several in order, or some by name.
        constants: Constants that differ from the system's defaults.
        noise: Sensor noise, 1 sigma, of every channel or by channel.
        inputs: By name, a constant or the text of a signal, such as ``sine:2:0.5``.
        initial: Initial states by name, a value or (low, high) for a uniform draw in each run.
        observe: Channels to record; empty for the system's default channels.
        runs: Number of runs.
        seconds: Length of a run in seconds.
        rate: Samples per second.
        engine: pybullet, mujoco or batch.
        seed: Seed of all random numbers.
        held_out: Number of final runs that are marked as held out; None for a third of them.
        force: Simulate although it needs more resources than this machine has.

    Raises:
        InputError: An argument is invalid; the message is one line.
    """
    return simulate_recording(
        SimulationSpec(
            system,
            model=model,
            actuators=actuators or {},
            parameters={} if parameters is None else parameters,
            effects=effects or {},
            constants=constants or {},
            noise=noise,
            inputs=inputs or {},
            initial=initial or {},
            observe=tuple(observe),
            runs=runs,
            seconds=seconds,
            rate=rate,
            engine=engine,
            seed=seed,
            held_out=held_out,
            force=force,
        )
    )


@check_arguments
def read_recording(
    path: RecordingSource,
    system: Name | None = None,
    *,
    model: str | Path | None = None,
    units: Units | None = None,
    constants: Mapping[str, float] | None = None,
    description: Mapping[str, Any] | None = None,
) -> Recording:
    """Read and check ``NAME.csv`` with ``NAME.toml`` in the same folder, or a pandas DataFrame.

    The columns of a DataFrame are those of ``NAME.csv``: ``run`` (not needed for a single run),
    ``t`` in seconds, and channels and inputs under their names in the system; a missing sample is
    NaN. ``run`` and ``t`` may be levels of its index.

    Args:
        path: Path of the table, or a DataFrame.
        system: Name of the system, instead of the one that the description states. A DataFrame
            needs this or `model`.
        model: Model file of a robot, MJCF or URDF, instead of the one that the description states.
        units: Units of a DataFrame's columns by name; None for those in ``df.attrs["units"]``.
        constants: Known numbers of the system in SI units, with a DataFrame.
        description: Any other entries about a DataFrame, with the keys of ``NAME.toml``.

    Raises:
        InputError: The recording is malformed; the message is one line.
    """
    about = FrameDescription(
        system=system, model=model, units=units, constants=constants, description=description
    )
    (source,) = list_sources(path, about)
    return load_recording(source, system, model)[0]


@check_arguments
def import_logs(
    logs: Logs,
    model: str | Path,
    out: str | Path,
    *,
    held_out: Names = (),
    rate: float | None = None,
    position_unit: Name = "",
    calibration: str | Path | None = None,
) -> ImportResult:
    """Write a description (TOML) of a robot's raw logs, so that all commands can read them.

    Args:
        logs: Files of one run, or folders with the files of one run each.
        model: Model file of the robot, MJCF or URDF.
        out: Path NAME.toml of a new file.
        held_out: Names of held-out runs; every third one if empty.
        rate: Rate of the rows in Hz, if the logs have no time stamps.
        position_unit: Unit of positions and their commands for which none is stated: ``rad``,
            ``deg``, or ``normalised`` (-100 to 100 of LeRobot); empty to derive it from the joints'
            ranges.
        calibration: Calibration file of LeRobot, by which normalised positions become angles.

    Returns:
        The guesses, the columns that were left out, and what to check.

    Raises:
        InputError: The logs cannot be read or contain nothing of the robot; the message is one
            line, and nothing is written.
    """
    given = [logs] if isinstance(logs, str | Path) else list(logs)
    path = Path(out)
    if path.suffix != ".toml":
        raise InputError(f"expected a description to write, NAME.toml, found '{path}'")
    check_absent([path])
    paths = [Path(log) for log in given]
    file = None if calibration is None else Path(calibration)
    options = ImportOptions(held_out, rate, position_unit, file)
    made = describe_logs(paths, read_robot(Path(model)), Path(model), path.parent, options)
    write_checked_description(path, made.text)
    return made
