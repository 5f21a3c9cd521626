"""Write the pages below docs/reference and the schemas of table rows from the code.

Commands come from the parser, keys of an experiment and of verdict.json from fields and docstrings,
thresholds from the verdict rules, and JSON documents from the schemas.

Run `python -m tests.docs.generate_pages` when the test of these pages fails.
"""

import ast
import dataclasses
import inspect
import json
import re
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any, Literal, get_args, get_origin, get_type_hints, is_typeddict

from bench.benchmark.problem.experiment_config import Experiment
from bench.benchmark.storage.table_schemas import (
    ERROR_TABLE_COLUMNS,
    SHOT_TABLE_COLUMNS,
    STATUS_COLUMNS,
    EmptyCellRule,
)
from bench.bounce_shot.shot_config import ShotConfig
from bench.cli.commands import list_catalogue
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
from tests.docs.page_numbers import inserted_numbers

COMMAND = "python -m tests.docs.generate_pages"
NOTE = f"<!-- Written by `{COMMAND}` from the code; change it there. -->"


def page(title, *parts):
    """Return a page: note, heading and parts, separated by blank lines."""
    return "\n\n".join([NOTE, f"# {title}", *parts]) + "\n"


def table(*rows):
    """Return a Markdown table; the first row is its header."""
    lines = ["| " + " | ".join(row) + " |" for row in rows]
    return "\n".join([lines[0], "|" + "---|" * len(rows[0]), *lines[1:]])


def attributes(cls):
    """Return the descriptions of the attributes in a Google-style docstring, each as one line."""
    text = inspect.getdoc(cls).partition("Attributes:\n")[2]
    found = re.findall(r"^    (\w+): ((?:.|\n        )*)", text, re.M)
    return {name: " ".join(says.split()) for name, says in found}


def summary(cls):
    """Return the first paragraph of a docstring as one line."""
    return " ".join(inspect.getdoc(cls).partition("\n\n")[0].split())


# Commands.


def commands():
    """Return the page of all commands with their options."""
    found = list_catalogue.list_commands(build_parser())
    listing = [("command", "what it does")]
    listing += [(f"[`{each['name']}`](#simgap-{each['name']})", each["says"]) for each in found]
    codes = [
        ("exit code", "meaning"),
        *((str(code), says) for code, says in EXIT_CODES.items()),
    ]
    parts = [
        "`simgap COMMAND --help` prints the same, `simgap list --json` as JSON. With `--json` "
        "every command prints [one JSON document](json.md) to stdout and nothing else.",
        table(*codes),
        table(*listing),
    ]
    for each in found:
        parts += [f"## simgap {each['name']}", f"{sentence(each['says'])}", options(each)]
    return page("Commands", *parts)


def sentence(text):
    """Write a help text as a sentence."""
    return text[0].upper() + text[1:] + "."


def options(command):
    """Return a table of a command's arguments and options."""
    rows = [("argument or option", "what")]
    for option in command["options"]:
        # Every command has this option, and the top of the page describes it.
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
    """Return an option as it is typed on the command line."""
    metavar = option["metavar"]
    several = f"{metavar} ..." if option["several"] else metavar
    if not option["flags"]:
        return several if option["required"] else f"[{several}]"
    value = [] if option["type"] == "flag" else [several]
    return " ".join([*option["flags"], *value])


# Keys of an experiment.

LEFT_OUT = {"name", "label"}
"""Fields that are not keys: the experiment's name comes from its file, a label from its table."""
REQUIRED = {"simulator"}
"""Fields whose default exists only in Python."""
WORDS = {str: "text", int: "whole number", float: "number", bool: "`true` or `false`", Any: "value"}


def experiment_keys():
    """Return the page of all keys of an experiment file."""
    parts = [
        "An experiment is a TOML file. Name one of the project, or give the path of your own "
        "(`simgap compare my.toml`). The keys are the fields of "
        "`bench.benchmark.problem.experiment_config.Experiment`; `experiment.toml` of a comparison "
        "contains all of them with their defaults. Unknown keys are errors. "
        "[Examples](../../bench/experiments), [what each tests](../problems.md).",
        keys(Experiment, ""),
    ]
    for name, hint in hints(Experiment).items():
        for cls in filter(dataclasses.is_dataclass, parts_of(hint)):
            # Several tables of one kind have a label each.
            whole = name if hint is cls or type(None) in get_args(hint) else f"{name}.LABEL"
            parts += [f"## `[{whole}]`", summary(cls), keys(cls, f"{whole}.")]
    parts += [
        "## `[shot]`",
        "The scene of a [bounce shot](../bounce-shot.md). " + summary(ShotConfig),
    ]
    parts += [keys(ShotConfig, "shot.")]
    return page("Keys of an experiment", *parts)


def keys(cls, prefix):
    """Return a table of a dataclass's fields: key, type, default and description."""
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
    """Return the resolved types of a class's fields."""
    return get_type_hints(cls)


def parts_of(hint):
    """Return a type and all types it contains."""
    inner = [part for argument in get_args(hint) for part in parts_of(argument)]
    return [hint, *inner]


