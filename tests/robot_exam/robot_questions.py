"""Questions of the robot exam; drawing a question gives a benchmark case."""

from __future__ import annotations

import hashlib
from dataclasses import asdict, dataclass
from pathlib import Path

from tests.robot_exam import planted_effects
from tests.robot_exam.robot_items import draw
from tests.robot_exam.robot_models import NAMES

CLEAN, DOUBLE, FOREIGN, FAMILY, NUMERICS = 24, 4, 2, 2, 2
"""Questions for each robot and drive: clean, double, each unmodelled cause, each family, numerics.
"""
ATTEMPTS = 6  # Maximum number of drawings of a question whose cause is not visible.
QUICK = (
    ("clean", "arm2-motor", "any"), ("single", "arm2-motor", "friction.coulomb"),
    ("single", "arm2-motor", "mass.scale"), ("clean", "arm2-servo", "any"),
    ("single", "arm2-servo", "drag.linear"), ("single", "arm2-servo", "input.delay"),
)  # fmt: skip


@dataclass(frozen=True)
class Question:
    """Specification of a case; `index` distinguishes questions of the same kind."""

    kind: str
    robot: str
    effect: str
    index: int

    @property
    def name(self):
        return f"{self.kind}/{self.robot}/{self.effect}/{self.index}"

    def drawn(self, offset=0):
        """Return the first drawing whose cause is visible; None if there is none."""
        first = 1000 * offset + 10 * self.index
        items = (draw(self.kind, self.robot, self.effect, first + k) for k in range(ATTEMPTS))
        return next((item for item in items if item is not None), None)

    def json(self):
        return asdict(self)


def sheet():
    """Return all questions, ordered by index and then by robot."""
    return [
        question for index in range(CLEAN) for robot in NAMES for question in _round(robot, index)
    ]


def _round(robot, index):
    """Yield the questions of one index for a robot."""
    servo = robot.endswith("servo")
    yield Question("clean", robot, "any", index)
    if index < 1:
        for effect in planted_effects.effects(robot.partition("-")[2]):
            yield Question("single", robot, effect, index)
    if index < FAMILY:
        for effect in planted_effects.FAMILIES:
            yield Question("family", robot, effect, index)
    if index < FOREIGN:
        for cause in planted_effects.FOREIGN:
            yield Question("foreign", robot, cause, index)
    if index < DOUBLE:
        yield Question("double", robot, "any", index)
    if index < NUMERICS and servo:
        yield Question("numerics", robot, "any", index)


def quick():
    """Return a few questions about two robots."""
    # Index 1 gives clean cases that end after the first test, as nine out of ten do.
    return [Question(kind, robot, effect, int(kind == "clean")) for kind, robot, effect in QUICK]


def spread():
    """Return one question per effect, with the robots in turn; it takes one to two hours."""
    chosen = []
    for drive in ("motor", "servo"):
        robots = [name for name in NAMES if name.endswith(drive)]
        for place, effect in enumerate(planted_effects.effects(drive)):
            chosen.append(Question("single", robots[place % len(robots)], effect, 0))
        for place, robot in enumerate(robots):
            chosen += [Question("clean", robot, "any", 0), Question("double", robot, "any", 0)]
            cause = planted_effects.FOREIGN[place % len(planted_effects.FOREIGN)]
            chosen.append(Question("foreign", robot, cause, 0))
            chosen.append(Question("family", robot, planted_effects.FAMILIES[place % 2], 0))
    return chosen + [
        Question("numerics", robot, "any", 0) for robot in ("arm2-servo", "iiwa-servo")
    ]


def digest():
    """Return a hash of the code that draws; cases of the same code are not drawn again."""
    here, text = Path(__file__).parent, hashlib.sha256()
    for module in (
        "friction_laws", "reference_plant", "exam_robots", "excitation_signals",
        "reference_integration", "reference_world", "robot_models", "command_signals",
        "sensor_models", "exam_settings", "planted_effects", "causes_outside_library",
        "cause_sizing", "robot_items", "exam_recording",
    ):  # fmt: skip
        text.update((here / f"{module}.py").read_bytes())
    return text.hexdigest()[:16]
