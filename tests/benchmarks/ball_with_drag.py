"""Measure the density of code: ``python -m tests.benchmarks.ball_with_drag [FOLDER ...]``.

For each folder of Python files, print the share of lines with a comment (without comments to tools,
such as `noqa`), tokens per line of code (without docstrings), comprehensions per hundred lines of
code, lines of more than 100 characters, and the lengths of functions (median, 95th percentile,
maximum).
"""

import ast
import io
import sys
import tokenize
from pathlib import Path

FOLDERS = ("bench/diagnosis", "bench", "methods", "sims", "bench methods sims")
WIDTH = 100
_TO_TOOLS = ("noqa", "type:", "fmt:", "pragma:", "!")
_NO_CODE = (tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER)
_COMPREHENSIONS = (ast.ListComp, ast.SetComp, ast.DictComp, ast.GeneratorExp)


def measured(files):
    """Return the figures over all `files`, by name."""
    lines = comments = code = tokens = wide = comprehensions = 0
    lengths = []
    for file in files:
        text = file.read_text(encoding="utf-8")
        tree = ast.parse(text)
        lines += text.count("\n")
        wide += sum(len(line) > WIDTH for line in text.splitlines())
        comprehensions += sum(isinstance(node, _COMPREHENSIONS) for node in ast.walk(tree))
        lengths += [
            node.end_lineno - node.lineno + 1
            for node in ast.walk(tree)
            if isinstance(node, ast.FunctionDef)
        ]
        docstrings = _docstrings(tree)
        rows = set()
        for token in tokenize.generate_tokens(io.StringIO(text).readline):
            if token.type == tokenize.COMMENT:
                comments += not token.string.lstrip("# ").startswith(_TO_TOOLS)
            elif token.type not in _NO_CODE and token.start[0] not in docstrings:
                tokens += 1
                rows.update(range(token.start[0], token.end[0] + 1))
        code += len(rows)
    lengths.sort()
    return {
        "lines": lines,
        "comment lines [%]": 100 * comments / lines,
        "tokens a code line": tokens / code,
        "comprehensions / 100": 100 * comprehensions / code,
        f"lines > {WIDTH}": wide,
        "function: median": lengths[len(lengths) // 2],
        "95th": lengths[int(0.95 * len(lengths))],
        "longest": lengths[-1],
    }


def _docstrings(tree):
    """Return the first lines of strings that are statements, that is, docstrings."""
    return {
        node.lineno
        for node in ast.walk(tree)
        if isinstance(node, ast.Expr)
        and isinstance(node.value, ast.Constant)
        and isinstance(node.value.value, str)
    }


def files_of(folders):
    """Return all Python files in folders, which are separated by spaces."""
    return [file for folder in folders.split() for file in sorted(Path(folder).rglob("*.py"))]


def main(folders):
    rows = {folder: measured(files_of(folder)) for folder in folders or FOLDERS}
    names = list(next(iter(rows.values())))
    print(f"{'':20}" + "".join(f"{name:>22}" for name in names))
    for folder, row in rows.items():
        print(f"{folder:20}" + "".join(f"{row[name]:22.4g}" for name in names))


if __name__ == "__main__":
    main(sys.argv[1:])
