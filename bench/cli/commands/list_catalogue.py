"""The commands `simgap list` and `simgap schema`, and the catalogue that they print.

It lists commands with their options, tuners, simulators, systems, effects, diagnosers, experiments,
references and schemas, as documents and as text, and the places of a robot.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from bench.cli.output import EXIT_CODES, CommandResult, JsonDocument, PrintLine, format_json
from bench.cli.shared_options import add_plugin_option, get_subparsers, parse_path
from sims.core.user_messages import append_unit, format_unit

if TYPE_CHECKING:
    from sims.robot.robot_simulator import RobotSimulator

_LISTS = (
    "tuners", "simulators", "systems", "effects", "diagnosers", "experiments", "references",
    "schemas", "commands", "places",
)  # fmt: skip


def add_list_arguments(listing: argparse.ArgumentParser) -> None:
    """Add the options of `simgap list`."""
    listing.add_argument(
        "what",
        choices=_LISTS,
        nargs="?",
        help="which list (default, with --json: all but the last)",
    )
    listing.add_argument(
        "--model",
        type=parse_path,
        metavar="FILE",
        help="model file (MJCF or URDF) whose places are listed",
    )
    add_plugin_option(listing, "entries")
    listing.set_defaults(command=_run_list)


def add_schema_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `simgap schema`."""
    parser.add_argument("name", metavar="NAME", help="a command, or see `simgap list schemas`")
    parser.set_defaults(command=_run_schema)


def _run_list(options: argparse.Namespace, print_line: PrintLine) -> CommandResult:
    """Execute `simgap list`: print one section of the catalogue, or the places of a robot.

    Args:
        options: parsed arguments of the command; `what` is the section, None for all of them, which
            needs ``--json``. `model` is the robot's model file, for the section places only.
        print_line: prints one line of text.

    Returns:
        The JSON document of the command, and its exit code (0).
    """
    from bench.cli.main import build_parser
    from bench.core.plugin_registries import load_plugins
    from sims.core.simulator import InputError

    load_plugins(options.plugin)
    if (options.what == "places") != (options.model is not None):
        raise InputError("list places and --model FILE go together")
    if options.model is not None:
        places = list_places(options.model)
        for line in format_places(places):
            print_line(line)
        return CommandResult({"places": places})
    if options.what is None:
        if not options.json:
            raise InputError(f"expected one of {', '.join(_LISTS)}; with --json all are listed")
        return CommandResult(build_catalogue(build_parser()))
    if options.what == "commands":
        documents = list_commands(build_parser())
    else:
        documents = CATALOGUE_SECTIONS[options.what]()
    for line in format_documents(options.what, documents):
        print_line(line)
    return CommandResult({options.what: documents})


def _run_schema(options: argparse.Namespace, print_line: PrintLine) -> CommandResult:
    """Execute `simgap schema`: print the JSON schema of a document that simgap writes."""
    from bench.schemas import load_schema

    schema = load_schema(options.name)
    print_line(format_json(schema))
    return CommandResult(schema)


_OPTION_TYPES = {
    "_StoreTrueAction": "flag",
    "parse_positive_int": "whole number",
    "parse_non_negative_int": "whole number",
    "int": "whole number",
    "float": "number",
    "parse_seconds": "number",
    "parse_path": "path",
    "parse_file_name": "path",
}
"""Type of an option's value, by the function that parses it or the class of argparse's action."""


def build_catalogue(parser: argparse.ArgumentParser) -> JsonDocument:
    """Build the whole catalogue from the parser of the command line."""
    return {
        "commands": list_commands(parser),
        **{name: list_section() for name, list_section in CATALOGUE_SECTIONS.items()},
    }


def list_commands(parser: argparse.ArgumentParser) -> list[JsonDocument]:
    """List every command with its options, as `simgap --help` does.

    Args:
        parser: Parser of the whole command line, with a subparser for each command.

    Returns:
        One JSON document per command: name, help text, schema of its output, exit codes and
        options.
    """
    subparsers = get_subparsers(parser)
    summaries = {action.dest: action.help for action in subparsers._choices_actions}
    return [
        {
            "name": name,
            "says": summaries[name],
            "schema": name,
            "exit_codes": list(EXIT_CODES),
            "options": [
                _describe_option(action)
                for action in command._actions
                if not isinstance(action, argparse._HelpAction)
            ],
        }
        for name, command in subparsers.choices.items()
    ]


