"""Cases of ball, pendulum and slider, drawn as for the comparison of diagnosers.

Scipy and MuJoCo make the recordings, never the engine that `explain` uses.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bench.diagnosis_benchmark.case_generation import reference_simulation, refitted_residuals
from bench.diagnosis_benchmark.case_generation.benchmark_case import BenchmarkCase
from bench.diagnosis_benchmark.case_generation.case_sampling import (
    SUBTHRESHOLD_SIZES,
    SYSTEMS,
    draw_case,
    restore_conditions,
)
from bench.diagnosis_benchmark.case_generation.equivalent_effects import find_equivalent_effects
from bench.diagnosis_benchmark.case_generation.recording_conditions import SIMULATORS
from bench.diagnosis_benchmark.case_generation.reference_simulation import UNMODELLED_CAUSES
from bench.diagnosis_benchmark.case_set import write_case
from bench.diagnosis_benchmark.grading import MAX_SET_SIZE, grade_answer
from sims import effects as library
from tests.exams.exam import (
    Case,
    Exam,
    Question,
    Target,
    UndrawableError,
    conditions_text,
    hidden_text,
    number,
)
from tests.exams.marking import HiddenCause, Standard, mark_answer

# Questions per system, effect, system and unmodelled cause.
CLEAN, EACH, DOUBLE, EACH_FOREIGN = 105, 4, 15, 4
ATTEMPTS = 8  # Maximum number of drawings of a question whose cause is not visible.
MAX_COMPETING_CAUSES = 6  # Maximum number of other causes of a set that are refitted.
# Sets are fair if there are less than four sigmas of evidence against every other member.
STANDARD = Standard(max_set=MAX_SET_SIZE, equal_below=4.0, small_sets_are_fair=True)
QUICK = (
    ("single", "ball", "restitution.speed", 3.0), ("single", "ball", "drag.quadratic", 4.0),
    ("single", "pendulum", "friction.coulomb", 3.0), ("single", "pendulum", "input.delay", 5.0),
    ("single", "slider", "spring.linear", 3.0), ("single", "slider", "input.deadband", 5.0),
    ("foreign", "ball", "updraft", None), ("foreign", "pendulum", "gust", None),
    ("foreign", "slider", "patch", None),
)  # fmt: skip


@dataclass(frozen=True)
class SystemQuestion(Question):
    """Specification of a case.

    `part` is "marks", or "power" for the power curve only; `index` distinguishes questions of the
    same kind.
    """

    part: str
    kind: str
    system: str
    effect: str | None
    index: int
    size: float | None = None

    @property
    def name(self):
        return f"{self.part}/{self.kind}/{self.system}/{self.effect or 'any'}/{self.index}"

    def draw(self, seed=0):
        """Return the first drawing whose cause is visible."""
        first = 1000 * seed + 10 * self.index
        for attempt in range(ATTEMPTS):
            item = draw_case(self.kind, self.system, first + attempt, self.effect, self.size)
            if item is not None:
                return SystemCase(item, self.part)
        raise UndrawableError("base parameters or initial states absorb the cause")


@dataclass(frozen=True)
class SystemCase(Case):
    """A benchmark case whose recording is written without its name, which reveals the cause."""

    item: BenchmarkCase
    part: str = "marks"

    def write(self, folder):
        path = write_case(self.item, folder, truth=False)
        path.with_suffix(".toml").rename(path.with_name("recording.toml"))
        return path.rename(path.with_name("recording.csv"))

    def describe(self):
        item = self.item
        conditions = conditions_text(
            part=self.part, stated=item.stated, rate=item.rate, seconds=item.seconds,
            runs=item.runs, source=item.source, driven=item.driven,
            channels=" ".join(item.channels), beyond=number(item.beyond), case=item.name,
        )  # fmt: skip
        hidden = hidden_text(item.effects)
        size = number(item.size)
        return {"hidden": hidden, "size": size, "noise": item.noise, "conditions": conditions}

    def mark(self, outcome):
        item = self.item
        hidden_cause = HiddenCause(
            item.kind,
            item.effects,
            lambda name: find_equivalent_effects(item.system, item.driven, name),
        )
        covered = grade_answer(item, outcome.verdict).covered
        return mark_answer(hidden_cause, outcome.verdict, STANDARD, self._sigmas_against, covered)

    def _sigmas_against(self, sets):
        """Return sigmas of evidence against the other members of a set, refitted to clean data."""
        item = self.item
        if item.kind != "single":
            return {}
        names = [name for names in sets for name in names if name not in item.effects]
        setting = restore_conditions(item)
        observed = reference_simulation.simulate_observations(setting, item.effects)
        phi = setting.noise.phi if item.noise == "ar1" else 0.0
        samples = observed.size * (1 - phi) / (1 + phi)  # Effective number with AR(1) noise.
        return {
            name: refitted_residuals.compute_refitted_residual(setting, observed, name)
            * samples**0.5
            for name in names[:MAX_COMPETING_CAUSES]
        }


def questions(seed=0):
    """Return all questions of a full exam."""
    effects = [
        (system, name)
        for system in SYSTEMS
        for name in sorted(library.list_effects_for(SIMULATORS[system].system))
    ]
    sheet = [SystemQuestion("marks", "clean", s, None, k) for s in SYSTEMS for k in range(CLEAN)]
    sheet += [
        SystemQuestion("marks", "single", system, name, k, _size(seed, system, name, k))
        for system, name in effects
        for k in range(EACH)
    ]
    sheet += [SystemQuestion("marks", "double", s, None, k) for s in SYSTEMS for k in range(DOUBLE)]
    sheet += [
        SystemQuestion("marks", "foreign", system, name, k)
        for system in SYSTEMS
        for name in UNMODELLED_CAUSES[system]
        for k in range(EACH_FOREIGN)
    ]
    sizes = SUBTHRESHOLD_SIZES
    return sheet + [
        SystemQuestion("power", "single", system, name, 0, sizes[place % len(sizes)])
        for place, (system, name) in enumerate(effects)
    ]


def quick():
    """Return a few questions of every kind."""
    sheet = [SystemQuestion("marks", "clean", system, None, k) for k, system in enumerate(SYSTEMS)]
    sheet += [SystemQuestion("marks", kind, s, name, 0, size) for kind, s, name, size in QUICK]
    # The slider's pair takes minutes, so only the full exam contains it.
    return sheet + [SystemQuestion("marks", "double", s, None, 0) for s in SYSTEMS[:2]]


def spread():
    """Return the first question of each effect and unmodelled cause, and one clean question."""
    return [q for q in questions() if q.index == 0 and q.part == "marks"]


def _size(seed, system, name, index):
    """Return a size from 1 to 10; sizes of an effect are evenly spread on a logarithmic scale."""
    rng = np.random.default_rng([seed, index, *f"{system} {name}".encode()])
    return float(f"{10 ** ((index % EACH + rng.random()) / EACH):.3g}")


EXAM = Exam(
    "The exam of `simgap explain` on ball, pendulum and slider",
    "Recordings of independent simulators (scipy and MuJoCo), in each one hidden effect, two, a "
    "cause that the library does not have, or none.",
    questions,
    (
        Target("single effects at 1 x the noise or more: named alone", "single", "strict"),
        Target("the same, or in a set of at most 2", "single", "few", 0.97),
        Target("the same, equivalent effects counted as one", "single", "equivalent", 0.97),
        Target(
            "the same, or in a larger set whose other members explain the data equally well",
            "single", "fair", 0.97,
        ),
        Target("two effects: both found", "double", "few", 0.85),
        Target("the same, equivalent effects counted as one", "double", "equivalent", 0.85),
        Target("a cause outside the library: unknown or partial", "foreign", "strict", 0.95),
    ),
    quick, spread, ("size", "system", "noise", "stated", "source", "effect"), cpu_limit=600.0,
)  # fmt: skip
