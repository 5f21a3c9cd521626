# What type checkers know of simgap.py, which imports nothing before it is asked for.
from collections.abc import Sequence

from bench import __version__
from bench.api.compare import compare, sweep
from bench.api.comparison_result import ComparisonResult
from bench.api.datasheet import datasheet
from bench.api.design import NextRecording, design
from bench.api.explain import explain
from bench.api.recordings import read_recording, simulate
from bench.api.score import score
from bench.benchmark.problem.experiment_config import Experiment
from bench.conformance import parametrize
from bench.core.diagnoser import Answer, Diagnoser, DiagnoserTrainingTask, DiagnosisCase, NamedCause
from bench.core.plugin_registries import diagnosers, effects, load_plugins, simulators, tuners
from bench.diagnosis.datasheet.datasheet import DataSheet
from bench.diagnosis.explanation import Explanation
from bench.logs.importing.log_import import import_logs
from methods.tuner import (
    BudgetExceededError,
    Evaluation,
    Proposal,
    ScenarioInfo,
    Task,
    TrainingSimulator,
    Tuner,
    TunerGenerator,
    from_callback,
)
from sims.core.effect import (
    Coefficient,
    Contact,
    Effect,
    Force,
    Friction,
    HiddenState,
    HiddenStateEffect,
    Input,
    Level,
    Sensor,
    Signal,
)
from sims.core.simulator import Array, Channel, Constant, InputError, Parameter, Scenario, Simulator
from sims.core.system import StateSnapshot, System
from sims.extended_simulator import ExtendedSimulator
from sims.own_simulator import BulletWorld, OwnSimulator
from sims.recording.recording import Recording, Run

__all__ = [
    "Answer",
    "Array",
    "BudgetExceededError",
    "BulletWorld",
    "Channel",
    "Coefficient",
    "ComparisonResult",
    "Constant",
    "Contact",
    "DataSheet",
    "Diagnoser",
    "DiagnoserTrainingTask",
    "DiagnosisCase",
    "Effect",
    "Evaluation",
    "Experiment",
    "Explanation",
    "ExtendedSimulator",
    "Force",
    "Friction",
    "HiddenState",
    "HiddenStateEffect",
    "Input",
    "InputError",
    "Level",
    "NamedCause",
    "NextRecording",
    "OwnSimulator",
    "Parameter",
    "Proposal",
    "Recording",
    "Run",
    "Scenario",
    "ScenarioInfo",
    "Sensor",
    "Signal",
    "Simulator",
    "StateSnapshot",
    "System",
    "Task",
    "TrainingSimulator",
    "Tuner",
    "TunerGenerator",
    "__version__",
    "compare",
    "datasheet",
    "design",
    "diagnosers",
    "effects",
    "explain",
    "from_callback",
    "import_logs",
    "load_plugins",
    "main",
    "parametrize",
    "read_recording",
    "score",
    "simulate",
    "simulators",
    "sweep",
    "tuners",
]

def main(arguments: Sequence[str] | None = None) -> int: ...
