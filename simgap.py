"""Compare methods that tune a simulator's parameters, and explain what tuning cannot fix.

This module has all public names for users and for authors of plugins, in a script, a notebook and a
test::

    import simgap

    run = simgap.compare("ball-drop", tuners=["cma_es", "least_squares"], targets=10)
    found = simgap.explain("swing.csv")
    simgap.simulate("pendulum", effects={"drag.linear": 2e-4}, noise=0.002).write("swing.csv")

    from simgap import Tuner, Force, Friction, Parameter, Channel, OwnSimulator, InputError

Names are imported when they are first used; `dir(simgap)` lists them.
"""

from __future__ import annotations

import sys
import warnings
from importlib import import_module
from importlib.machinery import PathFinder
from os.path import abspath, dirname, realpath

_WHERE = {
    "bench": ("__version__",),
    "bench.api.compare": ("compare", "sweep"),
    "bench.api.comparison_result": ("ComparisonResult",),
    "bench.api.datasheet": ("datasheet",),
    "bench.api.design": ("NextRecording", "design"),
    "bench.api.explain": ("explain",),
    "bench.api.recordings": ("read_recording", "simulate"),
    "bench.api.score": ("score",),
    "bench.logs.importing.log_import": ("import_logs",),
    "bench.conformance": ("parametrize",),
    "bench.diagnosis.explanation": ("Explanation",),
    "bench.diagnosis.datasheet.datasheet": ("DataSheet",),
    "bench.core.diagnoser": (
        "Answer",
        "DiagnosisCase",
        "Diagnoser",
        "DiagnoserTrainingTask",
        "NamedCause",
    ),
    "bench.benchmark.problem.experiment_config": ("Experiment",),
    "bench.core.plugin_registries": (
        "diagnosers",
        "effects",
        "load_plugins",
        "simulators",
        "tuners",
    ),
    "methods.tuner": (
        "Proposal",
        "BudgetExceededError",
        "Evaluation",
        "TrainingSimulator",
        "ScenarioInfo",
        "TunerGenerator",
        "Task",
        "Tuner",
        "from_callback",
    ),
    "sims.core.simulator": (
        "Array",
        "Channel",
        "Constant",
        "InputError",
        "Parameter",
        "Scenario",
        "Simulator",
    ),
    "sims.extended_simulator": ("ExtendedSimulator",),
    "sims.own_simulator": ("BulletWorld", "OwnSimulator"),
    "sims.recording.recording": ("Recording", "Run"),
    "sims.core.effect": (
        "Coefficient",
        "Contact",
        "Effect",
        "Force",
        "Friction",
        "HiddenStateEffect",
        "Input",
        "Level",
        "Sensor",
        "Signal",
        "HiddenState",
    ),
    "sims.core.system": ("StateSnapshot", "System"),
}
"""Public names by module; simgap.pyi declares the same for type checkers, and a test compares."""
_MODULE_OF = {name: module for module, names in _WHERE.items() for name in names}
__all__ = sorted([*_MODULE_OF, "main"])
_RENAMED = {
    "Ask": "Proposal",
    "Case": "DiagnosisCase",
    "Compared": "ComparisonResult",
    "Extended": "ExtendedSimulator",
    "Hidden": "HiddenStateEffect",
    "Lesson": "DiagnoserTrainingTask",
    "Moment": "StateSnapshot",
    "Named": "NamedCause",
    "Practice": "TrainingSimulator",
    "Scene": "ScenarioInfo",
    "State": "HiddenState",
    "Steps": "TunerGenerator",
}
"""New name of each public name that has been renamed; the old name still works, with a warning."""


def _hidden_package() -> str:
    """Return a message if a file or folder hides one of simgap's own packages."""
    # There are two, because an installer may link each file to a cache (uv's mode "symlink").
    homes = {realpath(dirname(abspath(__file__))), dirname(realpath(__file__))}
    for name in ("bench", "methods", "sims"):
        module = sys.modules.get(name)
        spec = PathFinder.find_spec(name) if module is None else getattr(module, "__spec__", None)
        if module is None and spec is None:
            continue  # another finder provides it, as in an editable install
        folders = list(spec.submodule_search_locations or ()) if spec is not None else []
        file = getattr(module, "__file__", None) or (spec.origin if spec is not None else None)
        for place in map(realpath, folders or [file or "<a module without a file>"]):
            if dirname(place) not in homes or not folders:
                what = "folder" if folders else "file"
                return (
                    f"simgap cannot be imported here: the {what} {place} hides simgap's own "
                    f"package '{name}'; rename that {what}, or move your script out of its folder"
                )
    return ""


if _hidden := _hidden_package():
    if __name__ == "__main__":
        sys.stderr.write(f"simgap: error: {_hidden}\n")
        sys.exit(2)
    raise ImportError(_hidden)


def main(arguments: list[str] | None = None) -> int:
    """Run the command line, and return the exit code."""
    from bench.cli.main import main as run

    return run(arguments)


def __getattr__(name: str) -> object:
    """Import a public name when it is first used, so that ``import simgap`` is fast.

    An old name gives a deprecation warning and the object of the new name.
    """
    if name in _RENAMED:
        new = _RENAMED[name]
        warnings.warn(
            f"simgap.{name} has been renamed: use simgap.{new}", DeprecationWarning, stacklevel=2
        )
        return getattr(sys.modules[__name__], new)
    if name not in _MODULE_OF:
        raise AttributeError(f"module 'simgap' has no attribute {name!r}")
    value = getattr(import_module(_MODULE_OF[name]), name)
    globals()[name] = value  # the next access finds the name without this function
    return value


def __dir__() -> list[str]:
    return list(__all__)


if __name__ == "__main__":
    sys.exit(main())
