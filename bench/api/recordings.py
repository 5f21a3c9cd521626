"""`simgap.simulate`, `simgap.read_recording` and `simgap.import_logs`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, TypeAlias

from bench.api.explain import Source, Units, sources_of
from bench.recordings.frames import FrameDescription
from bench.recordings.importing import Imported, ImportOptions, checked, describe
from bench.recordings.inspection import load
from bench.recordings.simulate import Coefficients, SimulatedRecording, Wish, make
from sims.arguments import Expected, Name, Names, check_arguments
from sims.base import InputError
from sims.recording.recording import Recording
from sims.recording.write import refuse_existing
from sims.robot.reading import read

Effects: TypeAlias = Annotated[
    Mapping[str, Coefficients],
    Expected("coefficients by the names of effects, as {'drag.linear': 2e-4}"),
]
"""Effects that act."""
InputSignal: TypeAlias = Annotated[
    float | str, Expected("a number or the text of a signal, as 'sine:2:0.5'")
]
"""What is put in."""
InitialState: TypeAlias = Annotated[
    float | tuple[float, float], Expected("a number or (low, high)")
]
"""Where each run begins, or the range from which it is drawn."""
Logs: TypeAlias = Annotated[
    str | Path | Sequence[str | Path], Expected("the path of a log, or a list of paths")
]
"""Files of one run, or folders that each hold those of one."""


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
    """Simulate a recording whose truth is known; nothing is written before `write` is called.

    Args:
        system: registered name of a simulator, e.g. ``pendulum``; empty where there is a model.
        model: a robot's model file, MJCF or URDF.
        actuators: that the model file lacks, by name, as in a recording's ``[actuators.NAME]``.
        parameters: other than their nominal values, by name; or all of them in order.
        effects: that act, with a coefficient, several in order, or some by name.
        constants: other than the system's defaults.
        noise: sensor noise, 1 sigma, of every channel or by channel.
        inputs: by name, a constant or the text of a signal, as ``sine:2:0.5``.
        initial: initial states by name, a value or (low, high) from which each run draws.
        observe: channels to record; the system's usual ones where empty.
        runs: number of runs.
        seconds: length of a run.
        rate: samples a second.
        engine: pybullet, mujoco or batch.
        seed: of all that is drawn.
        held_out: how many of the last runs are marked as held out; a third where None.
        force: make it although it needs more than this machine has.

    Raises:
        InputError: something that cannot be, in one line.
    """
    return make(
        Wish(
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
    path: Source,
    system: Name | None = None,
    *,
    model: str | Path | None = None,
    units: Units | None = None,
    constants: Mapping[str, float] | None = None,
    description: Mapping[str, Any] | None = None,
) -> Recording:
    """Read and check ``NAME.csv`` with ``NAME.toml`` beside it, or a pandas DataFrame.

    The columns of a DataFrame are those of ``NAME.csv``: ``run`` (not needed for a single run),
    ``t`` in seconds, and channels and inputs under their names in the system; a missing sample is
    NaN. ``run`` and ``t`` may be levels of its index.

    Args:
        path: the table, or a DataFrame.
        system: name of the system, in place of the one that the description states. A DataFrame
            needs this or `model`.
        model: model file of a robot, MJCF or URDF, in place of what the description states.
        units: of a DataFrame's columns by name; those in ``df.attrs["units"]`` without.
        constants: known numbers of the system in SI units, with a DataFrame.
        description: anything else about a DataFrame, with the keys of ``NAME.toml``.

    Raises:
        InputError: anything malformed, in one line.
    """
    about = FrameDescription(system, model, units or {}, constants or {}, description or {})
    (source,) = sources_of(path, about)
    return load(source, system, model)[0]


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
) -> Imported:
    """Describe a robot's logs as they lie: write the toml by which every command reads them.

    Args:
        logs: files of one run, or folders that each hold those of one.
        model: what they are of, MJCF or URDF.
        out: NAME.toml, a new file.
        held_out: runs that no fit is to see; every third one without.
        rate: of the rows, Hz, where the logs have no stamps.
        position_unit: of positions and their commands that state none: ``rad``, ``deg``, or
            ``normalised`` (-100 to 100 of LeRobot); told from the joints' ranges without.
        calibration: calibration file of LeRobot, by which normalised positions become angles.

    Returns:
        What was guessed, what could not be told, and what to check.

    Raises:
        InputError: the logs cannot be read or nothing in them is the robot's, in one line; then
            nothing is written.
    """
    given = [logs] if isinstance(logs, str | Path) else list(logs)
    path = Path(out)
    if path.suffix != ".toml":
        raise InputError(f"expected a description to write, NAME.toml, found '{path}'")
    refuse_existing([path])
    paths = [Path(log) for log in given]
    file = None if calibration is None else Path(calibration)
    options = ImportOptions(held_out, rate, position_unit, file)
    made = describe(paths, read(Path(model)), Path(model), path.parent, options)
    checked(path, made.text)
    return made
