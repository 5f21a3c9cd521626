"""What makes a run, as hashes: the rooms of this project that do, the sources of classes from
elsewhere, the recording, and the packages that compute.

A run's id and the name of a file of trained weights hold these hashes. Whatever made a run and is
missing here would let one run, or one set of weights, be taken for another, so rooms are whole
folders, and a class whose source cannot be told is refused.
"""

from __future__ import annotations

import hashlib
import inspect
import json
import linecache
import platform
import sys
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from importlib.metadata import PackageNotFoundError, entry_points, version
from pathlib import Path
from typing import Any

from bench import __version__
from bench.problem.experiment import Experiment
from bench.problem.recorded import find_recording
from sims import effects
from sims.base import InputError
from sims.engines.compiled import kept

ROOT = Path(__file__).resolve().parents[2]
"""Where this project's packages lie."""
ROOMS = ("methods", "sims", "bench/problem", "bench/runs", "bench/sealing")
"""Folders whose code makes runs: methods, worlds, and what drives and scores them."""
SHOT_ROOMS = (*ROOMS, "bench/shot", "bench/gap", "bench/recordings")
"""Those whose code makes the shots of a bounce shot: its drops, films and explanations too."""
EXPLAIN_ROOMS = (*ROOMS, "bench/misspecified", "bench/gap", "bench/recordings")
"""Those whose code makes a simulator that explain extended, and the runs in it."""
PACKAGES = (
    "av",
    "botorch",
    "cma",
    "llvmlite",
    "mujoco",
    "nlopt",
    "numba",
    "numpy",
    "opencv-python-headless",
    "pybullet",
    "sbi",
    "scikit-learn",
    "scikit-optimize",
    "scipy",
    "torch",
)
"""Packages that compute; another version of one may give other numbers."""
_PLUGIN = "simgap_plugin_"
"""How the modules of plugin files are called (`bench.registry`)."""
_GROUPS = ("simgap.tuners", "simgap.simulators", "simgap.effects", "simgap.diagnosers")
"""The entry points by which installed plugins register."""


def digest(*parts: Any, length: int = 10) -> str:
    """A short hexadecimal hash of plain values, arrays' bytes among them."""
    text = json.dumps(parts, sort_keys=True, default=_plainly)
    return hashlib.sha256(text.encode()).hexdigest()[:length]


def _plainly(value: Any) -> Any:
    if isinstance(value, bytes):
        return hashlib.sha256(value).hexdigest()
    return dict(value) if isinstance(value, Mapping) else str(value)


@cache
def rooms(which: tuple[str, ...] = ()) -> str:
    """Hash of every file of these rooms; of those whose code makes runs where none is named."""
    return digest(__version__, [_contents(ROOT / room, ROOT) for room in which or ROOMS])


def _contents(folder: Path, root: Path) -> list[tuple[str, bytes]]:
    """Place below `root` and content of each file in a folder, without what Python compiles."""
    files = [
        file
        for file in sorted(folder.rglob("*"))
        if file.is_file() and "__pycache__" not in file.parts
    ]
    return [(file.relative_to(root).as_posix(), file.read_bytes()) for file in files]


@cache
def versions() -> str:
    """Hash of the versions of Python and the packages that compute."""
    packages = [package_version(name) for name in PACKAGES]
    return digest(platform.python_version(), packages, kept.is_off())


def package_version(name: str) -> str:
    """Name and version of an installed package, or that it is absent."""
    try:
        return f"{name} {version(name)}"
    except PackageNotFoundError:
        return f"{name} absent"


def plugin_files(plugins: Sequence[str]) -> str:
    """Hash of the names and contents of plugin files."""
    return digest([[Path(p).name, Path(p).read_bytes()] for p in plugins])


def recording_digest(experiment: Experiment) -> str:
    """Hash of the recording's two files; empty where the experiment has none."""
    if experiment.recording is None:
        return ""
    table = find_recording(experiment.recording.path)
    return hashlib.sha256(table.read_bytes() + table.with_suffix(".toml").read_bytes()).hexdigest()


def what_matters(experiment: Experiment, but: Iterable[str]) -> dict[str, Any]:
    """The configuration without the fields that do not matter to what is asked.

    A field that is added to `Experiment` matters until somebody gives a reason why it does not.
    """
    document = experiment.document() | {"name": experiment.name}
    return {name: value for name, value in document.items() if name not in but}


def source(kind: type) -> str:
    """Hash of what a class does, wherever it and the classes that it builds on come from.

    A class of this project's rooms is told by its name alone, since `rooms` holds their content.
    One of a plugin file stands for that file, one of an installed plugin for its whole package,
    one of a notebook's cell or a script for its own text. A class that is made at run time carries
    ``source_digest``, a text that changes with all that went into it, and may name the classes
    that it uses besides its bases in ``made_of``.

    Raises:
        InputError: it has none of these, so that nobody could tell a changed class from this one.
    """
    return digest([(_name(part), _place(part)) for part in _parts(kind)])


