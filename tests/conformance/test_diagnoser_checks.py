"""Tests of every diagnoser check with a subject that it must reject."""

import random

import numpy as np
import pytest

from bench.conformance import CheckError
from bench.conformance import diagnoser_checks as checks
from bench.core.diagnoser import Answer, Diagnoser, NamedCause


class Right(Diagnoser):
    name = "right"

    def diagnose(self, case):
        return "adequate"


class ReturnsNothing(Right):
    def diagnose(self, case):
        return None


class NamesNothing(Right):
    def diagnose(self, case):
        return Answer("named")


class NamesTheWind(Right):
    def diagnose(self, case):
        return Answer("named", (NamedCause("restitution.speed"),))  # of a slider


class NamesTwice(Right):
    def diagnose(self, case):
        return Answer("ambiguous", (NamedCause("drag.linear", ("drag.linear",)),))


class ChangesItsMind(Right):
    turns = 0

    def diagnose(self, case):
        type(self).turns += 1
        return Answer("adequate", p_value=1.0 / self.turns)


class Overwrites(Right):
    def diagnose(self, case):
        case.path.write_text("")
        return "adequate"


class Seeds(Right):
    def diagnose(self, case):
        random.seed(1)
        return "adequate"


class Spends(Right):
    """Exceed the simulation budget by removing the limit of the counter."""

    def diagnose(self, case):
        checks.SIMULATION_COUNTER.limit = None
        for run in case.recording.runs * 20:
            case.simulate(run)
        return "adequate"


class Stumbles(Right):
    def diagnose(self, case):
        if not all(np.isfinite(run.channels["x"]).all() for run in case.recording.runs):
            raise ValueError("no number")
        return "adequate"


class LearnsTexts(Right):
    learned = True

    def train(self, task):
        return {"words": np.array(["drag"])}


REJECTED = [
    (checks.check_answers, ReturnsNothing, "found an answer: expected an Answer"),
    (checks.check_answers, NamesNothing, "causes where something is named"),
    (checks.check_names_what_there_is, NamesTheWind, "names of case.library"),
    (checks.check_names_what_there_is, NamesTwice, "each effect once"),
    (checks.check_same_answer_again, ChangesItsMind, "the same answer again"),
    (checks.check_leaves_the_recording_alone, Overwrites, "the recording unchanged"),
    (checks.check_leaves_global_chance_alone, Seeds, "global random state unchanged"),
    (checks.check_keeps_to_its_budget, Spends, "at most 40 simulations"),
    (checks.check_learns_within_its_budget, LearnsTexts, "arrays of numbers"),
]


@pytest.mark.parametrize(
    ("check", "kind", "message"), REJECTED, ids=lambda one: getattr(one, "__name__", "")
)
def test_each_check_rejects(check, kind, message):
    with pytest.raises(CheckError, match=message):
        check(kind)


def test_gaps_are_in_the_recording():
    with pytest.raises(ValueError, match="no number"):
        checks.check_takes_missing_samples(Stumbles)


def test_every_check_has_one():
    rejecting = {check for check, *_ in REJECTED} | {checks.check_takes_missing_samples}
    assert rejecting == set(checks.DIAGNOSER_CHECKS)


@pytest.mark.parametrize("check", checks.DIAGNOSER_CHECKS, ids=lambda check: check.__name__)
def test_one_that_sees_nothing_conforms(check):
    check(Right)