def _describe_option(action: argparse.Action) -> JsonDocument:
    """Describe an argument or option of a command by plain values, for `simgap list commands`.

    Args:
        action: Argument or option as argparse stores it.

    Returns:
        Its flags, type, choices, default value and help text, by name.
    """
    default = None if action.default in ([], "") else action.default
    type_name = getattr(action.type, "__name__", "")
    # An option without a value has no type, but a class of action of its own.
    flag = _OPTION_TYPES.get(type(action).__name__)
    return {
        "name": action.dest,
        "flags": list(action.option_strings),
        "metavar": action.metavar or action.dest.upper(),
        "type": flag or _OPTION_TYPES.get(type_name, "text"),
        "choices": list(action.choices) if action.choices else None,
        "default": default,
        "required": action.required,
        "several": action.nargs in ("+", "*"),
        "repeatable": isinstance(action, argparse._AppendAction | argparse._ExtendAction),
        # argparse formats help texts, in which %% is a per cent sign.
        "says": (action.help or "").replace("%%", "%"),
    }


def _describe_system(kind: Any) -> JsonDocument:
    """Return what a system declares: parameters, constants, inputs, states and observed channels.

    `kind` is the class of the system; a parameter has its bounds, its training range and its unit.
    """
    return {
        "parameters": [
            _pick(parameter, "name", "unit", "nominal", "bounds", "training", "log", "says")
            for parameter in kind.parameters
        ],
        "constants": [
            _pick(constant, "name", "unit", "value", "says") for constant in kind.constants
        ],
        "inputs": _describe_channels(kind.inputs),
        "states": [{"name": name, "value": value} for name, value in kind.states.items()],
        "channels": _describe_channels(kind.channels),
    }


def _describe_channels(channels: Iterable[Any]) -> list[JsonDocument]:
    return [_pick(c, "name", "unit", "says") for c in channels]


def _pick(part: Any, *names: str) -> JsonDocument:
    """Return some attributes of an object by name."""
    return {name: getattr(part, name) for name in names}


def _describe_effect_properties(effect: Any) -> JsonDocument:
    """Return the properties of one effect: how it acts, and the range of each of its coefficients.

    A coefficient has an entry in ``on`` for each kind of system to which it can be applied, because
    its unit and plausible range depend on the kind: a point mass, a linear or a rotary coordinate.
    """
    from sims.core.system import SYSTEM_KINDS

    coefficients = []
    for coefficient in effect.coefficients:
        applications = []
        for kind in SYSTEM_KINDS:
            # Without a unit, the coefficient does not exist on this kind of system.
            if (unit := coefficient.unit(kind)) is not None:
                low, high = coefficient.range(kind)
                applications.append({"kind": kind, "unit": unit, "low": low, "high": high})
        coefficients.append({"name": coefficient.name, "on": applications})
    return {
        **_pick(effect, "noun", "hook"),
        "places": getattr(effect, "at", None),
        "needs": effect.needs,
        "contains": list(effect.contains),
        "source": effect.source,
        "coefficients": coefficients,
    }


def list_experiments() -> list[JsonDocument]:
    """List every experiment of the project, and what is missing for it on this machine.

    Returns:
        One document per experiment; `skipped` and `needs` say what is missing here,
        `tuners_skipped` which tuners cannot run.
    """
    from bench.benchmark.problem import experiment_config
    from bench.benchmark.problem.missing_requirements import availability

    documents = []
    for name in experiment_config.list_experiment_names():
        listed = experiment_config.load_experiment(name)
        missing = availability(listed)
        documents.append(
            {
                **_pick(listed, "name", "says"),
                "skipped": missing.skipped or None,
                "needs": missing.data_set.command if missing.data_set else None,
                **_pick(listed, "title", "tags", "simulator"),
                "model": listed.model or None,
                **_pick(listed, "ranges", "targets", "budget"),
                "tuners": [asdict(entry)["label"] for entry in listed.tuners],
                "tuners_skipped": dict(missing.tuners),
            }
        )
    return documents


def list_references() -> list[JsonDocument]:
    """List every reference result that `simgap plot --behind NAME` draws.

    A reference result is a stored comparison that figures draw in grey behind a new one.
    """
    from bench.benchmark.storage.reference_results import find_reference, list_reference_names

    return [
        {
            "name": reference.name,
            "says": reference.document.get("title") or reference.document.get("says", ""),
            "simgap": reference.simgap,
            "revision": reference.revision or None,
            "started": reference.started,
            "budget": reference.document.get("budget"),
            "targets": reference.document.get("targets"),
            "tuners": reference.tuners,
        }
        for reference in map(find_reference, list_reference_names())
    ]


def list_schemas() -> list[JsonDocument]:
    """List every schema that `simgap schema NAME` prints."""
    from bench.schemas import list_schema_names, load_schema

    return [{"name": name, "says": load_schema(name)["title"]} for name in list_schema_names()]


