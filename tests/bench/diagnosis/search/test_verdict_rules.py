"""Tests of each verdict rule on both sides of each threshold."""

from itertools import product
from typing import get_args

import numpy as np
import pytest

from bench.diagnosis.search import verdict_rules
from bench.diagnosis.search.verdict_rules import DiagnosisState, VerdictName, decide_verdict
from tests.bench.diagnosis import verdict_schema

SIGMA = np.array([0.01, 0.1])
QUESTIONS = ("base_fit", "search", "rivals", "held_out", "structure", "alternatives")


def test_every_verdict_has_one_sentence_and_is_in_the_form_of_verdict_json():
    assert (
        set(get_args(VerdictName)) == set(verdict_rules.VERDICT_MEANINGS) == verdict_schema.VERDICTS
    )
    for meaning in verdict_rules.VERDICT_MEANINGS.values():
        assert len(meaning) > 20
        assert meaning[0].islower()


def rests(ranges=(5.9, 5.9), left=(2.9, 2.9), is_model_sensitive=False):
    """Evaluate `is_motionless` for ranges and residuals in units of the noise."""
    return verdict_rules.is_motionless(
        np.array(ranges) * SIGMA,
        np.array(left) * SIGMA,
        SIGMA,
        is_model_sensitive=is_model_sensitive,
    )


def test_a_recording_shows_nothing_where_every_channel_rests_as_its_model_does():
    assert rests()
    assert not rests(ranges=(5.9, 6.1)), "one channel moves"
    assert not rests(left=(3.1, 2.9)), "it ought to move and does not"
    assert not rests(is_model_sensitive=True), "its model moves"


def test_one_constant_shows_nothing_whatever_its_model_does():
    assert rests(ranges=(0, 0), left=(99, 99), is_model_sensitive=True)
    assert not rests(ranges=(1e-9, 0), left=(99, 99), is_model_sensitive=True)


def test_a_parameter_is_fixed_by_an_error_of_less_than_half_its_bounds():
    assert verdict_rules.is_identified(0.99, 1.0, 3.0)
    assert not verdict_rules.is_identified(1.01, 1.0, 3.0)
    assert not verdict_rules.is_identified(float("nan"), 1.0, 3.0)


@pytest.mark.parametrize("error", [0.0, 0.02])
def test_stated_noise_is_exceeded_by_a_twentieth_and_four_standard_errors(error):
    limit = 1.05 + 4 * error
    assert not verdict_rules.exceeds_noise(limit - 1e-6, error, is_noise_stated=True)
    assert verdict_rules.exceeds_noise(limit + 1e-6, error, is_noise_stated=True)


def test_estimated_noise_is_exceeded_sevenfold_whatever_the_error():
    assert not verdict_rules.exceeds_noise(6.99, 0.0, is_noise_stated=False)
    assert verdict_rules.exceeds_noise(7.01, 1.0, is_noise_stated=False)


@pytest.mark.parametrize(("stated", "p_value"), [(True, 1e-3), (False, 1e-4)])
def test_an_unmodelled_force_is_structure_below_a_p_value(stated, p_value):
    level = verdict_rules.get_structure_threshold(stated)
    assert verdict_rules.has_structure(0.99 * p_value, level, ())
    assert not verdict_rules.has_structure(1.01 * p_value, level, ())


def test_a_channel_above_the_noise_is_structure_although_no_force_explains_it():
    assert verdict_rules.has_structure(1.0, verdict_rules.STRUCTURE_P_VALUE_THRESHOLD, ("q",))


def test_a_model_lacks_something_by_structure_or_by_a_score():
    assert verdict_rules.is_unexplained(False, 0.0029)
    assert not verdict_rules.is_unexplained(False, 0.0031)
    assert verdict_rules.is_unexplained(True, 1.0)


def test_an_effect_helps_held_out_runs_by_merit_alone_near_the_noise():
    assert verdict_rules.improves_held_out((10.0, 10.1), (0.49, 0.49))
    assert not verdict_rules.improves_held_out((10.0, 10.0), (0.49, 0.1))
    assert not verdict_rules.improves_held_out((10.0, -np.inf), (0.49, np.nan)), (
        "its simulation failed"
    )


def test_far_from_the_noise_it_also_reduces_the_excess_by_a_tenth():
    assert not verdict_rules.improves_held_out((10.0, 99.0), (0.51, 0.51))
    assert verdict_rules.improves_held_out((10.0, 99.0), (2.0, 1.79))
    assert not verdict_rules.improves_held_out((10.0, 99.0), (2.0, 1.81))
    assert not verdict_rules.improves_held_out((10.0, 9.0), (2.0, 0.0))


def test_models_are_alike_that_are_less_than_seven_apart():
    assert verdict_rules.is_indistinguishable(6.99)
    assert not verdict_rules.is_indistinguishable(7.01)
    assert verdict_rules.is_indistinguishable(-50.0), "it is ahead"


