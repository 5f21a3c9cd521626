"""Recordings in pandas data frames, for registered systems and for robots."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, TypeAlias

from bench.core.plugin_registries import make_robot_simulator, simulators
from sims.core.argument_checks import Expected, Name
from sims.core.simulator import InputError, Simulator
from sims.core.toml_validation import check_table
from sims.recording.recording import Recording, recording_of_frame
from sims.recording.recording_description import model_in
from sims.recording.recording_frame import Frame

Units: TypeAlias = Annotated[
    Mapping[str, str], Expected("units of columns by their names, as {'q': 'rad'}")
]
"""Units of a data frame's columns, by column name."""


@dataclass(frozen=True, kw_only=True)
class FrameDescription:
    """System of a recording, and the description of a data frame, which has no `NAME.toml` file.

    Attributes:
        system: Name of the system, instead of the one that the .toml file states.
        model: Model file of a robot, MJCF or URDF, instead of what the .toml file states.
        units: Units of a DataFrame's columns by name (default: those in ``df.attrs["units"]``).
        constants: Known numbers of the system in SI units, with a DataFrame.
        description: Any further entries about a DataFrame, with the keys of ``NAME.toml``.
    """

    system: Name | None = None
    model: str | Path | None = None
    units: Units | None = None
    constants: Mapping[str, float] | None = None
    description: Mapping[str, Any] | None = None

    def refuse_for_files(self, recording: object) -> None:
        """Reject a description of a data frame if the recording is not a data frame.

        Raises:
            InputError: units, constants or a description are given.
        """
        for name in ("units", "constants", "description"):
            if getattr(self, name):
                raise InputError(
                    f"{name}: expected only with a DataFrame; {recording} has a description "
                    "that states them"
                )


def read_frame_recording(
    frame: Frame, frame_description: FrameDescription, name: str = "DataFrame"
) -> Recording:
    """Read the recording in a data frame; only runs that are marked so are held out.

    Args:
        frame: Columns ``run`` (if there are several), ``t`` and one for each channel and input.
        frame_description: Description by the user.
        name: Name of the recording in messages.

    Raises:
        InputError: The data frame or its description is malformed; the message is one line.
    """
    meta = dict(frame_description.description or {})
    if frame_description.system is not None:
        meta.pop("model", None)
        meta["system"] = frame_description.system
    if frame_description.model is not None:
        meta.pop("system", None)
        meta["model"] = str(frame_description.model)
    if frame_description.constants:
        stated_constants = check_table(name, "constants", meta.get("constants", {}))
        meta["constants"] = {**stated_constants, **frame_description.constants}
    kind = _get_simulator_class(name, meta)
    meta.setdefault("title", f"{kind.name}, {name}")
    return recording_of_frame(frame, kind, meta, frame_description.units or {}, name)


def _get_simulator_class(name: str, meta: Mapping[str, Any]) -> type[Simulator]:
    """Return the simulator class of the system or robot model that a description names.

    Raises:
        InputError: It names neither, or an unknown system.
    """
    file = model_in(Path(name), meta)
    if file is not None:
        return make_robot_simulator(file.path, file.actuators, file.engine, file.free)
    system = meta.get("system")
    if not isinstance(system, str):
        raise InputError(
            f"{name}: expected a system or model: system='NAME' or model='robot.xml'; "
            f"systems are {', '.join(simulators.names())}"
        )
    try:
        return simulators.get(system)
    except InputError as error:
        raise InputError(f"{name}: {error}") from None
