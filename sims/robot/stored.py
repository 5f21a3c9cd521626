"""The robot that an extended simulator's file names: its model file, what a recording added to it,
and what of it was free.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sims.base import InputError
from sims.robot.friction_form import FRICTION_FORMS, FrictionForm
from sims.user_toml import Source, fault, finite, names, table, text

if TYPE_CHECKING:
    from sims.robot.simulator import RobotSimulator

KEYS = ("model", "digest", "free", "actuators", "engine", "numerics", "friction_form")
"""Keys of extended.toml that describe the robot."""


@dataclass(frozen=True)
class StoredRobot:
    """A robot as a file names it.

    Attributes:
        path: of its model file.
        digest: of all that was read with it; None for whatever the file says now.
        free: numbers of it that are parameters, as ``damping@*``.
        actuators: that a recording added, by name.
        engine: time step and integrator that it stated in place of the file's.
        numerics: ``timestep`` and ``integrator`` other than those, of what was found.
        friction_form: form of the dry friction that effects add (`sims.robot.friction_form`).
    """

    path: Path
    digest: str | None = None
    free: tuple[str, ...] = ()
    actuators: Mapping[str, Any] = field(default_factory=dict)
    engine: Mapping[str, Any] = field(default_factory=dict)
    numerics: Mapping[str, Any] = field(default_factory=dict)
    friction_form: FrictionForm = "stiff"

    def document(self, folder: Path | None) -> dict[str, Any]:
        """As TOML in a file of this folder; the model file is named alone where there is none."""
        where = self.path.name if folder is None else _from(folder, self.path)
        document = {key: value for key, value in asdict(self).items() if value and key in KEYS}
        # A file without the key means stiff friction, as files of earlier versions do.
        if self.friction_form == "stiff":
            del document["friction_form"]
        free = {"free": list(self.free)} if self.free else {}
        return {"model": where, **document, **free}

    def simulator(self) -> type[RobotSimulator]:
        """Its simulator.

        Raises:
            InputError: the model file is missing, cannot be read or has changed.
        """
        # Loaded here alone: most simulators have nothing to do with robots.
        from sims.robot.numerics import Numerics, own_numerics
        from sims.robot.reading import read
        from sims.robot.simulator import robot_simulator

        robot = read(self.path, actuators=self.actuators, engine=self.engine)
        if self.digest is not None and robot.digest != self.digest:
            remedy = "put that one back, or explain the recording anew"
            raise InputError(f"model file {self.path} is not the one that was fitted; {remedy}")
        numerics = Numerics(**{**own_numerics(robot)._asdict(), **self.numerics})
        return robot_simulator(robot.with_friction_form(self.friction_form), self.free, numerics)


def of(kind: type[RobotSimulator]) -> StoredRobot:
    """What a file has to name for a robot's simulator."""
    from sims.robot.numerics import own_numerics

    robot = kind.robot
    differs = kind.numerics != own_numerics(robot)
    return StoredRobot(
        Path(robot.path).resolve(),
        robot.digest,
        kind.free,
        robot.actuator_tables,
        robot.engine_table,
        kind.numerics._asdict() if differs else {},
        robot.friction_form,
    )


def _from(folder: Path, path: Path) -> str:
    """A path as seen from a folder, where the two lie in one tree; else as it is."""
    folder, path = folder.resolve(), path.resolve()
    common = Path(os.path.commonpath([folder, path])) if folder.drive == path.drive else None
    # The way by the root of a file system is good in no other place than this one.
    if common is None or common == Path(common.anchor):
        return str(path)
    return Path(os.path.relpath(path, folder)).as_posix()


def read_stored(source: Path, document: Mapping[str, Any]) -> StoredRobot:
    """What a file says of a robot.

    Args:
        source: the file; its model file is named from its folder.
        document: its tables.

    Raises:
        InputError: something is malformed.
    """
    if "system" in document:
        raise InputError(f"{source}: expected system or model, found both; leave one out")
    digest = document.get("digest")
    return StoredRobot(
        source.parent / text(source, "model", document["model"]),
        None if digest is None else text(source, "digest", digest),
        names(source, "free", document.get("free", []), "a list of names"),
        table(source, "actuators", document.get("actuators", {})),
        table(source, "engine", document.get("engine", {})),
        _numerics(source, document.get("numerics", {})),
        _friction_form(source, document.get("friction_form", "stiff")),
    )


def _friction_form(source: Source, value: Any) -> FrictionForm:
    """Check the value of ``friction_form``."""
    for form in FRICTION_FORMS:
        if value == form:
            return form
    raise fault(source, "friction_form", " or ".join(FRICTION_FORMS), value)


def _numerics(source: Source, value: Any) -> dict[str, Any]:
    """``[numerics]``: a step in s, and an integrator of MuJoCo's."""
    from sims.robot.numerics import INTEGRATORS

    given = table(source, "numerics", value)
    for key, entry in given.items():
        where = f"numerics.{key}"
        if key == "timestep":
            given[key] = finite(source, where, entry)
            if given[key] <= 0:
                raise fault(source, where, "more than 0 s", entry)
        elif key != "integrator" or entry not in INTEGRATORS:
            wanted = f"timestep, or integrator = {' | '.join(INTEGRATORS)}"
            raise fault(source, where, wanted, entry)
    return given
