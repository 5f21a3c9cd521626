"""Writes the pages below docs/reference from the code: commands from the parser, keys of an
experiment and of verdict.json from fields and docstrings, thresholds from the rules.

Run by `python -m tests.docs.generate`; a test says when it has to be.
"""

import argparse
import ast
import dataclasses
import inspect
import re
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any, Literal, get_args, get_origin, get_type_hints, is_typeddict

from bench.cli import parser
from bench.gap.causes import rules
from bench.gap.causes.rules import MEANING
from bench.gap.model.watch import Cut
from bench.gap.propose import Experiment as NextExperiment
from bench.gap.verdict import Candidate, Cause, Heldout, Verdict
from bench.problem.experiment import Experiment
from bench.shot.settings import Settings
from sims.extended import Number
from tests.docs.pages import DOCS

COMMAND = "python -m tests.docs.generate"
NOTE = f"<!-- Written by `{COMMAND}` from the code; change it there. -->"


def page(title, *parts):
    """A page: the note, a heading, and its parts with blank lines between."""
    return "\n\n".join([NOTE, f"# {title}", *parts]) + "\n"


def table(*rows):
    """A Markdown table; the first row is its header."""
    lines = ["| " + " | ".join(row) + " |" for row in rows]
    return "\n".join([lines[0], "|" + "---|" * len(rows[0]), *lines[1:]])


def attributes(cls):
    """What a Google-style docstring says of each attribute, in one line each."""
    text = inspect.getdoc(cls).partition("Attributes:\n")[2]
    found = re.findall(r"^    (\w+): ((?:.|\n        )*)", text, re.M)
    return {name: " ".join(says.split()) for name, says in found}


def summary(cls):
    """The first paragraph of a docstring, in one line."""
    return " ".join(inspect.getdoc(cls).partition("\n\n")[0].split())


# Commands.


def commands():
    """Every command, its usage and its options."""
    whole = parser()
    (choices,) = [a for a in whole._actions if isinstance(a, argparse._SubParsersAction)]
    says = {action.dest: action.help for action in choices._choices_actions}
    listing = [("command", "what it does")]
    listing += [(f"[`{name}`](#simgap-{name})", says[name]) for name in choices.choices]
    parts = [
        "`simgap COMMAND --help` says the same. Exit code 0: done; 1: something failed in a run "
        "or a check; 2: a fault of the input, told in one line; 130: interrupted.",
        table(*listing),
    ]
    for name, command in choices.choices.items():
        parts += [f"## simgap {name}", f"{sentence(says[name])}", options(name, command)]
    return page("Commands", *parts)


def sentence(text):
    """A line of help as a sentence."""
    return text[0].upper() + text[1:] + "."


def options(name, command):
    """A command's arguments and options as a table."""
    rows = [("argument or option", "what")]
    # argparse has no public way to ask a parser for what was added to it.
    for action in command._actions:
        if isinstance(action, argparse._HelpAction):
            continue
        what = (action.help or "").replace("|", "\\|")
        if action.choices:
            what = "; ".join(filter(None, [what, "one of " + ", ".join(action.choices)]))
        if isinstance(action, argparse._AppendAction | argparse._ExtendAction):
            what += "; may be repeated"
        if action.required and action.option_strings:
            what += " (required)"
        rows.append((f"`{spelt(action)}`", what))
    return table(*rows)


def spelt(action):
    """An option as it is typed."""
    metavar = action.metavar or action.dest.upper()
    several = f"{metavar} ..." if action.nargs == "+" else metavar
    if not action.option_strings:
        return f"[{metavar}]" if action.nargs == "?" else several
    return " ".join([*action.option_strings, *([] if action.nargs == 0 else [several])])


# Keys of an experiment.

LEFT_OUT = {"name", "label"}
"""Fields that are no keys: an experiment's name is that of its file, a label that of its table."""
REQUIRED = {"simulator"}
"""Fields that have a default for Python alone."""
WORDS = {str: "text", int: "whole number", float: "number", bool: "`true` or `false`", Any: "value"}


def experiment_keys():
    """Every key of an experiment file."""
    parts = [
        "An experiment is a TOML file: one that comes with the project by its name, your own by "
        "its path (`simgap compare my.toml`). The keys are the fields of "
        "`bench.problem.experiment.Experiment`; a comparison's `experiment.toml` has all of them, "
        "defaults filled in. An unknown key is refused by name. "
        "[Patterns](../../bench/experiments), [what they are for](../problems.md).",
        keys(Experiment, ""),
    ]
    for name, hint in hints(Experiment).items():
        for cls in filter(dataclasses.is_dataclass, parts_of(hint)):
            # several of a kind stand in a table each, under a label
            whole = name if hint is cls or type(None) in get_args(hint) else f"{name}.LABEL"
            parts += [f"## `[{whole}]`", summary(cls), keys(cls, f"{whole}.")]
    parts += [
        "## `[shot]`",
        "The scene of a [bounce shot](../bounce-shot.md). " + summary(Settings),
    ]
    parts += [keys(Settings, "shot.")]
    return page("Keys of an experiment", *parts)


def keys(cls, prefix):
    """A dataclass's fields as a table: key, type, default, and what its docstring says of each."""
    says = attributes(cls)
    rows = [("key", "type", "default", *(["what"] if says else []))]
    for field in dataclasses.fields(cls):
        if field.name in LEFT_OUT:
            continue
        what = [says[field.name].replace("``", "`").removesuffix(".")] if says else []
        kind = words(hints(cls)[field.name])
        rows.append((f"`{prefix}{field.name}`", kind, default(field), *what))
    return table(*rows)


