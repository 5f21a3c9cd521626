"""Check private words, docstring beginnings, commit subjects and file names.

`glossary.toml` has the private words, their standard terms and the allowed uses. The check reads
every Python file once: names, docstrings and messages come from its syntax tree, comments from a
regular expression (`tokenize` would take as long as the rest of the check).
"""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from fnmatch import fnmatch
from functools import cache
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

GLOSSARY = Path(__file__).with_name("glossary.toml")
TEXTS = frozenset(("docstrings", "messages", "pages"))
"""Checks of texts; comments belong to docstrings, other string constants are messages."""
SECTIONS = {
    "everywhere": TEXTS | {"identifiers"},
    "identifiers": frozenset(("identifiers",)),
    "texts": TEXTS,
}
"""Checks that forbid the words of each section of the glossary."""
FORBIDDEN_BEGINNING = re.compile(r"\s*(What|The same|Whether|So many|That|Those)\b")
MAX_SUBJECT_LENGTH = 72
"""Maximum length of a commit subject, in characters."""
MAX_EQUAL_BASE_NAMES = 3
"""Maximum number of Python files that have the same base name."""
REPEATABLE_BASE_NAMES = ("__init__", "__main__", "conftest")

_NAME_PART = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+")
_PROSE_WORD = re.compile(r"(?<![\w./-])[A-Za-z]+(?![\w/-])")
"""A word of prose; parts of options, paths, attributes and hyphenated compounds are not words."""
_CODE = re.compile(r"^```.*?^```|``.+?``|`[^`\n]+`", re.MULTILINE | re.DOTALL)
_CODE_OR_LABEL = re.compile(rf"{_CODE.pattern}|^ +\w+:(?=\s)", _CODE.flags)
"""Code, or the name of an argument before its description; names are checked as identifiers."""
_STRING_OR_COMMENT = re.compile(
    r'"""(?:[^"\\]|\\.|"(?!""))*"""|' + r"'''(?:[^'\\]|\\.|'(?!''))*'''|"
    r'"(?:[^"\\\n]|\\.)*"|' + r"'(?:[^'\\\n]|\\.)*'|(?P<comment>\#[^\n]*)",
    re.DOTALL,
)


class Finding(NamedTuple):
    """One violation: the check, the glossary word or rule, the place, and the remedy."""

    check: str
    rule: str
    path: str
    line: int
    found: str
    remedy: str
    name: str = ""

    def __str__(self) -> str:
        """Return the line that is printed."""
        where = f" in '{self.name}'" if self.name else ""
        return f"{self.path}:{self.line}: word '{self.found}'{where}: write '{self.remedy}'"


@dataclass(frozen=True)
class Term:
    """A private word, its standard term and the checks that forbid it."""

    word: str
    standard: str
    checks: frozenset[str]


@dataclass(frozen=True)
class AllowedUse:
    """Legitimate identifiers in files that match a pattern (`*`: all words, also in texts)."""

    names: tuple[str, ...]
    files: tuple[str, ...]
    reason: str

    def covers(self, finding: Finding) -> bool:
        """Return whether the finding is this legitimate use."""
        is_named = "*" in self.names or finding.name in self.names
        return is_named and any(fnmatch(finding.path, pattern) for pattern in self.files)


