"""Random logs with one broken convention, and correct logs with a cause."""

from __future__ import annotations

import time
from dataclasses import dataclass, field

from tests.exams.conventions.convention_logs import BROKEN, CAUSES, Log, write_log
from tests.exams.exam import Case, Exam, Question, Target, conditions_text
from tests.exams.explain_calls import Outcome
from tests.exams.marking import Mark

COUNT = 200  # Logs of each kind.
FIRST = 100  # Seed of the first log.
WORDS = {
    "sign of position": "the sign of q.", "sign of command": "the sign of u.",
    "sign of both": "the axis of joint", "zero of position": "position q.",
    "zero of both": "counted from another zero", "unit of one": "look like",
    "unit of all": "look like", "exchanged positions": "the channels of",
    "exchanged commands": "the commands of", "exchanged both": "the channels and commands of",
    "wrapped": "wrapped", "late commands": "stamped",
}  # fmt: skip
"""By convention, words of the right message."""


@dataclass(frozen=True)
class ConventionQuestion(Question):
    """Specification of a log: its convention is broken, or it is sound and has a cause."""

    kind: str
    index: int
    system = "arm"

    @property
    def name(self):
        return f"{self.kind}-{self.index}"

    @property
    def effect(self):
        choices = BROKEN if self.kind == "broken" else CAUSES
        return choices[self.index % len(choices)]

    def draw(self, seed=0):
        return ConventionCase(self.kind, self.effect, self.index + COUNT * seed)


@dataclass
class ConventionCase(Case):
    """A log, which is drawn while it is written."""

    kind: str
    effect: str
    seed: int
    log: Log | None = None
    differences: list = field(default_factory=list)

    def write(self, folder):
        if self.kind == "broken":
            self.log = write_log(folder, self.seed, self.effect)
        else:
            self.log = write_log(folder, 10_000 + self.seed, None, self.effect)
        return self.log.path

    def describe(self):
        joints = " ".join(map(str, self.log.joints))
        size = f"{self.log.size:.4g}"
        conditions = conditions_text(joints=joints, amount=size)
        return {"hidden": self.effect, "size": "", "noise": "white", "conditions": conditions}

    def answer(self, recording, out, call):
        """Compare the conventions of log and model, as `simgap explain` does before it explains."""
        from bench.diagnosis.conventions.convention_comparison import ConventionComparison
        from bench.diagnosis.conventions.unit_check import Subject
        from bench.logs.recording_loading import load_recording

        log, kind = load_recording(recording)
        cpu, wall = time.process_time(), time.perf_counter()
        self.differences = ConventionComparison(Subject(kind, log, None)).differences()
        seconds = time.process_time() - cpu, time.perf_counter() - wall
        return Outcome(None, 0, *seconds)

    def mark(self, outcome):
        is_good = is_right(self.log, self.differences)
        causes = "; ".join(difference.description for difference in self.differences)
        return Mark("right" if is_good else "wrong", causes, *(0, 0, {}, {}), *[is_good] * 5)


def is_right(log, differences):
    """Return whether the answer to a log is right.

    The broken convention must be first or among the equally likely ones, with its joints and
    offset. For a correct log there must be no answer.
    """
    if log.broken is None:
        return not differences
    if len(differences) != 1:
        return False
    (first,) = differences
    return any(_matches(log, one) for one in (first.hypothesis, *first.alternatives))


def _matches(log, hypothesis):
    if WORDS[log.broken] not in hypothesis.description:
        return False
    if log.broken == "late commands":
        return abs(hypothesis.late - log.size) < 1e-6
    concerned = {int(name.partition(".")[2][1:]) for name in hypothesis.changes}
    if concerned != set(log.joints):
        return False
    if log.broken.startswith("zero"):
        offsets = [change.offset for change in hypothesis.changes.values()]
        turns = [
            abs((offset + log.size + 3.14159265) % 6.2831853 - 3.14159265) for offset in offsets
        ]
        return max(turns) < 0.05
    return True


def questions(seed=0):
    """Return as many logs with one broken convention as sound ones."""
    numbers = range(FIRST, FIRST + COUNT)
    return [ConventionQuestion(kind, n) for kind in ("broken", "sound") for n in numbers]


EXAM = Exam(
    "Conventions of random logs",
    "Random arms of 2 to 7 joints, simulated by MuJoCo alone; one convention of the log is broken, "
    "or the log is sound and has a cause.",
    questions,
    (
        Target("a broken convention: found with its joints and offset", "broken", "strict"),
        Target("sound logs: nothing is reported", "sound", "strict"),
    ),
    groups=("effect",),
)  # fmt: skip
