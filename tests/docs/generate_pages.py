"""Writes the pages below docs/reference from the code: commands from the parser, keys of an
experiment and of verdict.json from fields and docstrings, thresholds from the rules, what commands
print for programs from the schemas; and those schemas that are of a table's columns.

Run by `python -m tests.docs.generate_pages`; a test says when it has to be.
"""

import ast
import dataclasses
import inspect
import json
import re
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any, Literal, get_args, get_origin, get_type_hints, is_typeddict

from bench.benchmark.problem.experiment import Experiment
from bench.benchmark.storage.table_schemas import (
    ERROR_TABLE_COLUMNS,
    SHOT_TABLE_COLUMNS,
    STATUS_COLUMNS,
    EmptyCellRule,
)
from bench.bounce_shot.shot_config import ShotConfig
from bench.cli import catalogue
from bench.cli.main import build_parser
from bench.cli.output import EXIT_CODES
from bench.diagnosis.evaluation.search_control import EarlyStop
from bench.diagnosis.experiment_design.discriminating_run import DiscriminatingRun as NextExperiment
from bench.diagnosis.search import verdict_rules
from bench.diagnosis.search.verdict_rules import VERDICT_MEANINGS
from bench.diagnosis.verdict import Candidate, Cause, HeldOutResult, RecordingFault, Verdict
from bench.schemas import list_schema_names as schema_names
from bench.schemas import load_schema
from sims.extended_simulator import FittedValue
from tests.docs import documented_names, tuner_table
from tests.docs.documentation_pages import DOCS, ROOT

COMMAND = "python -m tests.docs.generate_pages"
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
    found = catalogue.list_commands(build_parser())
    listing = [("command", "what it does")]
    listing += [(f"[`{each['name']}`](#simgap-{each['name']})", each["says"]) for each in found]
    codes = [
        ("exit code", "what it says"),
        *((str(code), says) for code, says in EXIT_CODES.items()),
    ]
    parts = [
        "`simgap COMMAND --help` says the same, `simgap list --json` to programs. With `--json` "
        "every command prints [one JSON document](json.md), and nothing else to stdout.",
        table(*codes),
        table(*listing),
    ]
    for each in found:
        parts += [f"## simgap {each['name']}", f"{sentence(each['says'])}", options(each)]
    return page("Commands", *parts)


def sentence(text):
    """A line of help as a sentence."""
    return text[0].upper() + text[1:] + "."


def options(command):
    """A command's arguments and options as a table."""
    rows = [("argument or option", "what")]
    for option in command["options"]:
        # All of them have it, and it is said above.
        if option["flags"] == ["--json"]:
            continue
        what = option["says"].replace("|", "\\|")
        if option["choices"]:
            what = "; ".join(filter(None, [what, "one of " + ", ".join(option["choices"])]))
        if option["repeatable"]:
            what += "; may be repeated"
        if option["required"] and option["flags"]:
            what += " (required)"
        rows.append((f"`{spelt(option)}`", what))
    return table(*rows) if len(rows) > 1 else "No options but `--json`."


def spelt(option):
    """An option as it is typed."""
    metavar = option["metavar"]
    several = f"{metavar} ..." if option["several"] else metavar
    if not option["flags"]:
        return several if option["required"] else f"[{several}]"
    value = [] if option["type"] == "flag" else [several]
    return " ".join([*option["flags"], *value])


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
        "`bench.benchmark.problem.experiment.Experiment`; a comparison's `experiment.toml` has "
        "all of them, defaults filled in. An unknown key is refused by name. "
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
        "The scene of a [bounce shot](../bounce-shot.md). " + summary(ShotConfig),
    ]
    parts += [keys(ShotConfig, "shot.")]
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
    FittedValue: "an estimate",
    HeldOutResult: "the gain on held-out runs",
    Candidate: "a candidate",
    NextExperiment: "the next experiment",
    EarlyStop: "the early end",
    RecordingFault: "a recording fault",
}
"""Objects in verdict.json, as the page calls them."""
ESTIMATE = {
    "value": "fitted",
    "unit": "of the three numbers",
    "low": "of its 95 % interval; null where the data do not bound it",
    "high": "the other end",
    "at_bound": "which end of its range the number lies at, where there is no interval; left out "
    "where it lies inside",
    "stated": "the number of the robot's model file that the estimate changes, such as a joint's "
    "damping or a body's mass; of an inertia tensor its largest principal moment; left out where "
    "the file has no such number",
    "total": "the same number with what was found in it, as extended.xml states it; left out "
    "where `stated` is",
    "total_unit": "unit of `stated` and `total`; left out where it is `unit`",
    "usual_range": "lowest and highest value that one would expect; left out where the value lies "
    "between them",
}
"""A number says this in one sentence, which a table needs by its fields."""