def _name(kind: type) -> str:
    """The full name of a class; how a plugin file's module is called depends on what is loaded."""
    plugin = kind.__module__.startswith(_PLUGIN)
    return f"{'plugin' if plugin else kind.__module__}.{kind.__qualname__}"


def _parts(kind: type) -> list[type]:
    """A class, its bases, and the classes it says it is made of."""
    parts: list[type] = []
    waiting = [kind]
    while waiting:
        for part in waiting.pop().__mro__:
            # The standard library is in the version of Python. A base that only describes an
            # interface is found there; a class that a metaclass made merely says it is there.
            if part in parts or (_of_python(part) and _under_its_name(part)):
                continue
            parts.append(part)
            waiting += vars(part).get("made_of", ())
    return parts


def _of_python(kind: type) -> bool:
    top = _top(kind)
    return top in sys.stdlib_module_names and top != "__main__"


def _top(kind: type) -> str:
    return kind.__module__.partition(".")[0]


def _under_its_name(kind: type) -> bool:
    """Whether the module that a class says it is from holds this very class under its name.

    Only then is the module's text the class's: a function may make many classes from one text,
    each with other numbers in it, and `abc` is where every class seems to be from that an abstract
    class's ``type(...)`` made.
    """
    held: Any = sys.modules.get(kind.__module__)
    for name in kind.__qualname__.split("."):
        held = getattr(held, name, None)
    return held is kind


def _place(kind: type) -> Any:
    """What stands for a class in a hash: nothing where `rooms` holds it, else its source.

    Raises:
        InputError: nothing does.
    """
    # Not inherited: a subclass does something else than the class that carries the digest.
    if (own := vars(kind).get("source_digest")) is not None:
        return own
    if not _under_its_name(kind):
        raise _untold(kind)
    if kind.__module__ == "__main__":
        return _text(kind)
    file = getattr(sys.modules[kind.__module__], "__file__", None)
    if file is None:
        raise _untold(kind)
    path = Path(file).resolve()
    if any(path.is_relative_to(ROOT / room) for room in ROOMS):
        return ""
    return _package(kind, path)


def _text(kind: type) -> str:
    """The text of a class of a notebook's cell or of the script that runs."""
    try:
        return inspect.getsource(kind)
    except (OSError, TypeError):
        pass
    # A notebook has no file to look for classes in, but its functions know the text of their cell.
    for function in filter(inspect.isfunction, vars(kind).values()):
        if cell := linecache.getlines(function.__code__.co_filename):
            return "".join(cell)
    raise _untold(kind)


def _package(kind: type, path: Path) -> Any:
    """The contents of an installed plugin's package, else of the file that a class is in."""
    top = sys.modules.get(_top(kind))
    if _top(kind) in _installed() and (folders := getattr(top, "__path__", None)):
        return [_contents(Path(folder), Path(folder)) for folder in folders]
    return path.name, path.read_bytes()


def _untold(kind: type) -> InputError:
    return InputError(
        f"class {kind.__qualname__} of {kind.__module__}: expected a class of a module, a plugin "
        "file or a notebook's cell, found one whose source cannot be told; define it there under "
        "its own name, or give it a text source_digest that changes with all that went into it"
    )


@cache
def _installed() -> frozenset[str]:
    """Top-level packages of installed plugins, this project's own among them."""
    entries = [entry for group in _GROUPS for entry in entry_points(group=group)]
    return frozenset(entry.module.partition(".")[0] for entry in entries)


def effect_sources(*settings: Mapping[str, Any]) -> list[str]:
    """Sources of the effects that settings of a simulator name, which its class does not hold."""
    return [source(effects.get(name)) for name in effect_names(*settings)]


def effect_names(*settings: Mapping[str, Any]) -> list[str]:
    """Names of the effects in ``effects`` and ``fixed`` of these settings, each once, sorted."""
    return sorted(named_effects(*settings) & set(effects.names()))


def named_effects(*settings: Mapping[str, Any]) -> set[str]:
    """All names that stand there, of effects that are known and of such as a plugin may have."""
    names: set[str] = set()
    for table in settings:
        for key in ("effects", "fixed"):
            value = table.get(key, ())
            # What is no list, or no effect, is the simulator's to refuse.
            if isinstance(value, Mapping | Sequence) and not isinstance(value, str):
                # At a place of a robot it is the same effect.
                names.update(name.partition("@")[0] for name in value if isinstance(name, str))
    return names