def hints(cls):
    """The types of a class's fields, resolved."""
    return get_type_hints(cls)


def parts_of(hint):
    """The types that a type is made of, itself among them."""
    inner = [part for argument in get_args(hint) for part in parts_of(argument)]
    return [hint, *inner]


def words(hint):
    """A type as one would say it of TOML."""
    if is_typeddict(hint):
        return f"table of {', '.join(f'`{name}`' for name in hint.__annotations__)}"
    origin, inner = get_origin(hint), [a for a in get_args(hint) if a not in (type(None), ...)]
    if dataclasses.is_dataclass(hint):
        return "table, see below"
    if hint in WORDS:
        return WORDS[hint]
    if origin is Literal:
        return " or ".join(f"`{choice}`" for choice in inner)
    if origin is tuple and ... not in get_args(hint):
        return "[low, high]"
    if inspect.isclass(origin) and issubclass(origin, Mapping):
        held = words(inner[-1])
        return f"table of {held}s" if inner[-1] in WORDS else f"table by name: {held}"
    if inspect.isclass(origin) and issubclass(origin, Sequence):
        return (
            "tables, see below"
            if dataclasses.is_dataclass(inner[0])
            else f"list of {words(inner[0])}s"
        )
    return " or ".join(words(part) for part in inner)


def default(field):
    """A field's default as TOML writes it."""
    if field.name in REQUIRED:
        return "required"
    value = field.default
    if field.default_factory is not dataclasses.MISSING:
        value = field.default_factory()
    if value is dataclasses.MISSING:
        return "the label"
    if dataclasses.is_dataclass(value):
        return "see below"
    if value is None or value in ("", (), {}):
        return "none"
    if isinstance(value, bool):
        return f"`{str(value).lower()}`"
    if isinstance(value, tuple):
        shown = [f'"{v}"' if isinstance(v, str) else f"{v:g}" for v in value]
        return f"`[{', '.join(shown)}]`"
    return f"`{value:g}`" if isinstance(value, float) else f"`{value}`"


# The verdict.

KINDS = {
    Cause: "a cause",
    Number: "an estimate",
    Heldout: "the gain on held-out runs",
    Candidate: "a candidate",
    NextExperiment: "the next experiment",
    Cut: "the early end",
}
"""Objects in verdict.json, as the page calls them."""
ESTIMATE = {
    "value": "fitted",
    "unit": "of the three numbers",
    "low": "of its 95 % interval; null where the data do not bound it",
    "high": "the other end",
}
"""A number says this in one sentence, which a table needs by its fields."""


def verdict_keys():
    """The six verdicts, every key of verdict.json, and the thresholds of the rules."""
    words_of = [("verdict", "says"), *((f"`{name}`", text) for name, text in MEANING.items())]
    parts = [
        "What `simgap explain` writes for programs: one JSON object with these keys and no others; "
        "in Python `found.answer`. How it is found is on the page [explain.md](../explain.md).",
        "## The six verdicts",
        table(*words_of),
        "## The keys",
        json_keys(Verdict, attributes(Verdict)),
    ]
    for cls, name in KINDS.items():
        says = ESTIMATE if cls is Number else attributes(cls)
        parts += [f"## {name[0].upper()}{name[1:]}", json_keys(cls, says)]
    parts += ["`change` and `apart` are left out where no run is proposed."]
    parts += ["## Thresholds of the rules", "In `bench/gap/causes/rules.py`.", thresholds(rules)]
    return page("verdict.json", *parts)


def json_keys(cls, says):
    """A dataclass's fields as keys of a JSON object."""
    rows = [("key", "type", "what")]
    for field in dataclasses.fields(cls):
        what = says[field.name].replace("``", "`").replace("None", "null").removesuffix(".")
        rows.append((f"`{field.name}`", of_json(hints(cls)[field.name]), what))
    return table(*rows)


def of_json(hint):
    """A type as one would say it of JSON."""
    origin, inner = get_origin(hint), get_args(hint)
    if hint in KINDS:
        return KINDS[hint]
    if origin is Literal:
        return "text"
    if inspect.isclass(origin) and issubclass(origin, Mapping):
        return f"object: by name, {of_json(inner[-1])}"
    if inspect.isclass(origin) and issubclass(origin, Sequence):
        return f"list of {of_json(inner[0]).removeprefix('a ')}s"
    if inner:
        return " or ".join(of_json(part) for part in inner)
    return "null" if hint is type(None) else WORDS[hint]


def thresholds(module):
    """The numbers that a module names in capitals, each with its sentence."""
    rows = [("threshold", "value", "what")]
    # Docstrings of attributes are in the text alone: Python does not keep them.
    body = ast.parse(inspect.getsource(module)).body
    for statement, behind in pairwise(body):
        sentence_behind = isinstance(behind, ast.Expr) and isinstance(behind.value, ast.Constant)
        if isinstance(statement, ast.Assign) and sentence_behind:
            (name,) = statement.targets
            value = ast.literal_eval(statement.value)
            rows.append((f"`{name.id}`", f"{value:g}", " ".join(behind.value.value.split())))
    return table(*rows)


PAGES = {
    "reference/commands.md": commands,
    "reference/experiment.md": experiment_keys,
    "reference/verdict.md": verdict_keys,
}
"""What writes each page."""


def main():
    """Write all pages."""
    for name, make in PAGES.items():
        (DOCS / name).write_text(make(), encoding="utf-8")
        print(DOCS / name)


if __name__ == "__main__":
    main()
