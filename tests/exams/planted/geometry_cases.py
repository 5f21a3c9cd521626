"""Exam of wrong geometry, payloads, carried weights, rotors and wheels of model files.

One number of a file of `MODELS` is wrong. Model, place, size and motion are drawn from the seed;
plain MuJoCo makes the recordings.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from tests.exams.exam import Exam, Question, Target
from tests.exams.marking import HiddenCause, mark_answer
from tests.exams.planted.model_cases import ModelCase, draw_model_case
from tests.exams.planted.planted_cases import STANDARD
from tests.exams.planted.planted_motion import EFFECTS

ARMS = ("arm-absent-meshes", "arm-filtered", "arm-included", "arm-inheritrange", "mobile-arm")
SYSTEMS_BY_NUMBER = {
    "payload": ARMS,
    "length": ARMS,
    "axis": ARMS,
    # The zeros of "arm-included" hardly show: its gravity torques are small.
    "zero": ("arm-absent-meshes", "arm-filtered", "arm-absent-meshes", *ARMS[3:]),
    "gravcomp": ARMS,
    "gear": ("quadrotor",),
    "radius": ("differential-drive",),
}
"""Models in which each kind of number is wrong in turn."""
DRAWS = 20  # Recordings of each kind of number.
# A stiff servo hides a wrong length, axis or zero in the position; the torque shows it.
TORQUE_NUMBERS = ("length", "axis", "zero")


@dataclass(frozen=True)
class GeometryQuestion(Question):
    """Specification of a case: kind of the wrong number, and number of the draw."""

    number: str
    index: int
    kind = "single"

    @property
    def system(self):
        systems = SYSTEMS_BY_NUMBER[self.number]
        return systems[self.index % len(systems)]

    @property
    def numbers(self):
        """Kinds of the wrong number that are tried."""
        return [self.number]

    @property
    def name(self):
        return f"{self.number}/{self.system}/{self.index}"

    @property
    def effect(self):
        return EFFECTS[self.number]

    @property
    def with_torques(self):
        """True if the torques of driven joints are recorded."""
        return self.number in TORQUE_NUMBERS

    def draw(self, seed=0):
        """Draw the case; another seed gives another exam."""
        return GeometryCase(**vars(draw_model_case(self, seed)))


@dataclass(frozen=True)
class GeometryCase(ModelCase):
    """One recording with a wrong number of the geometry."""

    @property
    def with_torques(self):
        return self.kind in TORQUE_NUMBERS

    def mark(self, outcome):
        # The coefficients of a tilt are those components that the motion shows, not its angle.
        standard = replace(STANDARD, number_counts=self.kind != "axis")
        hidden_cause = HiddenCause("single", self.hidden_effects)
        return mark_answer(hidden_cause, outcome.verdict, standard, self._held_out_ratios)


def questions(seed=0):
    """Return all questions; the first ones have each kind of number."""
    return [
        GeometryQuestion(number, index) for index in range(DRAWS) for number in SYSTEMS_BY_NUMBER
    ]


EXAM = Exam(
    "Geometry, payloads, rotors and wheels",
    "Arms with servos, a quadrotor and a differential drive. A length, an axis, a zero, a payload, "
    "a carried weight, a rotor or a wheel is wrong in the file; plain MuJoCo makes the recording.",
    questions,
    (Target("cause and place, alone or in a set of equals", "single", "fair", 0.9),),
    groups=("number", "system"), needs_command=True,
)  # fmt: skip