def _describe_tuner(kind: Any) -> JsonDocument:
    """Return the properties of a tuner: whether it learns, and uses random numbers; its needs."""
    return {
        "learned": bool(kind.learned),
        "stochastic": bool(kind.stochastic),
        "requires": list(getattr(kind, "requires", ())),
    }


_PARTS: Mapping[str, tuple[str, Callable[[Any], JsonDocument]]] = {
    "tuners": ("tuners", _describe_tuner),
    "simulators": ("simulators", lambda _: {}),
    # A system is a simulator with its declared numbers, states and signals.
    "systems": ("simulators", _describe_system),
    "effects": ("effects", _describe_effect_properties),
    "diagnosers": (
        "diagnosers",
        lambda kind: {"learned": bool(kind.learned), "requires": list(kind.requires)},
    ),
}
"""Registry of the parts of a section, and the function that describes the class of a part."""


def list_parts(section: str) -> list[JsonDocument]:
    """List the registered parts of a section, each with the reason if it cannot be used here."""
    from bench.core import plugin_registries

    registry_name, describe_kind = _PARTS[section]
    registry = getattr(plugin_registries, registry_name)
    documents = []
    for name in registry.names():
        try:
            kind = registry.get(name)
        except plugin_registries.PartUnavailableError as error:
            documents.append({"name": name, "says": None, "skipped": error.reason})
            continue
        properties = {"says": registry.describe(name), "skipped": None, **describe_kind(kind)}
        documents.append({"name": name, **properties})
    return documents


CATALOGUE_SECTIONS: dict[str, Callable[[], list[JsonDocument]]] = {
    **{section: partial(list_parts, section) for section in _PARTS},
    "experiments": list_experiments,
    "references": list_references,
    "schemas": list_schemas,
}
"""Sections of the catalogue in addition to commands and places of a robot, by name."""


def format_documents(section: str, documents: list[JsonDocument]) -> list[str]:
    """Format given documents of a section of the catalogue."""
    format_entry = _LAID_OUT.get(section, _format_plain_entry)
    return [line for document in documents for line in format_entry(document)]


def _format_plain_entry(entry: JsonDocument) -> list[str]:
    return [f"{entry['name']:18} {_format_sentence(entry)}"]


def _format_sentence(entry: JsonDocument) -> str:
    """Return the description of an entry, or why it cannot be used here."""
    skipped = entry.get("skipped")
    return f"skipped: {skipped}" if skipped else entry["says"]


def _format_experiment(experiment: JsonDocument) -> list[str]:
    """Format an experiment: what is missing on this machine, its description, its tags.

    Args:
        experiment: Document of `list_experiments`.
    """
    missing = []
    # An experiment that cannot run at all does not list its tuners that cannot.
    if experiment["skipped"]:
        missing.append(f"skipped: {experiment['skipped']}")
    if experiment["needs"]:
        missing.append(f"needs `{experiment['needs']}`")
    if experiment["tuners_skipped"] and not experiment["skipped"]:
        reasons = "; ".join(sorted(set(experiment["tuners_skipped"].values())))
        missing.append(f"without {', '.join(experiment['tuners_skipped'])}: {reasons}")
    text = f"{'; '.join(missing)}. {experiment['says']}" if missing else experiment["says"]
    return [f"{experiment['name']:22} {text} [{', '.join(experiment['tags'])}]"]


def _format_system(system: JsonDocument) -> list[str]:
    """Format a system: its description, then a line for each of its declared quantities.

    Args:
        system: Document of one simulator, with parameters, constants, inputs, states and channels.
    """
    lines = [f"{system['name']}: {_format_sentence(system)}"]
    if system["skipped"]:
        return lines
    for parameter in system["parameters"]:
        low, high = parameter["bounds"]
        training_text = ""
        if parameter["training"]:
            training_low, training_high = parameter["training"]
            training_text = f", training {training_low:g} to {training_high:g}"
        lines.append(
            f"  parameter {parameter['name']:18} {parameter['unit']:12} "
            f"{low:g} to {high:g}{training_text}; "
            f"nominal {parameter['nominal']:g}  {parameter['says']}"
        )
    lines += [
        f"  constant  {constant['name']:18} {constant['unit']:12} {constant['value']:g}  "
        f"{constant['says']}"
        for constant in system["constants"]
    ]
    lines += _format_channels("input", system["inputs"])
    lines += [f"  state     {state['name']:18} {state['value']:>12g}" for state in system["states"]]
    return lines + _format_channels("channel", system["channels"])


def _format_channels(role: str, channels: list[JsonDocument]) -> list[str]:
    return [f"  {role:9} {c['name']:18} {c['unit']:12} {c['says']}".rstrip() for c in channels]


