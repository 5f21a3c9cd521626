"""Format the documents of `bench.cli.catalogue` as text for `simgap list`."""

from __future__ import annotations

from collections.abc import Callable

from bench.cli.catalogue import CATALOGUE_SECTIONS
from bench.cli.output import JsonDocument


def format_catalogue(section: str) -> list[str]:
    """Return the lines of one section of the catalogue.

    Args:
        section: One of `bench.cli.catalogue.CATALOGUE_SECTIONS`, e.g. tuners, simulators or
            schemas.
    """
    return format_documents(section, CATALOGUE_SECTIONS[section]())


def format_documents(section: str, documents: list[JsonDocument]) -> list[str]:
    """Format given documents of a section of the catalogue.

    Args:
        section: Name of the section.
        documents: Documents of its entries.
    """
    format_entry = _LAID_OUT.get(section, _format_plain_entry)
    return [line for document in documents for line in format_entry(document)]


def _format_plain_entry(each: JsonDocument) -> list[str]:
    return [f"{each['name']:18} {_format_sentence(each)}"]


def _format_sentence(each: JsonDocument) -> str:
    """Return the description of an entry, or why it cannot be used here."""
    skipped = each.get("skipped")
    return f"skipped: {skipped}" if skipped else each["says"]


def _format_experiment(experiment: JsonDocument) -> list[str]:
    """Format an experiment: what is missing on this machine, its description, its tags."""
    missing = []
    if experiment["skipped"]:
        missing.append(f"skipped: {experiment['skipped']}")
    if experiment["needs"]:
        missing.append(f"needs `{experiment['needs']}`")
    if experiment["tuners_skipped"] and not experiment["skipped"]:
        reasons = "; ".join(sorted(set(experiment["tuners_skipped"].values())))
        missing.append(f"without {', '.join(experiment['tuners_skipped'])}: {reasons}")
    words = f"{'; '.join(missing)}. {experiment['says']}" if missing else experiment["says"]
    return [f"{experiment['name']:22} {words} [{', '.join(experiment['tags'])}]"]


def _format_system(system: JsonDocument) -> list[str]:
    """Format a system: its description, then a line for each of its declared quantities."""
    result = [f"{system['name']}: {_format_sentence(system)}"]
    if system["skipped"]:
        return result
    for p in system["parameters"]:
        low, high = p["bounds"]
        training = p["training"]
        training_text = f", training {training[0]:g} to {training[1]:g}" if training else ""
        result.append(
            f"  parameter {p['name']:18} {p['unit']:12} {low:g} to {high:g}{training_text}; "
            f"nominal {p['nominal']:g}  {p['says']}"
        )
    result += [
        f"  constant  {c['name']:18} {c['unit']:12} {c['value']:g}  {c['says']}"
        for c in system["constants"]
    ]
    result += _format_channels("input", system["inputs"])
    result += [f"  state     {s['name']:18} {s['value']:>12g}" for s in system["states"]]
    return result + _format_channels("channel", system["channels"])


def _format_channels(role: str, channels: list[JsonDocument]) -> list[str]:
    return [f"  {role:9} {c['name']:18} {c['unit']:12} {c['says']}".rstrip() for c in channels]


def _format_effect(each: JsonDocument) -> list[str]:
    """Format an effect, with its coefficients' units and plausible ranges by kind of system."""
    if each["skipped"]:
        return [f"{each['name']}: {_format_sentence(each)}"]
    result = [f"{each['name']} ({each['hook']}): {each['says']}"]
    for c in each["coefficients"]:
        for application in c["on"]:
            spread = f"{application['low']:g} to {application['high']:g}"
            result.append(
                f"  {c['name']:14} {application['kind']:7} {application['unit']:18} {spread}"
            )
    return result


def _format_reference(each: JsonDocument) -> list[str]:
    description = f"{each['says']} [simgap {each['simgap']}, {each['started'][:10]}, "
    return [f"{each['name']:26} {description}{each['targets']} targets, budget {each['budget']}]"]


_LAID_OUT: dict[str, Callable[[JsonDocument], list[str]]] = {
    "systems": _format_system,
    "effects": _format_effect,
    "experiments": _format_experiment,
    "references": _format_reference,
}
