"""Tests that a search stopped early reports its results and claims no more."""

import json
from pathlib import Path

import pytest

from bench.api.explain import explain
from bench.diagnosis.prediction_error.prediction_error_search import PredictionErrorSearch
from bench.diagnosis.search.verdict_rules import EARLY_STOP_MEANINGS
from bench.diagnosis.verdict import Verdict
from sims.core.simulator import InputError
from tests.bench.diagnosis import verdict_schema
from tests.bench.diagnosis.explained_samples import recording


@pytest.fixture(scope="module")
def swing():
    return recording(
        effects=["drag.linear=1e-3"], noise=["q=0.003", "qd=0.02"], runs=3, seconds=1.0, rate=60.0
    )


def until(swing, text):
    """Return the result of explain if the user stops it at the step with this text."""
    seen = []
    found = explain(
        swing,
        stop=lambda: any(text in what for what in seen),
        progress=lambda _, what: seen.append(what),
    )
    document = found.answer.to_document()
    verdict_schema.check(json.dumps(document, allow_nan=False))
    assert Verdict.from_document(document) == found.answer
    assert found.answer.cut.reason == "interrupt"
    assert text in found.answer.cut.during_question
    assert found.answer.meaning == EARLY_STOP_MEANINGS[found.verdict]
    return found


def test_without_a_base_model_nothing_is_said(swing):
    found = until(swing, "base fit")
    assert found.verdict == "unknown"
    assert not found.causes
    assert found.answer.cut.skipped_questions[0] == "base_fit"
    inertia = found.answer.parameters["inertia"]
    assert inertia.value > 0
    assert inertia.low is inertia.high is None, "an unfinished fit has no interval"


def test_fits_leave_off_where_they_are(swing):
    found = until(swing, "refit of")
    assert found.verdict == "unknown"
    assert found.answer.cut.skipped_questions[0] == "search"
    assert found.answer.parameters["inertia"].low is not None, "the base model was fitted"
    assert found.answer.candidates, "the scores were there already"


def test_what_the_search_came_upon_is_listed_and_not_believed(swing):
    found = until(swing, "scores of the effect library at drag.linear")
    assert found.verdict == "unknown"
    assert [cause.effect for cause in found.causes] == ["drag.linear"]
    assert found.answer.cut.skipped_questions == ("rivals", "held_out", "structure", "alternatives")
    assert found.answer.heldout is None
    assert found.answer.next_experiment is None
    assert "drag.linear" in repr(found)
    assert "stopped by an interrupt" in repr(found)


def test_a_cause_that_stood_is_real_and_never_the_whole_answer(swing, tmp_path):
    found = until(swing, "the test for unmodelled forces")
    assert found.verdict == "partial"
    assert set(found.answer.cut.skipped_questions) <= {"structure", "alternatives"}
    (cause,) = found.causes
    assert cause.effect == "drag.linear"
    assert cause.coefficients["coefficient"].value == pytest.approx(1e-3, rel=0.05)
    assert found.answer.heldout.gap_closed > 0.9
    found.write(tmp_path / "out")
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert "partial: a cause is found; the search was stopped early" in page
    assert "the test for unmodelled forces" in page


def test_an_end_that_never_comes_changes_nothing(swing):
    told = []
    found = explain(swing, budget=1e6, progress=lambda share, _: told.append(share))
    assert found.verdict == "named"
    assert found.answer.cut is None
    assert 0.0 <= told[0] < told[-1] < 1.0


def test_the_best_model_of_a_robot_is_measured_after_its_budget(monkeypatch):
    def use_up_budget(search, best):
        search.evaluator.search_control._stop_reason = "budget"
        return best

    monkeypatch.setattr(PredictionErrorSearch, "fit_competing_models", use_up_budget)
    found = explain(Path(__file__).parents[3] / "examples/robot/log.csv")
    assert found.verdict == "unknown"
    assert found.answer.cut.reason == "budget"
    (cause,) = found.causes
    assert cause.effect == "friction.coulomb@elbow"
    assert cause.p_value < 1e-12
    assert found.answer.heldout.gap_closed > 0.95


@pytest.mark.parametrize("budget", [0, -1.0, float("nan")])
def test_a_budget_is_a_number_of_seconds(swing, budget):
    with pytest.raises(InputError, match="budget: expected a number of seconds above 0, found"):
        explain(swing, budget=budget)
