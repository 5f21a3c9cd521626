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
from tests.docs.schema_outline import INTERVAL_END, Outliner, sentence

COMMAND = "python -m tests.docs.generate_pages"
NOTE = f"<!-- Written by `{COMMAND}` from the code; change it there. -->"


def page(title, *parts):
    """Return a page: note, heading and parts, separated by blank lines."""
    return "\n\n".join([NOTE, f"# {title}", *parts]) + "\n"


def table(*rows):
    """Return a Markdown table; the first row is its header."""
    lines = ["| " + " | ".join(row) + " |" for row in rows]
    return "\n".join([lines[0], "|" + "---|" * len(rows[0]), *lines[1:]])


def bullets(rows):
    """Return a Markdown list of names with their descriptions."""
    return "\n".join(": ".join(filter(None, [f"- {name}", what])) for name, what in rows)


def attributes(cls):
    """Return the descriptions of the attributes in a Google-style docstring, each as one line."""
    text = inspect.getdoc(cls).partition("Attributes:\n")[2]
    found = re.findall(r"^    (\w+): ((?:.|\n        )*)", text, re.M)
    return {name: " ".join(says.split()) for name, says in found}


def summary(cls):
    """Return the first paragraph of a docstring as one line."""
    return " ".join(inspect.getdoc(cls).partition("\n\n")[0].split())


# Commands.


MIN_SHARING_COMMANDS = 4
"""Minimum number of commands with an option that the page describes before all commands."""
COMMON = "Common options"
"""Heading of these options."""
PLUGIN = "plugin file with further tuners, simulators, effects or diagnosers"
"""Meaning of ``--plugin``, of which the help of a command names the part that it needs."""


def commands():
    """Return the page of all commands with their options."""
    found = list_catalogue.list_commands(build_parser())
    homes = option_homes(found)
    common = [row for row, home in homes.items() if home == COMMON]
    parts = [
        "`simgap COMMAND --help` prints the same, `simgap list --json` as JSON. With `--json` "
        "every command prints [one JSON document](json.md).",
        "Exit codes:",
        bullets((f"`{code}`", says) for code, says in EXIT_CODES.items()),
        ", ".join(f"[`{each['name']}`](#simgap-{each['name']})" for each in found),
        f"## {COMMON}",
        bullets(common),
    ]
    for each in found:
        parts += [f"## simgap {each['name']}", sentence(each["says"]), *options(each, homes)]
    return page("Commands", *parts)


def option_homes(found):
    """Return the section that describes each option: that of its first command, or the common one.

    An option with another text in another command is another option.
    """
    commands_of = {}
    for command in found:
        for row in option_rows(command):
            commands_of.setdefault(row, []).append(command["name"])
    first = {}
    for row, names in commands_of.items():
        # Arguments without a flag are described in every command.
        many = len(set(names)) >= MIN_SHARING_COMMANDS and row[0].startswith("`--")
        first[row] = COMMON if many else names[0]
    return first


def option_rows(command):
    """Return name and description of each argument and option of a command."""
    return [
        (f"`{spelt(option)}`", describe_option(option))
        for option in command["options"]
        # Every command has this option, and the top of the page describes it.
        if option["flags"] != ["--json"]
    ]


def describe_option(option):
    """Return what an argument or option does."""
    what = PLUGIN if option["flags"] == ["--plugin"] else option["says"]
    if option["choices"] and not option["flags"]:
        what += "; one of " + ", ".join(option["choices"])
    # An option that takes several values need not be repeated.
    if option["repeatable"] and not option["several"]:
        what += "; may be repeated"
    if option["required"] and option["flags"]:
        what += " (required)"
    return what


def options(command, homes):
    """Return a list of a command's own arguments and options, and references to the others."""
    rows, elsewhere = {}, {}
    for name, what in option_rows(command):
        home = homes[name, what]
        if home == command["name"] or not name.startswith("`--"):
            rows.setdefault(what, []).append(name)
        else:
            elsewhere.setdefault(home, []).append(re.sub(" .*", "`", name))
    parts = []
    if rows:
        parts.append(bullets((", ".join(names), what) for what, names in rows.items()))
    links = {home: f"As for [`simgap {home}`](#simgap-{home})" for home in elsewhere}
    links[COMMON] = f"[{COMMON}](#{COMMON.lower().replace(' ', '-')})"
    if elsewhere:
        parts.append(
            " ".join(f"{links[home]}: {', '.join(names)}." for home, names in elsewhere.items())
        )
    return parts or ["No options but `--json`."]


