"""Find the packages that the fork server imports before the code of a tuner runs."""

from __future__ import annotations

import ast
import importlib.util
from functools import cache
from pathlib import Path

_PRELOADABLE_PACKAGES = (
    "bench", "botorch", "cma", "gpytorch", "linear_operator", "methods", "nlopt", "numpy", "pandas",
    "pysindy", "sbi", "scipy", "sims", "skopt", "sklearn", "statsmodels", "torch",
)  # fmt: skip
"""Packages that may be imported before a run: simgap's own and those that it requires.

Other packages that a plugin imports are imported anew in each run, because they could store
information from an earlier run.
"""


def find_source_file(module: str) -> str:
    """Return the source file of a module of a package that the fork server may import in advance.

    Empty for modules of other packages, such as plugins: locating them could execute their code.
    """
    top = module.partition(".")[0]
    if top not in _PRELOADABLE_PACKAGES:
        return ""
    spec = importlib.util.find_spec(module)
    return (spec.origin or "") if spec else ""


@cache
def find_preloadable_packages(file: str) -> tuple[str, ...]:
    """Return the known packages that a source file imports, directly or through simgap's tuners.

    The fork server imports them once, so that not every run has to. The files are only parsed;
    code of a plugin must not run here.
    """
    packages: dict[str, None] = {}
    files = [file]
    while files:
        for name in _list_imported_modules(files.pop()):
            if name.partition(".")[0] in _PRELOADABLE_PACKAGES and name not in packages:
                packages[name] = None
                if name.startswith("methods."):
                    files.append(find_source_file(name))
    return tuple(packages)


def _list_imported_modules(file: str) -> list[str]:
    """List the modules that a source file imports anywhere, without executing it.

    Relative imports are left out. A file that cannot be read or parsed gives an empty list; its
    error is reported when the tuner is built.
    """
    try:
        tree = ast.parse(Path(file).read_bytes())
    # A deeply nested file can exceed the limits of the parser.
    except (OSError, SyntaxError, ValueError, RecursionError, MemoryError):
        return []
    names: list[str] = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            names.append(node.module)
    return names