def verdict_keys():
    """The six verdicts, every key of verdict.json, and the thresholds of the rules."""
    words_of = [
        ("verdict", "says"),
        *((f"`{name}`", text) for name, text in VERDICT_MEANINGS.items()),
    ]
    parts = [
        "What `simgap explain` writes for programs: one JSON object with these keys and no others; "
        "in Python `found.answer`. How it is found is on the page [verdicts](../verdicts.md).",
        "## The six verdicts",
        table(*words_of),
        "## The keys",
        json_keys(Verdict, attributes(Verdict)),
    ]
    for cls, name in KINDS.items():
        says = ESTIMATE if cls is FittedValue else attributes(cls)
        parts += [f"## {name[0].upper()}{name[1:]}", json_keys(cls, says)]
    parts += ["`change` and `apart` are left out where no run is proposed."]
    parts += [
        "## Thresholds of the rules",
        "In `bench/diagnosis/search/verdict_rules.py`.",
        thresholds(verdict_rules),
    ]
    return page("verdict.json", *parts)


OF_JSON = {
    ("EarlyStop", "reason"): "by",
    ("EarlyStop", "during_question"): "during",
    ("EarlyStop", "skipped_questions"): "not_asked",
}
"""Keys of JSON objects that differ from the names of the fields."""


def json_keys(cls, says):
    """A dataclass's fields as keys of a JSON object."""
    rows = [("key", "type", "what")]
    for field in dataclasses.fields(cls):
        what = says[field.name].replace("``", "`").replace("None", "null").removesuffix(".")
        key = OF_JSON.get((cls.__name__, field.name), field.name)
        rows.append((f"`{key}`", of_json(hints(cls)[field.name]), what))
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


# What commands print for programs.

DRAFT = "https://json-schema.org/draft/2020-12/schema"
ROWS = {
    "table": ("A row of table.csv of a comparison", ERROR_TABLE_COLUMNS),
    "shot-table": ("A row of table.csv of a bounce shot", SHOT_TABLE_COLUMNS),
    "run-status": ("A row of status.csv", STATUS_COLUMNS),
}
"""Schemas that are of the columns of a table."""
JSON_KINDS = {str: "string", bool: "boolean", int: "integer", float: "number"}
LARGEST = 2.0**53


def row_schema(name):
    """The schema of a table's row, from the columns that are declared."""
    title, columns = ROWS[name]
    document = {
        "$schema": DRAFT,
        "$id": f"{name}.schema.json",
        "title": title,
        "description": "A column a key (docs/results.md). What is no finite number is null.",
        "type": "object",
        "required": [column.name for column in columns if column.required],
        "properties": {column.name: cell_schema(column) for column in columns},
        "additionalProperties": False,
    }
    return json.dumps(document, indent=1, ensure_ascii=False) + "\n"


def cell_schema(column):
    """The schema of one cell."""
    kind = JSON_KINDS[column.kind]
    empty = column.empty is not EmptyCellRule.NEVER or column.infinite or "" in column.words
    cell = {"type": [kind, "null"] if empty else kind}
    if words := [word for word in column.words if word]:
        cell["enum"] = [*words, None] if empty else words
    if abs(column.low) < LARGEST:
        cell["minimum"] = int(column.low) if column.kind is int else column.low
    if abs(column.high) < LARGEST:
        cell["maximum"] = column.high
    return cell


def json_documents():
    """What every command prints with --json, and the other forms, from the schemas."""
    commands_of = [each["name"] for each in catalogue.list_commands(build_parser())]
    others = [name for name in schema_names() if name not in commands_of]
    parts = [
        "`simgap COMMAND --json` prints one JSON document and nothing else to stdout; progress and "
        "warnings are on stderr. Where it comes to nothing the document is "
        "[`error`](#error), and the exit code says so too "
        "([exit codes](commands.md)). What is no finite number is null; paths are as they were "
        "given. `simgap schema NAME` prints the exact form (JSON Schema, draft 2020-12); the files "
        "are in `bench/schemas`, and in the wheel. Later versions add keys and remove none: take "
        "what you know and leave the rest.",
    ]
    for name in [*commands_of, *others]:
        known = load_schema(name)
        parts += [f"## {name}", sentence(known["title"])]
        if name == "verdict":
            parts += ["Its keys have [a page of their own](verdict.md)."]
            continue
        if name in ROWS:
            parts += ["Its columns are on the page [results](../results.md)."]
            continue
        parts += document_tables(known)
    return page("What commands print for programs", *parts)