def spelt(option):
    """Return an option as it is typed on the command line."""
    metavar = option["metavar"]
    if option["choices"] and option["flags"]:
        metavar = f"{{{','.join(option['choices'])}}}"
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
WORDS = {str: "string", int: "integer", float: "number", bool: "boolean", Any: "value"}


def experiment_keys():
    """Return the page of all keys of an experiment file."""
    parts = [
        "An experiment is a TOML file. Name one of the project, or give the path of your own "
        "(`simgap compare my.toml`). `experiment.toml` of a comparison contains all keys, which "
        "are the fields of `simgap.Experiment`. Unknown keys are errors. Type and default are in "
        "parentheses; a key without a type is a string. "
        "[Examples](../../bench/experiments), [what each tests](../problems.md).",
        keys(Experiment),
    ]
    for name, hint in hints(Experiment).items():
        for cls in filter(dataclasses.is_dataclass, parts_of(hint)):
            # Several tables of one kind have a label each.
            whole = name if hint is cls or type(None) in get_args(hint) else f"{name}.LABEL"
            parts += [f"## `[{whole}]`", summary(cls), keys(cls)]
    parts += [
        "## `[shot]`",
        "The scene of a [bounce shot](../bounce-shot.md). " + summary(ShotConfig),
    ]
    parts += [keys(ShotConfig)]
    return page("Keys of an experiment", *parts)


def keys(cls):
    """Return a list of a dataclass's fields: key, type with default, and description."""
    says = attributes(cls)
    rows = []
    for field in dataclasses.fields(cls):
        if field.name not in LEFT_OUT:
            kind = words(hints(cls)[field.name])
            typed = ", ".join(filter(None, [kind if kind != "string" else "", default(field)]))
            what = says.get(field.name, "").replace("``", "`").removesuffix(".")
            rows.append((f"`{field.name}` ({typed})" if typed else f"`{field.name}`", what))
    return bullets(rows)


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
        return "table below"
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
            "tables below" if dataclasses.is_dataclass(inner[0]) else f"list of {words(inner[0])}s"
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
        return ""
    if value is None or value in ("", (), {}):
        return ""
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
    "high": "upper end of the 95 % interval; null if the data do not bound it",
    "at_bound": "end of the range at which the value is, `low` or `high`; it then has no interval; "
    "absent if it is inside",
    "stated": "value in the robot's model file that the estimate changes, such as a joint's "
    "damping or a body's mass; for an inertia tensor, its largest principal moment; absent if the "
    "file has none",
    "total": "this value with the estimate, as in extended.xml; absent if `stated` is absent",
    "total_unit": "unit of `stated` and `total`; absent if equal to `unit`",
    "usual_range": "smallest and largest plausible value; absent if the value lies between them",
}
"""Descriptions of the fields of an estimate, whose docstring is a single sentence."""


def verdict_keys():
    """Return the page of the six verdicts, all keys of verdict.json, and the thresholds of the
    rules.
    """
    parts = [
        "`simgap explain` writes `verdict.json`: one JSON object with these keys; in "
        "Python, `found.answer`. A key without a type is a string. [Verdicts](../verdicts.md) "
        "explains how a verdict is reached.",
        "## The six verdicts",
        bullets((f"`{name}`", text) for name, text in VERDICT_MEANINGS.items()),
        "## The keys",
        json_keys(Verdict, attributes(Verdict)),
    ]
    for cls, name in KINDS.items():
        says = ESTIMATE if cls is FittedValue else attributes(cls)
        parts += [f"## {name[0].upper()}{name[1:]}", json_keys(cls, says)]
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
    """Return a table of a dataclass's fields as keys of a JSON object; equal ones share a row."""
    names_of = {}
    for field in dataclasses.fields(cls):
        what = descriptions[field.name].replace("``", "`").replace("None", "null").removesuffix(".")
        kind = of_json(hints(cls)[field.name])
        # An optional key is left out instead of being null.
        if "null" in what or field.metadata.get("optional"):
            kind = kind.removesuffix(" or null")
        key = OF_JSON.get((cls.__name__, field.name), field.name)
        names_of.setdefault((kind, INTERVAL_END.sub("ends of ", what)), []).append(f"`{key}`")
    rows = [
        (", ".join(names) + (f" ({kind})" if kind != "string" else ""), what)
        for (kind, what), names in names_of.items()
    ]
    return table(("key", "what"), *rows)


