"""`simgap datasheet`: an explanation and its logs in, one page of a joint or actuator out."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path

from bench.gap.model.world import World
from bench.gap.sheet.drawn import picture, printed
from bench.gap.sheet.facts import Facts
from bench.gap.sheet.mjcf import mjcf
from bench.gap.sheet.page import page
from bench.gap.sheet.quantity import quantities
from bench.gap.sheet.reach import shown
from bench.gap.sheet.subject import Subject, subject_of
from bench.gap.verdict import Verdict
from bench.recordings.filter_start import leave_out_settling
from bench.recordings.pieces import cut
from sims import effects as library
from sims.arguments import check_arguments
from sims.base import InputError, unknown
from sims.extended import Extended
from sims.files import Content, write_all
from sims.recording.recording import Recording
from sims.system import FAMILY, Effect

TRANSMISSION = frozenset({"joint.backlash", "joint.coupling", "joint.flexibility"})
"""Effects between a drive and its joint."""


class DataSheet(Facts):
    """The data sheet of a joint or actuator."""

    @check_arguments
    def write(self, folder: str | Path) -> list[Path]:
        """Write sheet.toml, .html and .pdf, class.xml and models that use it: all or none. The
        folder is made where it is missing.

        Raises:
            InputError: the folder cannot be made or written to.
        """
        import tomli_w

        folder = Path(folder)
        made = mjcf(self, folder)
        drawn = picture(self.diagram) if self.diagram is not None else None
        contents: dict[Path, Content] = {
            folder / "sheet.toml": tomli_w.dumps(self.document()),
            folder / "sheet.html": page(self, drawn, made),
            folder / "sheet.pdf": printed(self),
            **{folder / name: text for name, text in made.contents.items()},
        }
        try:
            folder.mkdir(parents=True, exist_ok=True)
            write_all(contents)
        except OSError as error:
            raise InputError(f"{folder}: cannot be written ({error.strerror})") from None
        return list(contents)


def sheet(
    recording: Recording,
    extended: Extended,
    verdict: Verdict,
    joint: str | None = None,
    name: str | None = None,
) -> DataSheet:
    """The data sheet of a joint or actuator.

    Args:
        recording: the logs, as they were explained.
        extended: what was found in them; its class is known.
        verdict: the same, with its evidence.
        joint: which, of a robot.
        name: on the sheet; None for the joint's or the system's.

    Raises:
        InputError: there is no such joint, or the logs are not of the system.
    """
    kind = extended.kind
    assert kind is not None
    subject = subject_of(kind, joint)
    for channel in extended.observe:
        there = list(recording.runs[0].channels)
        if channel not in there:
            raise unknown(f"channel of {recording.path}", channel, there)
    recording = replace(recording, constants={**extended.constants, **recording.constants})
    recording, _ = leave_out_settling(recording, kind)
    recording, _ = cut(recording, kind)
    is_driven = subject.is_driven(recording)
    asked = tuple(
        name
        for name, effect in (
            (name, library.find(name, kind.system)) for name in absent(subject, extended)
        )
        if (is_driven or not _needs_drive(name, effect)) and not _is_stop(effect)
    )
    candidates = [*extended.effects, *asked]
    engine = None if kind.own_engine else extended.engine
    world = World(kind, recording, recording.training(), engine, candidates=candidates)
    with closing(world):
        # An effect on a channel that nobody recorded shows nowhere.
        there = [
            effect for effect in asked if not world.effects[effect].signal or _seen(world, effect)
        ]
        rows = quantities(subject, extended, verdict, shown(world, extended, there))
    return DataSheet(
        name or subject.joint or kind.name, subject, recording, verdict, extended, rows
    )


def absent(subject: Subject, extended: Extended) -> Iterator[str]:
    """Effects that the model does not have here, without simpler forms of those that it has."""
    own = [
        effect
        for name, numbers in extended.effects.items()
        for effect, _, number in subject.own(name, numbers)
        if number.value != 0
    ]
    has = {*own, *extended.effects}
    effects = {effect.name: effect for effect in subject.effects()}
    simpler = {other for name in own for other in getattr(effects.get(name), "contains", ())}
    for name in effects:
        if name not in has | simpler and name.partition("@")[2] != FAMILY:
            yield name


def _needs_drive(name: str, effect: Effect | type[Effect]) -> bool:
    """Whether an effect is one of a drive or of its transmission."""
    return effect.at == "actuator" or name.partition("@")[0] in TRANSMISSION


def _is_stop(effect: Effect | type[Effect]) -> bool:
    """Whether an effect is a stop: it shows by where it is, and not from some stiffness on."""
    return effect.coefficients[0].of == "stop"


def _seen(world: World, effect: str) -> bool:
    """Whether the signal that an effect acts on was recorded."""
    run = world.runs[0]
    return world.effects[effect].signal in {*run.channels, *run.inputs}