def document_tables(known):
    """The keys of a document, of each form that it may have."""
    forms = known.get("anyOf", [known])
    parts = [sentence(known["description"])] if "description" in known else []
    for form in forms:
        rows = list(key_rows(form, ""))
        parts.append(table(("key", "type", "what"), *rows) if rows else "Any keys.")
    return parts


def key_rows(known, before):
    """A row for each key, those of what it holds below it."""
    for key, inner in known.get("properties", {}).items():
        name = f"{before}{key}"
        says = inner.get("description", "").replace("|", "\\|")
        yield f"`{name}`", json_kind(inner), says
        yield from inner_rows(inner, name)


def inner_rows(inner, name):
    """Rows for what stands within a key: objects, lists of them, objects by name."""
    for form in inner.get("anyOf", ()):
        yield from inner_rows(form, name)
    if "items" in inner:
        yield from inner_rows(inner["items"], f"{name}[]")
    elif isinstance(inner.get("additionalProperties"), dict):
        yield from inner_rows(inner["additionalProperties"], f"{name}.NAME")
    elif "properties" in inner:
        yield from key_rows(inner, f"{name}.")


def json_kind(known):
    """A schema's kind in words."""
    if "const" in known:
        return f"`{known['const']}`"
    if "$ref" in known:
        name = known["$ref"].partition(".")[0]
        within = known["$ref"].partition("#")[2]
        return f"a part of [`{name}`](#{name})" if within else f"[`{name}`](#{name})"
    if "anyOf" in known:
        return " or ".join(dict.fromkeys(json_kind(form) for form in known["anyOf"]))
    kinds = known.get("type", "value")
    kinds = [kinds] if isinstance(kinds, str) else kinds
    if "enum" in known:
        spelled = [f"`{word}`" for word in known["enum"] if word is not None]
        return " or ".join([*spelled, *(["null"] if None in known["enum"] else [])])
    words_of = {"string": "text", "integer": "whole number", "boolean": "true or false"}
    if "items" in known:
        words_of["array"] = f"list of {json_kind(known['items'])}"
    if isinstance(known.get("additionalProperties"), dict):
        words_of["object"] = f"by name: {json_kind(known['additionalProperties'])}"
    return " or ".join(words_of.get(kind, kind) for kind in kinds)


# Tuners and public names.


def how_tuners_work():
    """Every tuner: method, equations, sources, options."""
    return page(
        "How each tuner works",
        "Written from the modules in `methods/`, in whose code the equations' numbers stand. Which "
        "one to take: [by measured numbers](../choosing-a-tuner.md). How to write one: [add a "
        "tuner](../add-a-tuner.md).",
        "![Error against number of simulations](../../results/reference/ball-drop/figures/"
        "error-vs-simulations.png)",
        "*Ten of them on the bouncing ball (`simgap compare ball-drop --salt public`): a line is "
        "the median over 100 targets.*",
        *tuner_table.sections(),
    )


def public_names():
    """Every name of simgap that has a docstring."""
    return page(
        "Public names",
        "`import simgap`: `simgap.compare` and so on; how they go together is on the page "
        "[Python](../python.md). Each line that begins with `:::` says where a name is defined; "
        "on the site its signature and docstring stand there.",
        *documented_names.sections(),
    )


PAGES = {
    "reference/api.md": public_names,
    "reference/commands.md": commands,
    "reference/experiment.md": experiment_keys,
    "reference/json.md": json_documents,
    "reference/tuners.md": how_tuners_work,
    "reference/verdict.md": verdict_keys,
}
"""What writes each page."""


def main():
    """Write all schemas of rows and all pages."""
    for name in ROWS:
        path = ROOT / "bench" / "schemas" / f"{name}.schema.json"
        path.write_text(row_schema(name), encoding="utf-8")
        print(path)
    for name, make in PAGES.items():
        (DOCS / name).write_text(make(), encoding="utf-8")
        print(DOCS / name)


if __name__ == "__main__":
    main()
