"""Tests of the recordings with contacts, and of `simgap explain` on some of them."""

import json
from math import inf

import numpy as np
import pytest

from bench.cli.main import main
from tests.exams.contacts.contact_cases import NOISE, ContactQuestion
from tests.exams.contacts.contact_robots import replay
from tests.exams.explain_calls import Outcome


def answer(question, folder, seconds):
    """Return the mark of the command's answer to the first seconds of each run."""
    case = question.draw()
    case.write(folder)
    log = folder / "log.csv"
    head, *rows = log.read_text().splitlines()
    rows = [row for row in rows if float(row.split(",")[1]) < seconds]
    log.write_text("\n".join([head, *rows]) + "\n")
    assert main(["explain", str(log), "--out", str(folder / "out")]) == 0
    return case.mark(Outcome(json.loads((folder / "out" / "verdict.json").read_text()), 0))


def test_a_sled_is_slowed_by_friction_times_its_normal_force():
    case = ContactQuestion("single", "sled", "contact.friction", 0).draw()
    model, mu = case.true_model, case.numbers["friction"] + case.size
    start = np.array([0.0, -1e-4, 3.0, 0.0])
    model.dof_damping[:] = 0.0
    states = replay(model, start, np.zeros((21, 2)))
    deceleration = (states[10, 2] - states[20, 2]) / 0.1
    assert deceleration == pytest.approx(9.81 * mu, rel=0.03)


def test_a_case_shows_its_discrepancy_and_a_clean_one_has_none():
    case = ContactQuestion("single", "arm", "contact.friction", 1).draw()
    assert case.effect == "contact.friction@ground/foot"
    assert case.gap > 3.0
    clean = ContactQuestion("clean", "arm", "any", 0).draw()
    assert clean.gap < 1e-9 / NOISE


@pytest.mark.slow
@pytest.mark.parametrize(
    ("question", "seconds"),
    [
        (ContactQuestion("single", "hopper", "contact.damping", 1), 1.5),
        # The held-out run is explained only from states that belong to the fitted number.
        pytest.param(
            ContactQuestion("single", "arm", "contact.damping", 0), 1.5, marks=pytest.mark.long
        ),
        # The first state of the held-out run has to be found by simulation.
        pytest.param(ContactQuestion("clean", "hopper", "any", 2), inf, marks=pytest.mark.long),
        # The smoothed initial states leave a residual of 1.3 times the noise.
        pytest.param(ContactQuestion("clean", "arm", "any", 0), inf, marks=pytest.mark.long),
    ],
    ids=lambda part: getattr(part, "name", None),
)
def test_the_command_names_a_wrong_contact_and_no_other(question, seconds, tmp_path):
    assert answer(question, tmp_path, seconds).strict


@pytest.mark.long
def test_joint_damping_of_a_hopper_is_one_of_two_equivalent_causes(tmp_path):
    # The damping of the servo is the same number as that of the joint.
    assert answer(ContactQuestion("single", "hopper", "drag.linear", 0), tmp_path, inf).few
