"""Cases with a wrong number of a contact in the model file; plain MuJoCo makes the recording.

A case is a robot, a kind of number and a seed; all numbers are drawn. The wrong number is friction,
softness or damping of the contact, or the damping of a joint; clean recordings have none.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import cached_property

import mujoco
import numpy as np

from sims.core.root_mean_square import compute_rms
from tests.exams.contacts.contact_robots import (
    NAMES,
    draw_numbers,
    record_motion,
    replay,
    write_model,
)
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
from tests.exams.planted.planted_cases import position_unit
from tests.exams.planted.planted_motion import HELD_OUT, RATE, RUNS, SAMPLES
from tests.exams.robot_files import signal_unit, write_robot_recording

CONTACT = "ground/foot"
GAP = (3.0, 3000.0)  # Smallest and largest discrepancy, in multiples of the noise.
NOISE = 1e-4  # Standard deviation of positions, rad or m.
FORMS = ("multisine", "steps", "both")  # Motion of the runs r1, r2, r3.
ATTEMPTS = 100  # Maximum number of drawings of a question.
# Maximum growth of a deviation of the initial positions; above it, the motion is chaotic.
MAX_GROWTH = 4.0
# Number of the model file, and interval of its relative change, by effect.
CONTACT_CHANGES = {
    "contact.friction": ("friction", (0.25, 0.6)),
    "contact.softness": ("time_constant", (0.3, 0.8)),
    "contact.damping": ("damping_ratio", (0.3, 0.8)),
}
JOINT_CHANGES = {"drag.linear": (0.2, 1.0)}  # Added to the damping of a joint, N m s/rad or N s/m.
RIGHT_KINDS = ("contact.friction", "contact.softness", "contact.damping", "drag.linear")
STANDARD = Standard(max_set=2, largest_fair_set=2, number_counts=True)
SINGLES = 30
CLEAN = 10


@dataclass(frozen=True)
class ContactQuestion(Question):
    """Specification of a case: robot, effect and number of the draw."""

    kind: str
    system: str
    effect: str
    index: int

    @property
    def name(self):
        return f"{self.kind}/{self.system}/{self.effect}/{self.index}"

    def draw(self, seed=0):
        """Return the first drawing with a visible discrepancy."""
        for attempt in range(ATTEMPTS):
            text = f"contacts/{self.name}/{seed}/{attempt}"
            case = _draw(self, int.from_bytes(hashlib.sha256(text.encode()).digest()[:4], "little"))
            if case is not None:
                return case
        raise UndrawableError(f"{self.name}: no drawing shows a gap of {GAP[0]:g} noises")


def questions(seed=0):
    """Return all questions: singles of all robots and effects, and clean recordings."""
    # A foot that hops straight up and down does not slide.
    pairs = [
        (robot, effect)
        for effect in RIGHT_KINDS
        for robot in NAMES
        if (robot, effect) != ("hopper", "contact.friction")
    ]
    sheet = [
        ContactQuestion("single", *pairs[index % len(pairs)], index // len(pairs))
        for index in range(SINGLES)
    ]
    return sheet + [
        ContactQuestion("clean", NAMES[index % len(NAMES)], "any", index) for index in range(CLEAN)
    ]


def _draw(question, seed):
    rng = np.random.default_rng(seed)
    # The table states the numbers of the file with three digits.
    numbers = {key: float(f"{value:.3g}") for key, value in draw_numbers(rng).items()}
    case = ContactCase(question.system, numbers, "", 0.0, seed)
    if question.kind == "clean":
        return case if case.growth <= MAX_GROWTH else None
    if question.effect in CONTACT_CHANGES:
        key, (low, high) = CONTACT_CHANGES[question.effect]
        factor = 1.0 + rng.uniform(low, high) * rng.choice([-1.0, 1.0])
        size = numbers[key] * (factor - 1.0) if key == "friction" else factor - 1.0
        effect = f"{question.effect}@{CONTACT}"
    else:
        low, high = JOINT_CHANGES[question.effect]
        joint = rng.choice(case.joints)
        size, effect = rng.uniform(low, high), f"{question.effect}@{joint}"
    case = ContactCase(question.system, numbers, effect, float(f"{size:.3g}"), seed)
    is_visible = GAP[0] <= case.gap <= GAP[1]
    return case if is_visible and case.growth <= MAX_GROWTH else None


@dataclass(frozen=True)
class ContactCase(Case):
    """One recording with contacts.

    Attributes:
        robot: name of the robot.
        numbers: numbers of the model file.
        effect: effect@place that is wrong in the file; empty if none is.
        size: its coefficient.
        seed: seed of motion and noise.
    """

    robot: str
    numbers: dict[str, float]
    effect: str
    size: float
    seed: int

    @cached_property
    def model(self):
        """Compiled model file."""
        return mujoco.MjModel.from_xml_string(write_model(self.robot, self.numbers))

    @property
    def joints(self):
        return [self.model.joint(i).name for i in range(self.model.njnt)]

    @cached_property
    def true_model(self):
        """Compiled model of the robot that makes the recording."""
        name, _, place = self.effect.partition("@")
        numbers = dict(self.numbers)
        if name in CONTACT_CHANGES:
            key = CONTACT_CHANGES[name][0]
            numbers[key] = (
                numbers[key] + self.size if key == "friction" else numbers[key] * (1 + self.size)
            )
        model = mujoco.MjModel.from_xml_string(write_model(self.robot, {} | numbers))
        if name in JOINT_CHANGES:
            model.dof_damping[model.joint(place).dofadr[0]] += self.size
        return model

    @cached_property
    def motions(self):
        """Motion of the true robot by run: (commands, states)."""
        rng = np.random.default_rng([self.seed, 0])
        return {
            run: record_motion(self.robot, self.numbers, self.true_model, form, rng)
            for run, form in zip(RUNS, FORMS, strict=True)
        }

    @cached_property
    def gap(self):
        """RMS error of the model file from the true initial states, in multiples of the noise."""
        errors = [
            replay(self.model, states[0], commands) - states
            for commands, states in self.motions.values()
        ]
        return compute_rms(np.concatenate(errors)[:, : self.model.nq]) / NOISE

    @cached_property
    def growth(self):
        """Largest deviation (RMS of a joint, in units of the noise) if the start deviates by one.

        It is that of later positions, after the first tenth of a second.
        """
        deviation = NOISE * np.random.default_rng(0).standard_normal(2 * self.model.nq)
        deviation[self.model.nq :] = 0.0
        errors = [
            replay(self.true_model, states[0] + deviation, commands) - states
            for commands, states in self.motions.values()
        ]
        later = np.array(errors)[:, RATE // 10 :, : self.model.nq] / NOISE
        return float(np.sqrt(np.square(later).mean(axis=1)).max())

    def write(self, folder):
        rng = np.random.default_rng([self.seed, 1])
        model, inputs = self.model, {}
        for index in range(model.nu):
            joint = model.joint(model.actuator_trnid[index, 0])
            is_motor = model.actuator_biastype[index] == mujoco.mjtBias.mjBIAS_NONE
            name = f"u.{model.actuator(index).name}"
            inputs[name] = signal_unit(name, position_unit(joint), is_motor)
        channels = {
            f"q.{joint}": (position_unit(model.joint(joint)), NOISE) for joint in self.joints
        }
        tables = {}
        for run, (commands, states) in self.motions.items():
            readings = states[:, : model.nq]
            readings = readings + NOISE * rng.standard_normal(readings.shape)
            tables[run] = (run == HELD_OUT, np.arange(SAMPLES) / RATE, commands, readings)
        text = write_model(self.robot, self.numbers)
        return write_robot_recording(
            folder, "log", inputs, channels, tables, (f"{self.robot}.xml", text)
        )

    def describe(self):
        hidden = hidden_text({self.effect: (self.size,)} if self.effect else {})
        conditions = conditions_text(sigma=NOISE)
        size = number(self.gap) if self.effect else ""
        return {"hidden": hidden, "size": size, "noise": "white", "conditions": conditions}

    def mark(self, outcome):
        effects = {self.effect: (self.size,)} if self.effect else {}
        hidden = HiddenCause("single" if effects else "clean", effects)
        return mark_answer(hidden, outcome.verdict, STANDARD)


EXAM = Exam(
    "Wrong numbers of contacts",
    "An arm that slides over a table, a sled and a hopper. One number of the contact or of a joint "
    "is changed, plain MuJoCo makes the recording, and the command explains it with the unchanged "
    "file.",
    questions,
    (
        Target("the planted cause, alone or with one other", "single", "few", 0.9),
        Target("a clean recording: adequate", "clean", "strict", 1.0),
    ),
    groups=("effect", "system"), cpu_limit=60.0, needs_command=True,
)  # fmt: skip
