"""Questions of the exam; drawing a question gives a benchmark case."""

from __future__ import annotations

import hashlib
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from bench.diagnosis_benchmark.case_generation import reference_simulation
from bench.diagnosis_benchmark.case_generation.case_sampling import (
    SUBTHRESHOLD_SIZES,
    SYSTEMS,
    draw_case,
)
from bench.diagnosis_benchmark.case_generation.reference_simulation import (
    SIMULATORS,
    UNMODELLED_CAUSES,
)
from sims import effects as library

# Questions per system, effect, system and unmodelled cause.
CLEAN, EACH, DOUBLE, EACH_FOREIGN = 105, 4, 15, 4
ATTEMPTS = 8  # Maximum number of drawings of a question whose cause is not visible.
QUICK = (
    ("single", "ball", "restitution.speed", 3.0), ("single", "ball", "drag.quadratic", 4.0),
    ("single", "pendulum", "friction.coulomb", 3.0), ("single", "pendulum", "input.delay", 5.0),
    ("single", "slider", "spring.linear", 3.0), ("single", "slider", "input.deadband", 5.0),
    ("foreign", "ball", "updraft", None), ("foreign", "pendulum", "gust", None),
    ("foreign", "slider", "patch", None),
)  # fmt: skip


@dataclass(frozen=True)
class Question:
    """Specification of a case.

    `part` is "marks", or "power" for the power curve only; `index` distinguishes questions of the
    same kind.
    """

    part: str
    kind: str
    system: str
    effect: str | None
    index: int
    size: float | None

    @property
    def name(self):
        return f"{self.part}/{self.kind}/{self.system}/{self.effect or 'any'}/{self.index}"

    def drawn(self, offset):
        """Return the first drawing whose cause is visible; None if there is none."""
        first = 1000 * offset + 10 * self.index
        items = (
            draw_case(self.kind, self.system, first + k, self.effect, self.size)
            for k in range(ATTEMPTS)
        )
        return next((item for item in items if item is not None), None)

    def json(self):
        return asdict(self)


def sheet(offset):
    """Return all questions of a full exam."""
    effects = [
        (system, name)
        for system in SYSTEMS
        for name in sorted(library.list_effects_for(SIMULATORS[system].system))
    ]
    questions = [
        Question("marks", "clean", system, None, k, None)
        for system in SYSTEMS
        for k in range(CLEAN)
    ]
    questions += [
        Question("marks", "single", system, name, k, _size(offset, system, name, k))
        for system, name in effects
        for k in range(EACH)
    ]
    questions += [
        Question("marks", "double", system, None, k, None)
        for system in SYSTEMS
        for k in range(DOUBLE)
    ]
    questions += [
        Question("marks", "foreign", system, name, k, None)
        for system in SYSTEMS
        for name in UNMODELLED_CAUSES[system]
        for k in range(EACH_FOREIGN)
    ]
    return questions + [
        Question(
            "power", "single", system, name, 0, SUBTHRESHOLD_SIZES[place % len(SUBTHRESHOLD_SIZES)]
        )
        for place, (system, name) in enumerate(effects)
    ]


def quick():
    """Return a few questions of every kind."""
    questions = [
        Question("marks", "clean", system, None, k, None) for k, system in enumerate(SYSTEMS)
    ]
    questions += [
        Question("marks", kind, system, name, 0, size) for kind, system, name, size in QUICK
    ]
    # The slider's pair takes minutes, so only the full exam contains it.
    return questions + [
        Question("marks", "double", system, None, 0, None) for system in SYSTEMS[:2]
    ]


def _size(offset, system, name, index):
    """Return a size from 1 to 10; sizes of an effect are evenly spread on a logarithmic scale."""
    share = (
        index % EACH + np.random.default_rng([offset, index, *f"{system} {name}".encode()]).random()
    ) / EACH
    return float(f"{10**share:.3g}")


def digest():
    """Return a hash of the code that draws; cases of the same code are not drawn again."""
    here, text = Path(reference_simulation.__file__).parent, hashlib.sha256()
    for module in (
        "true_system",
        "case_sampling",
        "recording_conditions",
        "effect_coefficients",
        "effect_sizing",
        "competing_effects",
        "joint_reference",
        "ball_reference",
        "reference_simulation",
    ):
        text.update((here / f"{module}.py").read_bytes())
    return text.hexdigest()[:16]