class Glossary:
    """Private words by their first word, standard phrases that contain one, and allowed uses."""

    def __init__(self, document: dict[str, Any]) -> None:
        """Read the content of a `glossary.toml`."""
        self.allowed = tuple(
            AllowedUse(tuple(entry["names"]), tuple(entry["files"]), entry["reason"])
            for entry in document.get("allowed", [])
        )
        phrases = document.get("standard", {}).get("phrases", [])
        self._standard = [re.compile(phrase) for phrase in phrases]
        self._patterns: dict[str, list[tuple[re.Pattern[str], Term]]] = defaultdict(list)
        for section, words in document["words"].items():
            for forms, standard in words.items():
                term = Term(forms.split(",")[0], standard, SECTIONS[section])
                for form in forms.split(","):
                    pattern = re.compile(r"\s+".join(form.split()) + r"(?![\w/-])")
                    self._patterns[form.split()[0]].append((pattern, term))

    @classmethod
    def load(cls, path: Path = GLOSSARY) -> Glossary:
        """Load the words and the allowed uses from a TOML file."""
        return cls(tomllib.loads(path.read_text(encoding="utf-8")))

    def find(self, text: str, place: str) -> Iterator[tuple[int, str, Term]]:
        """Yield position, found form and term of each private word that `place` forbids."""
        lowered = text.lower()
        if self._patterns.keys().isdisjoint(_PROSE_WORD.findall(lowered)):
            return
        standard = [m.span() for phrase in self._standard for m in phrase.finditer(text)]
        for word in _PROSE_WORD.finditer(lowered):
            start = word.start()
            if any(first <= start < last for first, last in standard):
                continue
            for pattern, term in self._patterns.get(word.group(), ()):
                match = pattern.match(lowered, start)
                if match and place in term.checks:
                    yield start, match.group(), term

    def drop_allowed(self, findings: Iterable[Finding]) -> list[Finding]:
        """Return the findings that no allowed use covers."""
        return [f for f in findings if not any(use.covers(f) for use in self.allowed)]

    @cache  # noqa: B019 (one glossary lives as long as the process)
    def find_in_name(self, name: str) -> tuple[tuple[str, Term], ...]:
        """Return the private words among the parts of a snake_case or CamelCase name."""
        if name.startswith("__") and name.endswith("__"):
            return ()
        parts = " ".join(_NAME_PART.findall(name)).lower()
        place = "docstrings" if parts.startswith("test ") else "identifiers"
        return tuple((found, term) for _, found, term in self.find(parts, place))


def check_tree(root: Path, folders: Sequence[str], glossary: Glossary) -> list[Finding]:
    """Check all Python files and pages of `folders` (or single files) below `root`."""
    paths = sorted(chain.from_iterable(_list_files(root / folder) for folder in folders))
    findings: list[Finding] = []
    for path in paths:
        relative = path.relative_to(root).as_posix()
        text = path.read_text(encoding="utf-8")
        if path.suffix == ".py":
            findings += check_source(text, relative, glossary)
        elif relative == "README.md" or relative.startswith("docs/"):
            findings += _find_in_text(text, 1, None, "pages", relative, glossary)
    findings += check_file_names([p.relative_to(root) for p in paths if p.suffix == ".py"])
    return findings


def check_source(source: str, path: str, glossary: Glossary) -> Iterator[Finding]:
    """Check the names, docstrings, messages and comments of one Python file."""
    stem = Path(path).parent.name if path.endswith("__init__.py") else Path(path).stem
    names = [(1, stem)]
    docstrings: set[ast.AST] = set()
    for node in ast.walk(ast.parse(source)):  # parents before their children
        if isinstance(node, ast.Expr):
            docstrings.add(node.value)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            place = "docstrings" if node in docstrings else "messages"
            beginning = FORBIDDEN_BEGINNING.match(node.value)
            if beginning and place == "docstrings":
                word = beginning.group(1)
                remedy = "an imperative sentence; for a value, a noun or 'True if'"
                yield Finding("beginnings", word, path, node.lineno, word, remedy)
            # A string without a space is a public key, name or option and is not checked.
            if " " in node.value:
                last = node.end_lineno
                yield from _find_in_text(node.value, node.lineno, last, place, path, glossary)
        else:
            names += _list_defined_names(node)
    for line, name in names:
        for found, term in glossary.find_in_name(name):
            yield Finding("identifiers", term.word, path, line, found, term.standard, name)
    for match in _STRING_OR_COMMENT.finditer(source):
        if comment := match.group("comment"):
            line = source.count("\n", 0, match.start()) + 1
            yield from _find_in_text(comment, line, line, "docstrings", path, glossary)