def test_where_structure_is_left_they_are_alike_that_leave_a_fifth_more():
    assert verdict_rules.is_indistinguishable(verdict_rules.convert_excess_ratio([1.199]))
    assert not verdict_rules.is_indistinguishable(verdict_rules.convert_excess_ratio([1.201]))
    assert verdict_rules.convert_excess_ratio([1.2, 1.2]) == pytest.approx(7.0)
    assert verdict_rules.convert_excess_ratio([1.5, 1 / 1.5]) == pytest.approx(0.0), (
        "held-out runs have a say"
    )


def test_ratios_of_excesses_stop_at_a_tenth():
    assert verdict_rules.compute_excess_ratio(0.4, 0.2) == pytest.approx(2.0)
    assert verdict_rules.compute_excess_ratio(0.05, -0.01) == 1.0
    assert verdict_rules.compute_excess_ratio(0.2, 0.01) == pytest.approx(2.0)


def test_causes_explain_the_gap_that_close_seven_tenths_of_it():
    assert verdict_rules.explains_gap(0.7)
    assert not verdict_rules.explains_gap(0.699)


def test_the_error_on_held_out_runs_follows_from_the_residual_or_the_remaining_gap():
    assert not verdict_rules.misses_held_out_gap(0.49, 0.49), "nothing was there to be closed"
    assert verdict_rules.misses_held_out_gap(0.51, 0.51)
    assert verdict_rules.misses_held_out_gap(0.49, 0.5), "worse than before"
    assert verdict_rules.misses_held_out_gap(9.0, 0.51), "too much is left"
    assert not verdict_rules.misses_held_out_gap(1.6, 0.47)
    assert verdict_rules.misses_held_out_gap(1.6, 0.49), "less than seven tenths are gone"
    assert not verdict_rules.misses_held_out_gap(0.6, -0.1), (
        "below the noise is all that can be gone"
    )
    assert verdict_rules.misses_held_out_gap(9.0, float("nan")), "the simulation failed"


@pytest.mark.parametrize(
    ("state", "verdict"),
    [
        (DiagnosisState(), "adequate"),
        (DiagnosisState(is_base_determined=False), "unidentifiable"),
        (DiagnosisState(is_base_determined=False, cause_count=1, gap_closed=0.9), "unidentifiable"),
        (DiagnosisState(is_unexplained=True), "unknown"),
        (DiagnosisState(misses_held_out_gap=True), "unknown"),
        (DiagnosisState(cause_count=1, gap_closed=0.71), "named"),
        (DiagnosisState(cause_count=3, gap_closed=0.71), "named"),
        (DiagnosisState(cause_count=1, gap_closed=0.69), "unknown"),
        (DiagnosisState(cause_count=1, gap_closed=0.71, has_alternatives=True), "ambiguous"),
        (DiagnosisState(cause_count=1, gap_closed=0.71, is_unexplained=True), "partial"),
        (DiagnosisState(cause_count=1, gap_closed=0.71, misses_held_out_gap=True), "partial"),
        (
            DiagnosisState(
                cause_count=1, gap_closed=0.71, has_alternatives=True, is_unexplained=True
            ),
            "partial",
        ),
        (DiagnosisState(cause_count=1, gap_closed=0.69, misses_held_out_gap=True), "unknown"),
        (DiagnosisState(cause_count=1, gap_closed=0.69, has_alternatives=True), "unknown"),
    ],
)
def test_the_first_question_answered_decides(state, verdict):
    assert decide_verdict(state) == verdict


def test_every_state_has_a_verdict_and_a_name_needs_a_cause():
    for fixed, causes, alternatives, closed, unexplained, missed in product(
        [True, False], [0, 2], [True, False], [0.1, 0.9], [True, False], [True, False]
    ):
        verdict = decide_verdict(
            DiagnosisState(fixed, causes, alternatives, closed, unexplained, missed)
        )
        assert verdict in verdict_rules.VERDICT_MEANINGS
        assert causes or verdict not in ("named", "ambiguous", "partial")
        if unexplained or missed:
            assert verdict not in ("adequate", "named", "ambiguous")


@pytest.mark.parametrize("first", range(len(QUESTIONS)))
@pytest.mark.parametrize("causes", [0, 2])
@pytest.mark.parametrize("closed", [0.5, 0.95])
def test_a_search_that_was_ended_early_names_nothing(first, causes, closed):
    verdict = verdict_rules.decide_early_stop_verdict(causes, closed, QUESTIONS[first:])
    stood = first >= QUESTIONS.index("structure")
    assert verdict == ("partial" if causes and closed > 0.7 and stood else "unknown")
    assert set(verdict_rules.EARLY_STOP_MEANINGS) == {"partial", "unknown"}
