"""What was found in a robot, back in the robot's own file: extended.xml, and extended.urdf where it
came from a URDF.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

from sims.extended import Extended, Number

if TYPE_CHECKING:
    from sims.robot.writing import Written


class RobotFiles(NamedTuple):
    """What a robot's own files become.

    Attributes:
        contents: by name.
        said: what they cannot hold, and what is to be known of what they hold, one line each.
        before, after: the text of the user's file, and that of the one in its form.
    """

    contents: Mapping[str, str]
    said: tuple[str, ...] = ()
    before: str = ""
    after: str = ""


def robot_files(extended: Extended) -> RobotFiles:
    """The files of a robot; none for what is no robot.

    They have been loaded again and compared; what would not be as it was meant is left out.
    """
    kind: Any = extended.kind
    if kind is None or not kind.has_model:
        return RobotFiles({})
    from sims.robot.checking import check
    from sims.robot.markup import without_heading
    from sims.robot.writing import written

    causes = causes_of(extended)
    done = written(kind.robot, causes, extended.title)
    try:
        check(kind.robot, causes, done)
    except RuntimeError as error:
        # Minutes of search are not thrown away for a file.
        return RobotFiles({}, (f"no model file is written, by a fault of simgap: {error}",))
    try:
        before = kind.robot.path.read_text(encoding="utf-8", errors="replace")
    except OSError:
        # Gone since it was read: what changes is shown without what was.
        before = ""
    after = done.xml if done.urdf is None else done.urdf
    return RobotFiles(_named(done), done.said, before, without_heading(after or ""))


def _named(done: Written) -> dict[str, str]:
    contents = {"extended.xml": done.xml, "extended.urdf": done.urdf}
    return {name: content for name, content in contents.items() if content is not None}


def causes_of(extended: Extended) -> dict[str, Mapping[str, Number]]:
    """What was fitted to a robot, as coefficients by effect and place: freed numbers of its file,
    effects that were found, and the step and integrator if they are not the file's.
    """
    kind: Any = extended.kind
    causes: dict[str, Mapping[str, Number]] = {}
    for effect in kind.system.freed_effects:
        names = {c.name: f"{effect.name}.{c.name}" for c in effect.coefficients}
        if len(names) == 1:
            names = dict.fromkeys(names, effect.name)
        causes[effect.name] = {c: extended.parameters[name] for c, name in names.items()}
    return {**causes, **extended.effects, **_numerics(kind)}


def _numerics(kind: Any) -> dict[str, Mapping[str, Number]]:
    from sims.robot.numerics import INTEGRATORS, own_numerics

    own, numerics = own_numerics(kind.robot), kind.numerics
    changed: dict[str, Mapping[str, Number]] = {}
    if numerics.timestep != own.timestep:
        changed["numerics.step"] = {"step": Number(numerics.timestep, "s", None, None)}
    if numerics.integrator != own.integrator:
        number = INTEGRATORS[numerics.integrator]
        changed["numerics.integrator"] = {"integrator": Number(number, "1", None, None)}
    return changed
