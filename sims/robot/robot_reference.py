"""Reference to a robot in the file of an extended simulator.

It contains the model file, the additions of the recording, and the free parameters.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sims.core.simulator import InputError
from sims.core.toml_validation import (
    Source,
    check_finite,
    check_name_list,
    check_table,
    check_text,
    get_subtable,
    make_error,
)

if TYPE_CHECKING:
    from sims.robot.robot_model import FrictionForm
    from sims.robot.robot_simulator import RobotSimulator

ROBOT_KEYS = ("model", "digest", "free", "actuators", "engine", "numerics", "friction_form")
"""Keys of extended.toml that describe the robot."""


@dataclass(frozen=True)
class RobotReference:
    """Reference to a robot, as stored in extended.toml.

    Attributes:
        path: path of the model file.
        digest: digest of the model file and everything that was read with it; None accepts any
            content.
        free: numbers of the model file that are free parameters, such as ``damping@*``.
        actuators: actuators that a recording added, by name.
        engine: time step and integrator of the recording that replace those of the model file.
        numerics: options that differ from those, such as ``timestep``; found by explain.
        friction_form: form of the dry friction that effects add (`sims.robot.robot_model`).
    """

    path: Path
    digest: str | None = None
    free: tuple[str, ...] = ()
    actuators: Mapping[str, Any] = field(default_factory=dict)
    engine: Mapping[str, Any] = field(default_factory=dict)
    numerics: Mapping[str, Any] = field(default_factory=dict)
    friction_form: FrictionForm = "stiff"

    def to_document(self, folder: Path | None) -> dict[str, Any]:
        """Return the reference as a TOML document of a file in a folder.

        Args:
            folder: folder of the TOML file; None stores the model file's name without a folder.

        Returns:
            Entries of the file, of which `ROBOT_KEYS` are all possible keys.
        """
        model_path = self.path.name if folder is None else _make_relative_path(folder, self.path)
        # Empty entries are left out.
        document = {
            key: value for key, value in asdict(self).items() if value and key in ROBOT_KEYS
        }
        # A file without the key means stiff friction, as files of earlier versions do.
        if self.friction_form == "stiff":
            del document["friction_form"]
        # TOML has lists, and no tuples.
        free = {"free": list(self.free)} if self.free else {}
        return {"model": model_path, **document, **free}

    def make_simulator(self) -> type[RobotSimulator]:
        """Make the simulator of the robot.

        The file is read again, and its digest must be that of the file to which the causes
        were fitted.

        Raises:
            InputError: the model file is missing, cannot be read or has changed.
        """
        # These modules are imported lazily, since most simulators do not need robots.
        from sims.robot.integrator_settings import parse_option, read_integrator_settings
        from sims.robot.parsing.read_model_file import read_robot
        from sims.robot.robot_simulator import make_robot_simulator

        robot = read_robot(self.path, actuators=self.actuators, engine=self.engine)
        if self.digest is not None and robot.digest != self.digest:
            remedy = "restore that file, or explain the recording again"
            raise InputError(f"model file {self.path} is not the one that was fitted; {remedy}")
        numerics = read_integrator_settings(robot).replace_options(
            {name: parse_option(name, value) for name, value in self.numerics.items()}
        )
        return make_robot_simulator(
            robot.with_friction_form(self.friction_form), self.free, numerics
        )


def make_robot_reference(kind: type[RobotSimulator]) -> RobotReference:
    """Make the reference with which an extended simulator finds and checks its robot again.

    Numerical settings (time step, integrator, options of the solver) are stated only if any of them
    differs from the model file.

    Args:
        kind: simulator class of the robot.
    """
    from sims.robot.integrator_settings import read_integrator_settings

    robot = kind.robot
    differs = kind.numerics != read_integrator_settings(robot)
    return RobotReference(
        path=Path(robot.path).resolve(),
        digest=robot.digest,
        free=kind.free,
        actuators=robot.actuator_tables,
        engine=robot.engine_table,
        numerics=kind.numerics.to_document() if differs else {},
        friction_form=robot.friction_form,
    )


def _make_relative_path(folder: Path, path: Path) -> str:
    """Return a path relative to a folder if they share a folder, else the absolute path.

    Args:
        folder: folder to which the path is relative.
        path: path of the model file.
    """
    folder, path = folder.resolve(), path.resolve()
    # Paths on different drives of Windows have nothing in common.
    common = Path(os.path.commonpath([folder, path])) if folder.drive == path.drive else None
    # A relative path through the root of a file system would be valid on this machine only.
    if common is None or common == Path(common.anchor):
        return str(path)
    return Path(os.path.relpath(path, folder)).as_posix()


def read_robot_reference(source: Path, document: Mapping[str, Any]) -> RobotReference:
    """Read a robot reference (model file, settings and fitted numbers) from a file's document.

    Args:
        source: the file; the path of the model file is relative to its folder.
        document: content of the file.

    Raises:
        InputError: the document is malformed.
    """
    if "system" in document:
        raise InputError(f"{source}: expected system or model, found both; leave one out")
    # Other descriptions are read without the modules of robots.
    from sims.robot.robot_model import FRICTION_FORMS

    digest = document.get("digest")
    friction_form = document.get("friction_form", "stiff")
    if friction_form not in FRICTION_FORMS:
        raise make_error(source, "friction_form", " or ".join(FRICTION_FORMS), friction_form)
    return RobotReference(
        source.parent / check_text(source, "model", document["model"]),
        None if digest is None else check_text(source, "digest", digest),
        check_name_list(source, "free", document.get("free", []), "a list of names"),
        get_subtable(source, document, "actuators"),
        get_subtable(source, document, "engine"),
        _check_numerics(source, document.get("numerics", {})),
        friction_form,
    )


def _check_numerics(source: Source, value: Any) -> dict[str, Any]:
    """Check the table ``[numerics]``: a time step in seconds, and options of MuJoCo's solver.

    Args:
        source: the file, for messages.
        value: the table.

    Returns:
        The entries. Words such as an integrator's name stay words; numbers of iterations become
        integers.

    Raises:
        InputError: an entry is unknown, has the wrong type or is out of range.
    """
    from sims.robot.integrator_settings import OPTION_EFFECTS, OPTION_WORDS

    settings = check_table(source, "numerics", value)
    for key, option_value in settings.items():
        entry_name = f"numerics.{key}"
        if key == "timestep":
            settings[key] = check_finite(source, entry_name, option_value)
            if settings[key] <= 0:
                raise make_error(source, entry_name, "more than 0 s", option_value)
        elif key in OPTION_WORDS:
            if option_value not in OPTION_WORDS[key]:
                raise make_error(source, entry_name, " | ".join(OPTION_WORDS[key]), option_value)
        elif key in OPTION_EFFECTS.values():
            settings[key] = check_finite(source, entry_name, option_value)
            if settings[key] < 0:
                raise make_error(source, entry_name, "at least 0", option_value)
            if key != "impratio":
                settings[key] = int(settings[key])
        else:
            expectation = f"one of {', '.join(OPTION_EFFECTS.values())}"
            raise make_error(source, entry_name, expectation, option_value)
    return settings
