"""Tests that each language check finds a faulty example and accepts a correct one."""

import subprocess
from pathlib import Path

import pytest

from tests.language.__main__ import main
from tests.language.checks import Glossary, check_source, check_subjects, check_tree

CLEAN = '''"""Fit all candidate models with Levenberg-Marquardt."""

MAX_CAUSES = 3  # Maximum number of causes in one model.


def fit_models(batch_element: int, least_squares: bool = False) -> str:
    """Fit the models of one batch element; `told` in backticks is code."""
    key = "told"  # A string without a space is a key.
    return f"{key}: at least {MAX_CAUSES} models, none of them is None"
'''
BROKEN = {
    "function": ("def told_lines(): ...", "identifiers", "told", 1),
    "class": ("class LaneCache: ...", "identifiers", "lane", 1),
    "parameter": ("def fit(*, told): ...", "identifiers", "told", 1),
    "constant": ("MOST_CAUSES = 3", "identifiers", "most", 1),
    "attribute": ("def f(self):\n    self.rival = 1", "identifiers", "rival", 2),
    "test": ("def test_what_is_told_is_kept(): ...", "identifiers", "told", 1),
    "docstring": ('def f():\n    """Fit.\n\n    Of each lane.\n    """', "docstrings", "lane", 4),
    "comment": ('x = "#"  # A noise that remembers.', "docstrings", "remembers", 1),
    "two lines": ('"""Return so\nmany samples."""', "docstrings", "so many", 1),
    "message": ('print(f"{1} is told")', "messages", "told", 1),
    "joined": ('print("it hangs "\n      "on the data")', "messages", "hangs on", 1),
    "beginning": ('x = 1\n"""The same of a fit."""', "beginnings", "The same", 2),
}
"""Source, check, word and line of the only finding, by name."""


@pytest.fixture(scope="module")
def glossary() -> Glossary:
    """Load the project's glossary."""
    return Glossary.load()


def write_files(root: Path, files: dict[str, str]) -> Path:
    """Write files below a folder."""
    for name, text in files.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(text, encoding="utf-8")
    return root


@pytest.mark.parametrize("name", BROKEN)
def test_private_words_and_beginnings_are_found(name, glossary):
    source, check, word, line = BROKEN[name]
    findings = list(check_source(source, "bench/subject.py", glossary))
    assert [f[:4] for f in findings] == [(check, word, "bench/subject.py", line)]


def test_every_word_of_the_glossary_is_found(glossary):
    for terms in glossary._patterns.values():
        for pattern, term in terms:
            form = pattern.pattern.split("(?!")[0].replace(r"\s+", " ")
            for check in term.checks:
                found = [found for _, found, _ in glossary.find(f"x {form} y", check)]
                assert form in found, (form, check)


@pytest.mark.parametrize("file", ["docs/robots.md", "README.md"])
def test_private_words_are_found_on_pages_and_not_in_their_code(file, glossary, tmp_path):
    write_files(tmp_path, {file: "# Robots\n\n```\ntold\n```\n\nOne lane, `told`, --told.\n"})
    findings = check_tree(tmp_path, ["docs", "README.md"], glossary)
    assert [f[:4] for f in findings] == [("pages", "lane", file, 7)]
    assert str(findings[0]) == f"{file}:7: word 'lane': write 'batch element'"


def test_frequent_base_names_and_plurals_are_found(glossary, tmp_path):
    frequent = {f"bench/{folder}/explain.py": "" for folder in "abcd"}
    plural = {"sims/run_file.py": "", "sims/runs_file.py": ""}
    repeatable = {f"sims/{folder}/__init__.py": "" for folder in "abcd"}
    write_files(tmp_path, {**frequent, **plural, **repeatable})
    findings = check_tree(tmp_path, ["bench", "sims"], glossary)
    assert [f[:3] for f in findings] == [
        ("file names", "frequent", "bench/d/explain.py"),
        ("file names", "plural", "sims/runs_file.py"),
    ]


def test_long_subjects_after_the_commit_of_the_check_are_found(tmp_path):
    def git(*arguments: str) -> None:
        names = ["-c", "user.name=A", "-c", "user.email=a@example.org", "-c", "commit.gpgsign=no"]
        subprocess.run(["git", "-C", str(tmp_path), *names, *arguments], check=True)

    def commit(subject: str) -> None:
        git("commit", "--quiet", "--allow-empty", "-m", subject)

    assert check_subjects(tmp_path, None) == []  # no history
    git("init", "--quiet")
    commit("old: " + "x" * 80)
    write_files(tmp_path, {"tests/language/__main__.py": "\n"})
    git("add", ".")
    commit("tests: add the check")
    commit("a" * 72)
    git("checkout", "--quiet", "-b", "side")
    commit("side")
    git("checkout", "--quiet", "-")
    git("merge", "--quiet", "--no-ff", "-m", "m" * 80, "side")
    assert check_subjects(tmp_path, None) == []
    commit("b" * 73)
    (finding,) = check_subjects(tmp_path, None)
    assert finding.found == "b" * 73
    assert check_subjects(tmp_path, "HEAD") == []
    with pytest.raises(SystemExit, match="nowhere"):
        check_subjects(tmp_path, "nowhere")


def test_allowed_uses_are_dropped(glossary):
    def kept(path: str, name: str) -> int:
        return len(glossary.drop_allowed(check_source(f"def f({name}): ...", path, glossary)))

    assert kept("bench/diagnosis/explain_options.py", "pieces") == 0
    assert kept("bench/diagnosis/explain_options.py", "max_pieces") == 1
    assert kept("bench/api/compare.py", "pieces") == 1


def test_names_of_arguments_are_checked_as_identifiers_only(glossary):
    source = 'def f():\n    """Fit.\n\n    Args:\n        told: the told values.\n    """\n'
    assert [finding.line for finding in check_source(source, "bench/f.py", glossary)] == [5]


@pytest.mark.parametrize(
    ("source", "code", "last_lines"),
    [
        (CLEAN, 0, ["0 findings"]),
        (
            "told = 1\ntold_lines = 2\n",
            1,
            [
                "bench/model_fit.py:2: word 'told' in 'told_lines': write 'specified, reported'",
                "2 findings",
            ],
        ),
    ],
    ids=["clean", "two findings"],
)
def test_findings_are_printed_and_give_exit_code_1(tmp_path, capsys, source, code, last_lines):
    root = write_files(tmp_path, {"bench/model_fit.py": source, "README.md": "# Fit models\n"})
    assert main(["--root", str(root), "bench", "README.md"]) == code
    assert capsys.readouterr().out.splitlines()[-len(last_lines) :] == last_lines