def words(hint):
    """Describe a type in TOML terms."""
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
    """Return a field's default in TOML syntax."""
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
"""Names of the objects in verdict.json on the page."""
ESTIMATE = {
    "value": "fitted value",
    "unit": "unit of `value`, `low` and `high`",
    "low": "lower end of the 95 % interval; null if the data do not bound it",
    "high": "upper end of the interval",
    "at_bound": "bound at which the value ends (`low` or `high`); it then has no interval; absent "
    "if the value lies inside its range",
    "stated": "value in the robot's model file that the estimate changes, such as the damping of "
    "a joint or the mass of a body; for an inertia tensor, its largest principal moment; absent "
    "if the file has no such value",
    "total": "this value including the estimate, as in extended.xml; absent if `stated` is absent",
    "total_unit": "unit of `stated` and `total`; absent if equal to `unit`",
    "usual_range": "smallest and largest plausible value; absent if the value lies between them",
}
"""Descriptions of the fields of an estimate, whose docstring is a single sentence."""


def verdict_keys():
    """Return the page of the six verdicts, all keys of verdict.json, and the thresholds of the
    rules.
    """
    words_of = [
        ("verdict", "says"),
        *((f"`{name}`", text) for name, text in VERDICT_MEANINGS.items()),
    ]
    parts = [
        "`simgap explain` writes `verdict.json`: one JSON object with exactly these keys; in "
        "Python, `found.answer`. See [verdicts](../verdicts.md) for how a verdict is reached.",
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


def json_keys(cls, descriptions):
    """Return a table of a dataclass's fields as keys of a JSON object."""
    rows = [("key", "type", "what")]
    for field in dataclasses.fields(cls):
        what = descriptions[field.name].replace("``", "`").replace("None", "null").removesuffix(".")
        key = OF_JSON.get((cls.__name__, field.name), field.name)
        rows.append((f"`{key}`", of_json(hints(cls)[field.name]), what))
    return table(*rows)


def of_json(hint):
    """Describe a type in JSON terms."""
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
    """Return a table of a module's numeric constants and their docstrings."""
    rows = [("threshold", "value", "what")]
    # Python does not keep docstrings of constants, so they are read from the source.
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
"""Schemas of table rows: title and columns."""
JSON_KINDS = {str: "string", bool: "boolean", int: "integer", float: "number"}
LARGEST = 2.0**53


def row_schema(name):
    """Return the schema of a table row, made from the declared columns."""
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
    """Return the schema of one cell."""
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
    """Return the page of the JSON documents of all commands, made from the schemas."""
    commands_of = [each["name"] for each in list_catalogue.list_commands(build_parser())]
    others = [name for name in schema_names() if name not in commands_of]
    parts = [
        "`simgap COMMAND --json` prints one JSON document to stdout and nothing else; progress and "
        "warnings go to stderr. If the command fails, the document is [`error`](#error), and the "
        "[exit code](commands.md) is not 0. Values that are not finite numbers are null; paths are "
        "as given. `simgap schema NAME` prints the exact schema (JSON Schema, draft 2020-12); the "
        "files are in `bench/schemas` and in the wheel. Later versions only add keys, so ignore "
        "unknown ones.",
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
    """Return the tables of a document's keys, one for each form it may have."""
    forms = known.get("anyOf", [known])
    parts = [sentence(known["description"])] if "description" in known else []
    for form in forms:
        rows = list(key_rows(form, ""))
        parts.append(table(("key", "type", "what"), *rows) if rows else "Any keys.")
    return parts


def key_rows(known, before):
    """Yield a row for each key, followed by rows for the keys of its value."""
    for key, inner in known.get("properties", {}).items():
        name = f"{before}{key}"
        says = inner.get("description", "").replace("|", "\\|")
        yield f"`{name}`", json_kind(inner), says
        yield from inner_rows(inner, name)


def inner_rows(inner, name):
    """Yield rows for the keys inside a value: an object, a list of objects, or objects by name."""
    for form in inner.get("anyOf", ()):
        yield from inner_rows(form, name)
    if "items" in inner:
        yield from inner_rows(inner["items"], f"{name}[]")
    elif isinstance(inner.get("additionalProperties"), dict):
        yield from inner_rows(inner["additionalProperties"], f"{name}.NAME")
    elif "properties" in inner:
        yield from key_rows(inner, f"{name}.")


def json_kind(known):
    """Describe the type of a schema in words."""
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
    """Return the page of all tuners: method, equations, sources and options."""
    return page(
        "How each tuner works",
        "Generated from the modules in `methods/`, whose code has the numbers of the equations. "
        "[Choosing a tuner](../choosing-a-tuner.md) compares them; [add a "
        "tuner](../add-a-tuner.md) shows how to write one.",
        "![Error against number of simulations](../../results/reference/ball-drop/figures/"
        "error-vs-simulations.png)",
        "*Ten tuners on the bouncing ball (`simgap compare ball-drop --salt public`). Each line is "
        "the median over 100 targets.*",
        *tuner_table.sections(),
    )


def public_names():
    """Return the page of all public names that have a docstring."""
    return page(
        "Public names",
        "All names after `import simgap`, such as `simgap.compare`; [Python](../python.md) shows "
        "how to use them together. A line that begins with `:::` says where a name is defined; the "
        "site shows its signature and docstring there.",
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
"""Functions that build the pages."""


def main():
    """Write all schemas of table rows and all pages, and insert numbers into the other pages."""
    for name in ROWS:
        path = ROOT / "bench" / "schemas" / f"{name}.schema.json"
        path.write_text(row_schema(name), encoding="utf-8")
        print(path)
    for name, make in PAGES.items():
        (DOCS / name).write_text(make(), encoding="utf-8")
        print(DOCS / name)
    inserted_numbers.main()


if __name__ == "__main__":
    main()
