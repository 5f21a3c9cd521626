"""Find tests that are slow, or whose results may depend on the recordings next to the clone."""

import ast
import re

READS_DATA = re.compile(
    "SIMGAP_(DATA|ROBOTS|SHARED)|[\"']shared[\"']|pendulum-real|robot-so101|simgap list"
    "|list_experiment_names"
)
"""Pattern of code whose results may depend on the real recordings."""


MARKED = re.compile(r"\bmark\.(slow|data)\b|\brecordings\b")
"""Pattern of files with tests that are marked as slow, or use the fixture `recordings`."""


def can_be_slow_or_data(source):
    """Return whether tests of a file can be marked as slow or data-dependent.

    Args:
        source: Source of a test file.
    """
    return bool(MARKED.search(source)) or bool(find_data_dependent_names(source))


def find_data_dependent_names(source):
    """Return the names of a module's functions and constants that depend on the recordings.

    Such a definition contains `READS_DATA`, or refers to another one that depends on them: by a
    name, by a parameter (of a fixture) or by a text (of a marker). A fixture that all tests use
    makes every definition dependent.

    Args:
        source: Source of a test file.
    """
    if not READS_DATA.search(source):
        return set()
    lines, texts, references, all_use = source.splitlines(), {}, {}, set()
    for node in ast.parse(source).body:
        decorators = getattr(node, "decorator_list", [])
        first = min([node.lineno, *(decorator.lineno for decorator in decorators)])
        text = "\n".join(lines[first - 1 : node.end_lineno])
        for name in _defined_names(node):
            texts[name] = text
            references[name] = set(_referred_names(node))
            if any("autouse=True" in ast.unparse(decorator) for decorator in decorators):
                all_use.add(name)
    dependent = {name for name, text in texts.items() if READS_DATA.search(text)}
    while True:
        more = {name for name in texts if references[name] & dependent} - dependent
        if not more:
            return set(texts) if dependent & all_use else dependent
        dependent |= more


def _defined_names(node):
    if isinstance(node, ast.Assign):
        return [
            n.id for target in node.targets for n in ast.walk(target) if isinstance(n, ast.Name)
        ]
    if isinstance(node, ast.AnnAssign):
        return [node.target.id]
    return [node.name] if hasattr(node, "name") else []


def _referred_names(node):
    for part in ast.walk(node):
        if isinstance(part, ast.Name):
            yield part.id
        elif isinstance(part, ast.arg):
            yield part.arg
        elif isinstance(part, ast.Constant) and isinstance(part.value, str):
            yield part.value