def check_file_names(paths: Iterable[Path]) -> Iterator[Finding]:
    """Find base names that too many files have, and names that differ only by a plural."""
    by_stem: dict[str, list[Path]] = defaultdict(list)
    by_singular: dict[tuple[Path, str], list[Path]] = defaultdict(list)
    for path in paths:
        if path.stem not in REPEATABLE_BASE_NAMES:
            by_stem[path.stem].append(path)
            by_singular[path.parent, re.sub(r"s(?=_|$)", "", path.stem)].append(path)
    for stem, files in by_stem.items():
        for path in files[MAX_EQUAL_BASE_NAMES:]:
            remedy = f"a base name that at most {MAX_EQUAL_BASE_NAMES} files have"
            yield Finding("file names", "frequent", path.as_posix(), 1, stem, remedy)
    for files in by_singular.values():
        for path in files[1:]:
            remedy = f"a name that differs from {files[0].name} by more than a plural"
            yield Finding("file names", "plural", path.as_posix(), 1, path.stem, remedy)


def check_subjects(root: Path, since: str | None) -> list[Finding]:
    """Find subjects that are too long in the commits after `since`.

    By default, `since` is the commit that added this check. Merge commits are exempt, and without
    git history nothing is checked.
    """
    if since and not _git(root, "rev-parse", "--verify", f"{since}^{{commit}}"):
        raise SystemExit(f"--since {since}: expected a commit of {root}; see git log")
    guard = "tests/language/__main__.py"
    since = since or (_git(root, "log", "--diff-filter=A", "--format=%H", "--", guard) or [""])[-1]
    span = ["--ancestry-path", f"{since}..HEAD"]
    lines = _git(root, "log", "--no-merges", "--format=%h %s", *span) if since else []
    subjects = [line.split(" ", 1) for line in lines]
    remedy = f"a subject of at most {MAX_SUBJECT_LENGTH} characters"
    return [
        Finding("subjects", "long", f"commit {commit}", 1, subject, remedy)
        for commit, subject in subjects
        if len(subject) > MAX_SUBJECT_LENGTH
    ]


def _git(root: Path, *arguments: str) -> list[str]:
    """Return the output lines of a git command; none where it fails."""
    command = ["git", "-C", str(root), *arguments]
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return []
    return done.stdout.splitlines()


def _list_files(folder: Path) -> Iterator[Path]:
    """Yield a file itself, or the Python and Markdown files below a folder except hidden ones."""
    for path in [folder] if folder.is_file() else folder.rglob("*"):
        parts = path.relative_to(folder).parts
        hidden = any(part.startswith(".") for part in parts)
        if path.suffix in (".py", ".md") and path.is_file() and not hidden:
            yield path


def _list_defined_names(node: ast.AST) -> Iterator[tuple[int, str]]:
    """Yield line and name of each class, function, parameter, attribute and constant of a node."""
    if isinstance(node, ast.arg):
        yield node.lineno, node.arg
    elif isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store):
        yield node.lineno, node.attr
    elif isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)):
        yield node.lineno, node.name
    if isinstance(node, (ast.Module, ast.ClassDef)):
        for statement in node.body:
            for target in getattr(statement, "targets", [getattr(statement, "target", None)]):
                if isinstance(target, ast.Name):
                    yield target.lineno, target.id


def _find_in_text(
    text: str, first: int, last: int | None, check: str, path: str, glossary: Glossary
) -> Iterator[Finding]:
    """Find private words in the prose of a text that occupies lines `first` to `last`."""
    code = _CODE_OR_LABEL if check == "docstrings" else _CODE
    prose = code.sub(lambda match: "\n" * match.group().count("\n") or " ", text)
    for position, found, term in glossary.find(prose, check):
        line = first + prose.count("\n", 0, position)
        found = " ".join(found.split())
        line = min(line, last or line)
        yield Finding(check, term.word, path, line, found, term.standard)
