"""List the public names on their page; the site generator reads the docstrings from the source."""

import inspect

import simgap
from bench.api.comparison_options import ComparisonOptions, StudyOptions
from bench.api.datasheet import DatasheetOptions
from bench.api.design import DesignOptions
from bench.diagnosis.explain_options import ExplainOptions
from bench.logs.importing.import_result import ImportOptions
from bench.logs.importing.log_import import ImportRequest
from bench.logs.synthetic_recording import SimulationSpec
from sims.recording.recording_frame import FrameDescription

GROUPS = {
    "Commands": (
        "What the commands do, as functions.",
        "compare sweep explain simulate score design datasheet import_logs read_recording "
        "load_plugins parametrize",
    ),
    "What they give back": (
        "Results, with tables as frames and figures as matplotlib figures.",
        "ComparisonResult Explanation NextRecording DataSheet ExtendedSimulator Recording Run "
        "Experiment",
    ),
    "For tuners": (
        "The contract of a [tuner](../add-a-tuner.md).",
        "Tuner Task Proposal Evaluation TrainingSimulator ScenarioInfo from_callback "
        "BudgetExceededError",
    ),
    "For simulators": (
        "The contract of a simulator, and of [one's own](../own-simulator.md).",
        "Simulator Parameter Channel Constant Scenario OwnSimulator BulletWorld System",
    ),
    "For effects": (
        "The contract of an [effect](../../sims/effects/README.md), by hook.",
        "Effect Coefficient Force Friction Contact Input Sensor Level HiddenStateEffect "
        "HiddenState StateSnapshot Signal",
    ),
    "For diagnosers": (
        "The contract of a [diagnoser](../diagnosers.md).",
        "Diagnoser DiagnosisCase Answer NamedCause DiagnoserTrainingTask",
    ),
    "Faults": ("Errors that the user has to correct.", "InputError"),
}
"""Headings of the page: introductory sentence and names."""
OPTIONS = (
    ExplainOptions,
    DesignOptions,
    DatasheetOptions,
    FrameDescription,
    SimulationSpec,
    ImportRequest,
    ImportOptions,
    ComparisonOptions,
    StudyOptions,
)
"""Classes whose attributes are the keyword arguments of functions and the options of commands."""
UNDOCUMENTED = {
    "Array",
    "TunerGenerator",
    "__version__",
    "main",
    "tuners",
    "simulators",
    "effects",
} | {"diagnosers"}
"""Aliases and objects without a docstring; the tables of docs/python.md describe them."""


def listed():
    """Return every name on the page."""
    return [name for _, names in GROUPS.values() for name in names.split()]


def sections():
    """Return the sections of the page.

    Each name is one line, which the site generator replaces by signature and docstring.
    """
    parts = []
    for heading, (says, names) in GROUPS.items():
        parts += [f"## {heading}", says]
        parts += [f"::: {address(getattr(simgap, name))}" for name in names.split()]
        if heading == "Commands":
            parts += ["## Keyword arguments", "The options of these functions, by name."]
            parts += [f"::: {address(options)}" for options in OPTIONS]
    return parts


def address(thing):
    """Return the module path and name of the definition of a class or function."""
    return f"{inspect.unwrap(thing).__module__}.{thing.__qualname__}"
