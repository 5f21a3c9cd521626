# What type checkers know of simgap.py, which imports nothing before it is asked for.
from collections.abc import Sequence

from bench import __version__
from bench.api.compare import Compared, compare, sweep
from bench.api.datasheet import datasheet
from bench.api.design import NextRecording, design
from bench.api.explain import explain, score
from bench.api.recordings import import_logs, read_recording, simulate
from bench.checks import parametrize
from bench.diagnoser import Answer, Case, Diagnoser, Lesson, Named
from bench.gap.explanation import Explanation
from bench.gap.sheet.sheet import DataSheet
from bench.problem.experiment import Experiment
from bench.registry import diagnosers, effects, load_plugins, simulators, tuners
from methods.base import (
    Ask,
    BudgetExceededError,
    Evaluation,
    Practice,
    Scene,
    Steps,
    Task,
    Tuner,
    from_callback,
)
from sims.base import (
    Array,
    Channel,
    Constant,
    InputError,
    Parameter,
    Scenario,
    Simulator,
)
from sims.extended import Extended
from sims.own import BulletWorld, OwnSimulator
from sims.recording.recording import Recording, Run
from sims.system import (
    Coefficient,
    Contact,
    Effect,
    Force,
    Friction,
    Hidden,
    Input,
    Level,
    Moment,
    Sensor,
    Signal,
    State,
    System,
)

__all__ = [
    "Answer",
    "Array",
    "Ask",
    "BudgetExceededError",
    "BulletWorld",
    "Case",
    "Channel",
    "Coefficient",
    "Compared",
    "Constant",
    "Contact",
    "DataSheet",
    "Diagnoser",
    "Effect",
    "Evaluation",
    "Experiment",
    "Explanation",
    "Extended",
    "Force",
    "Friction",
    "Hidden",
    "Input",
    "InputError",
    "Lesson",
    "Level",
    "Moment",
    "Named",
    "NextRecording",
    "OwnSimulator",
    "Parameter",
    "Practice",
    "Recording",
    "Run",
    "Scenario",
    "Scene",
    "Sensor",
    "Signal",
    "Simulator",
    "State",
    "Steps",
    "System",
    "Task",
    "Tuner",
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