def _format_effect(effect: JsonDocument) -> list[str]:
    """Format an effect, with its coefficients' units and plausible ranges by kind of system.

    Args:
        effect: Document of one effect, with its coefficients and the kinds of systems that they
            apply to.
    """
    if effect["skipped"]:
        return [f"{effect['name']}: {_format_sentence(effect)}"]
    result = [f"{effect['name']} ({effect['hook']}): {effect['says']}"]
    for coefficient in effect["coefficients"]:
        for application in coefficient["on"]:
            spread = f"{application['low']:g} to {application['high']:g}"
            result.append(
                f"  {coefficient['name']:14} {application['kind']:7} "
                f"{application['unit']:18} {spread}"
            )
    return result


def _format_reference(reference: JsonDocument) -> list[str]:
    description = (
        f"{reference['says']} [simgap {reference['simgap']}, {reference['started'][:10]}, "
    )
    return [
        f"{reference['name']:26} {description}{reference['targets']} targets, "
        f"budget {reference['budget']}]"
    ]


_LAID_OUT: dict[str, Callable[[JsonDocument], list[str]]] = {
    "systems": _format_system,
    "effects": _format_effect,
    "experiments": _format_experiment,
    "references": _format_reference,
}


def list_places(model: Path) -> JsonDocument:
    """Build the JSON document of the places of a model file.

    A place is a joint, actuator, body or sensor at which an effect can act.

    Args:
        model: MJCF or URDF file of a robot.
    """
    from bench.core.plugin_registries import make_robot_simulator
    from bench.logs.recording_summary import format_robot_summary
    from sims import effects

    kind = cast("type[RobotSimulator]", make_robot_simulator(model))
    # Effects by the kind of place at which they act.
    effects_by_kind: dict[str, list[str]] = {}
    for name in effects.list_names():
        effect = effects.get_effect(name)
        if kind.system.placed(effect):
            effects_by_kind.setdefault(effect.at, []).append(name)
    return {
        "model": model,
        "about": list(format_robot_summary(kind)),
        "joints": [
            {
                **_pick(joint, "name", "kind", "range", "unit", "effort"),
                "effort_unit": joint.force_unit,
            }
            for joint in kind.robot.joints
        ],
        "actuators": [
            _pick(actuator, "name", "kind", "joint", "range", "force")
            for actuator in kind.robot.actuators
        ],
        "bodies": [_pick(body, "name", "mass", "aliases") for body in kind.robot.bodies],
        "inputs": [_pick(c, "name", "unit") for c in kind.inputs],
        "channels": _describe_channels(kind.channels),
        "effects": effects_by_kind,
        "free": list(kind.system.list_mujoco_words()),
    }


def format_places(places: JsonDocument) -> Iterator[str]:
    """Yield lines about a model file's places and signals, and the effects that can act there.

    Args:
        places: Document of `list_places`.
    """
    yield from places["about"]
    for joint in places["joints"]:
        limits = _format_range(joint["range"], joint["unit"])
        effort = f", effort {joint['effort']:g}" if joint["effort"] is not None else ""
        effort = append_unit(effort, joint["effort_unit"]) if effort else ""
        yield f"  {'joint':9} {joint['name']:24} {joint['kind']}{limits}{effort}"
    units = {signal["name"]: signal["unit"] for signal in places["inputs"]}
    for actuator in places["actuators"]:
        limits = _format_range(actuator["range"], units.get(f"u.{actuator['name']}", ""))
        target = f"{actuator['kind']} on {actuator['joint'] or 'no joint'}"
        yield f"  {'actuator':9} {actuator['name']:24} {target}{limits}"
    for body in places["bodies"]:
        links = f", with {', '.join(body['aliases'])}" if body["aliases"] else ""
        yield f"  {'body':9} {body['name']:24} {body['mass']:.4g} kg{links}"
    for signal in places["inputs"]:
        yield f"  {'input':9} {signal['name']:24} {format_unit(signal['unit'])}"
    for channel in places["channels"]:
        unit = format_unit(channel["unit"])
        yield f"  {'channel':9} {channel['name']:24} {unit:9} {channel['says']}"
    for kind, names in places["effects"].items():
        # The world has no name, so effects on it have no place.
        location = "of the world" if kind == "world" else f"at a {kind}, as {names[0]}@NAME or @*"
        yield f"  effects {location.replace('a actuator', 'an actuator')}: {', '.join(names)}"
    yield f"  --free also takes MuJoCo's words: {', '.join(places['free'])}"


def _format_range(limits: tuple[float, float] | None, unit: str) -> str:
    return append_unit(f", {limits[0]:.4g} to {limits[1]:.4g}", unit) if limits else ""