def of_json(hint):
    """Describe a type in JSON terms."""
    origin, inner = get_origin(hint), get_args(hint)
    if hint in KINDS:
        return KINDS[hint]
    if origin is Literal:
        return "string"
    if inspect.isclass(origin) and issubclass(origin, Mapping):
        return f"{of_json(inner[-1]).removeprefix('a ').removeprefix('an ')}s by name"
    if inspect.isclass(origin) and issubclass(origin, Sequence):
        return f"list of {of_json(inner[0]).removeprefix('a ')}s"
    if inner:
        return " or ".join(of_json(part) for part in inner)
    return "null" if hint is type(None) else JSON_KINDS[hint]


def thresholds(module):
    """Return a list of a module's numeric constants and their docstrings."""
    rows = []
    # Python does not keep docstrings of constants, so they are read from the source.
    body = ast.parse(inspect.getsource(module)).body
    for statement, behind in pairwise(body):
        sentence_behind = isinstance(behind, ast.Expr) and isinstance(behind.value, ast.Constant)
        if isinstance(statement, ast.Assign) and sentence_behind:
            (name,) = statement.targets
            value = ast.literal_eval(statement.value)
            what = " ".join(behind.value.value.split()).removesuffix(".")
            rows.append((f"`{name.id} = {value:g}`", what))
    return bullets(rows)


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


OTHER_PAGES = {
    **dict.fromkeys(ROWS, "[Columns](../results.md)."),
    "verdict": "[Keys](verdict.md).",
}
"""Links for documents that other pages describe."""


def json_documents():
    """Return the page of the JSON documents of all commands, made from the schemas."""
    commands_of = [each["name"] for each in list_catalogue.list_commands(build_parser())]
    others = [name for name in schema_names() if name not in commands_of]
    parts = [
        "`simgap COMMAND --json` prints one JSON document to stdout and nothing else; progress and "
        "warnings go to stderr. If the command fails, the document is [`error`](#error), and the "
        "[exit code](commands.md) is not 0. `simgap schema NAME` prints the exact schema (JSON "
        "Schema, draft 2020-12); the files are in `bench/schemas` and in the wheel. Later versions "
        "only add keys, so ignore unknown ones.",
        "Each section is a command; the last ones are other documents. Indented keys belong to the "
        "object above, or to each object of that list. Types are in parentheses; a plural is "
        "a list. Without a type, *whether* is a boolean, *number of* an integer, anything else a "
        "string. Numbers that are not finite are null; paths are as given.",
    ]
    outliner = Outliner()
    for name in [*commands_of, *others]:
        known = load_schema(name)
        parts.append(f"## {name}")
        if name in OTHER_PAGES:
            parts.append(f"{sentence(known['title'])} {OTHER_PAGES[name]}")
            continue
        if name not in commands_of:
            parts.append(sentence(known["title"]))
        parts += outliner.outline(name, known)
    return page("JSON output of commands", *parts)


# Tuners and public names.


def how_tuners_work():
    """Return the page of all tuners: method, equations, sources and options."""
    return page(
        "How each tuner works",
        "[Choosing a tuner](../choosing-a-tuner.md) compares the tuners; [add a "
        "tuner](../add-a-tuner.md) shows how to write one. The code in `methods/` has the numbers "
        "of the equations. Options show their defaults.",
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
        "how to use them. A `:::` line says where a name is defined; the site shows signature and "
        "docstring there.",
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
