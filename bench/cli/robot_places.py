"""Text and JSON of `simgap list places`: places of a robot, and effects that can act there."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import cast

from bench.cli.output import JsonDocument
from bench.core.plugin_registries import make_robot_simulator
from bench.logs.recording_summary import format_robot_summary
from sims import effects
from sims.core.plain_values import append_unit, format_unit
from sims.robot.robot_model import RobotModel
from sims.robot.robot_simulator import RobotSimulator
from sims.robot.robot_system import RobotSystem


def format_places(model: Path) -> Iterator[str]:
    """Yield lines about a model file's places and signals, and the effects that can act there."""
    kind = cast(type[RobotSimulator], make_robot_simulator(model))
    yield from format_robot_summary(kind)
    yield from _format_joints(kind.robot)
    yield from _format_actuators(kind)
    for body in kind.robot.bodies:
        links = f", with {', '.join(body.aliases)}" if body.aliases else ""
        yield f"  {'body':9} {body.name:24} {body.mass:.4g} kg{links}"
    for signal in kind.inputs:
        yield f"  {'input':9} {signal.name:24} {format_unit(signal.unit)}"
    for channel in kind.channels:
        yield f"  {'channel':9} {channel.name:24} {format_unit(channel.unit):9} {channel.says}"
    yield from _format_effects_by_place(kind.system)
    yield f"  --free also takes MuJoCo's words: {', '.join(kind.system.list_mujoco_words())}"


def list_places(model: Path) -> JsonDocument:
    """Build the JSON document of the places of a model file."""
    kind = cast(type[RobotSimulator], make_robot_simulator(model))
    effects_by_kind = list_effects_by_place_kind(kind.system)
    return {
        "model": model,
        "about": list(format_robot_summary(kind)),
        "joints": [
            {
                "name": joint.name,
                "kind": joint.kind,
                "range": joint.range,
                "unit": joint.unit,
                "effort": joint.effort,
                "effort_unit": joint.force_unit,
            }
            for joint in kind.robot.joints
        ],
        "actuators": [
            {"name": a.name, "kind": a.kind, "joint": a.joint, "range": a.range, "force": a.force}
            for a in kind.robot.actuators
        ],
        "bodies": [
            {"name": body.name, "mass": body.mass, "aliases": body.aliases}
            for body in kind.robot.bodies
        ],
        "inputs": [{"name": c.name, "unit": c.unit} for c in kind.inputs],
        "channels": [{"name": c.name, "unit": c.unit, "says": c.says} for c in kind.channels],
        "effects": effects_by_kind,
        "free": list(kind.system.list_mujoco_words()),
    }


def _format_joints(robot: RobotModel) -> Iterator[str]:
    """Yield a line for each joint of a robot: kind, and range of motion and effort if limited."""
    for joint in robot.joints:
        limits = "" if joint.range is None else _format_range(joint.range, joint.unit)
        effort = (
            ""
            if joint.effort is None
            else append_unit(f", effort {joint.effort:g}", joint.force_unit)
        )
        yield f"  {'joint':9} {joint.name:24} {joint.kind}{limits}{effort}"


def _format_actuators(kind: type[RobotSimulator]) -> Iterator[str]:
    """Yield a line for each actuator of a robot: kind, the driven joint and the control range."""
    units = {channel.name: channel.unit for channel in kind.inputs}
    for a in kind.robot.actuators:
        limits = "" if a.range is None else _format_range(a.range, units.get(f"u.{a.name}", ""))
        yield f"  {'actuator':9} {a.name:24} {a.kind} on {a.joint or 'no joint'}{limits}"


def _format_range(limits: tuple[float, float], unit: str) -> str:
    return append_unit(f", {limits[0]:.4g} to {limits[1]:.4g}", unit)


def _format_effects_by_place(system: type[RobotSystem]) -> Iterator[str]:
    """Yield a line for each kind of place with the effects that can act there."""
    for kind, names in list_effects_by_place_kind(system).items():
        location = "of the world" if kind == "world" else f"at a {kind}, as {names[0]}@NAME or @*"
        yield f"  effects {location.replace('a actuator', 'an actuator')}: {', '.join(names)}"


def list_effects_by_place_kind(system: type[RobotSystem]) -> dict[str, list[str]]:
    """Return the names of effects that can act on a robot, by the kind of their places."""
    names_by_kind: dict[str, list[str]] = {}
    for name in effects.list_names():
        effect = effects.get_effect(name)
        if system.placed(effect):
            names_by_kind.setdefault(effect.at, []).append(name)
    return names_by_kind
