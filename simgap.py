"""simgap compares methods that tune a simulator's parameters, and explains what tuning cannot fix.

The one name for users and for authors of plugins, in a script, a notebook and a test::

    import simgap

    run = simgap.compare("ball-drop", tuners=["cma_es", "least_squares"], targets=5)
    found = simgap.explain("swing.csv")
    simgap.simulate("pendulum", effects={"drag.linear": 2e-4}, noise=0.002).write("swing.csv")

    from simgap import Tuner, Force, Friction, Parameter, Channel, OwnSimulator, InputError

Nothing is imported before it is asked for; `dir(simgap)` lists what there is.
"""

from __future__ import annotations

import sys
from importlib import import_module
from importlib.machinery import PathFinder
from os.path import abspath, dirname, realpath

_WHERE = {
    "bench": ("__version__",),
    "bench.api.compare": ("Compared", "compare", "sweep"),
    "bench.api.datasheet": ("datasheet",),
    "bench.api.design": ("NextRecording", "design"),
    "bench.api.explain": ("explain", "score"),
    "bench.api.recordings": ("import_logs", "read_recording", "simulate"),
    "bench.checks": ("parametrize",),
    "bench.gap.explanation": ("Explanation",),
    "bench.gap.sheet.sheet": ("DataSheet",),
    "bench.diagnoser": ("Answer", "Case", "Diagnoser", "Lesson", "Named"),
    "bench.problem.experiment": ("Experiment",),
    "bench.registry": ("diagnosers", "effects", "load_plugins", "simulators", "tuners"),
    "methods.base": (
        "Ask",
        "BudgetExceededError",
        "Evaluation",
        "Practice",
        "Scene",
        "Steps",
        "Task",
        "Tuner",
        "from_callback",
    ),
    "sims.base": (
        "Array",
        "Channel",
        "Constant",
        "InputError",
        "Parameter",
        "Scenario",
        "Simulator",
    ),
    "sims.extended": ("Extended",),
    "sims.own": ("BulletWorld", "OwnSimulator"),
    "sims.recording.recording": ("Recording", "Run"),
    "sims.system": (
        "Coefficient",
        "Contact",
        "Effect",
        "Force",
        "Friction",
        "Hidden",
        "Input",
        "Level",
        "Moment",
        "Sensor",
        "Signal",
        "State",
        "System",
    ),
}
"""Where each public name lives; simgap.pyi says the same to type checkers, and a test compares."""
_MODULE_OF = {name: module for module, names in _WHERE.items() for name in names}
__all__ = sorted([*_MODULE_OF, "main"])


def _refuse_namesakes() -> None:
    """Say in one line whose folder hides one of simgap's own packages, before something odd
    happens.

    Raises:
        ImportError: a package that is called as one of simgap's would be imported in its place.
    """
    home = dirname(realpath(abspath(__file__)))
    for name in ("bench", "methods", "sims"):
        if name in sys.modules:
            places = getattr(sys.modules[name], "__path__", [])
        else:
            spec = PathFinder.find_spec(name)
            places = (spec.submodule_search_locations if spec else None) or []
        for place in places:
            if dirname(realpath(place)) != home:
                raise ImportError(
                    f"simgap cannot be imported here: the package '{name}' in {realpath(place)} "
                    "hides "
                    f"simgap's own; rename that folder, or run from another one"
                )


_refuse_namesakes()


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    from bench.cli import main as run

    return run(arguments)


def __getattr__(name: str) -> object:
    if name not in _MODULE_OF:
        raise AttributeError(f"module 'simgap' has no attribute {name!r}")
    value = getattr(import_module(_MODULE_OF[name]), name)
    globals()[name] = value  # the next time it is found without asking
    return value


def __dir__() -> list[str]:
    return list(__all__)


if __name__ == "__main__":
    sys.exit(main())
