"""Tests of the verdict object: verdict.json and the text for the user."""

import json
from dataclasses import FrozenInstanceError, replace

import pytest

from bench.diagnosis.experiment_design.discriminating_run import DiscriminatingRun
from bench.diagnosis.report.cause_and_value_text import format_fitted_value
from bench.diagnosis.search.verdict_rules import VERDICT_MEANINGS
from bench.diagnosis.verdict import Candidate, Cause, HeldOutResult, Verdict, to_finite_or_none
from sims.extended_simulator import FittedValue
from tests.bench.diagnosis import verdict_schema
from tests.bench.diagnosis.sample_report_data import HELD_OUT, answer

DRAG = Cause(
    "drag.linear",
    ("friction.coulomb",),
    "motion is resisted in proportion to speed",
    {"coefficient": FittedValue(2.2e-4, "N*m*s/rad", 2e-4, 2.4e-4)},
    1e-9,
)
TURN = Verdict(
    "ambiguous",
    "pendulum",
    "batch",
    (DRAG,),
    {"inertia": FittedValue(3.4e-3, "kg*m^2", None, None)},
    HeldOutResult(0.37, 0.045, 0.01, 0.9, None, None, "rad"),
    (Candidate("drag.linear", 812.4, 1e-9, 0.9), Candidate("wind", 0.5, 1.0, None)),
    DiscriminatingRun("Record twice as long", {"seconds": 8.0}, 4.0),
    412,
    2.1,
)


def test_the_document_is_that_of_verdict_json_in_its_order():
    text = json.dumps(TURN.to_document(), allow_nan=False)
    assert verdict_schema.check(text) == TURN.to_document()
    assert text == (
        '{"verdict": "ambiguous", "system": "pendulum", "engine": "batch", "causes": [{"effect":'
        ' "drag.linear", "alternatives": ["friction.coulomb"], "says": "motion is resisted in'
        ' proportion to speed", "coefficients": {"coefficient": {"value": 0.00022, "unit":'
        ' "N*m*s/rad", "low": 0.0002, "high": 0.00024}}, "p_value": 1e-09}], "parameters":'
        ' {"inertia": {"value": 0.0034, "unit": "kg*m^2", "low": null, "high": null}}, "heldout":'
        ' {"rmse_base": 0.37, "rmse_extended": 0.045, "noise_floor": 0.01, "gap_closed": 0.9,'
        ' "low": null, "high": null, "unit": "rad"}, "candidates": [{"effect": "drag.linear",'
        ' "score": 812.4, "p_value": 1e-09, "heldout_gain": 0.9}, {"effect": "wind", "score": 0.5,'
        ' "p_value": 1.0, "heldout_gain": null}], "next_experiment": {"says": "Record twice as'
        ' long", "change": {"seconds": 8.0}, "apart": 4.0}, "simulations": 412, "seconds": 2.1,'
        ' "cut": null}'
    )


@pytest.mark.parametrize("word", VERDICT_MEANINGS)
def test_it_is_read_back_from_the_document(word):
    document = answer(word, heldout={**HELD_OUT, "unit": "rad"})
    verdict = Verdict.from_document(json.loads(json.dumps(document)))
    assert verdict.verdict == word
    assert verdict.to_document() == document
    assert list(verdict.to_document()) == list(document)
    assert verdict.meaning == VERDICT_MEANINGS[word]
    assert Verdict.from_document(TURN.to_document()) == TURN
    assert Verdict.from_document(TURN.to_document()) != replace(TURN, seconds=2.2)


def test_what_is_missing_is_null():
    document = replace(TURN, heldout=None, next_experiment=None, causes=()).to_document()
    assert (document["heldout"], document["next_experiment"]) == (None, None)
    assert document["causes"] == []
    measured_apart = DiscriminatingRun("Measure inertia apart").to_document()
    assert measured_apart == {"says": "Measure inertia apart"}
    nowhere = DiscriminatingRun("No run would tell", {}, 0.4).to_document()
    assert nowhere == {"says": "No run would tell", "change": {}, "apart": 0.4}
    assert to_finite_or_none(0.25) == 0.25
    assert to_finite_or_none(float("nan")) is to_finite_or_none(float("inf")) is None


def test_it_is_shown_on_a_line():
    assert repr(TURN) == (
        "Verdict(ambiguous: drag.linear or friction.coulomb; pendulum, 412 simulations)"
    )
    assert repr(replace(TURN, causes=(), verdict="adequate")) == (
        "Verdict(adequate; pendulum, 412 simulations)"
    )
    assert repr(DRAG) == "Cause(drag.linear or friction.coulomb: coefficient = 0.00022 N*m*s/rad)"
    assert repr(TURN.heldout) == "Heldout(0.37 -> 0.045 rad, floor 0.01, closed 0.9)"
    assert repr(HeldOutResult(None, 0.1, None, None, None, None)) == (
        "Heldout(? -> 0.1, floor ?, closed ?)"
    )
    assert repr(TURN.candidates[0]) == "Candidate(drag.linear: score 812, p 1e-09)"


def test_it_cannot_be_changed():
    with pytest.raises(FrozenInstanceError):
        TURN.verdict = "named"


def test_a_number_of_a_model_file_stands_next_to_its_total():
    friction = FittedValue(-0.05, "N*m", -0.06, -0.04, stated=0.2, total=0.15)
    assert (
        format_fitted_value(friction)
        == "−0.050 (−0.060 to −0.040) N·m, in the model file 0.2 → 0.15 N·m"
    )
    mass = FittedValue(0.25, "1", 0.2, 0.3, stated=0.8, total=1.0, total_unit="kg")
    assert format_fitted_value(mass).endswith(", in the model file 0.8 → 1 kg")


def test_a_value_beyond_the_usual_range_is_said_and_not_hidden():
    damping = FittedValue(60.0, "N*m*s/rad", 59.0, 61.0, usual_range=(-0.3, 0.6))
    assert format_fitted_value(damping).endswith("beyond the usual range of −0.3 to 0.6 N·m·s/rad")
    assert damping.is_result


def test_totals_and_usual_ranges_survive_a_file():
    number = FittedValue(2.0, "1", 1.9, 2.1, None, 0.8, 2.4, "kg", (-0.5, 0.5))
    cause = Cause("mass.scale@fore", (), "a wrong mass", {"coefficient": number}, 1e-9)
    document = json.loads(json.dumps(cause.to_document()))
    verdict_schema.estimate(document["coefficients"]["coefficient"])
    assert Cause.from_document(document) == cause
