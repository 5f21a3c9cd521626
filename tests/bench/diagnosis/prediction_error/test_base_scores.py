"""Tests of the scores about the base model that a report lists."""

from pathlib import Path

from bench.api.explain import explain

LOG = Path(__file__).resolve().parents[4] / "examples" / "robot" / "log.csv"


def test_candidates_of_the_example_are_scored_although_the_search_needs_no_scores():
    verdict = explain(LOG).answer
    candidates = {candidate.effect: candidate for candidate in verdict.candidates}
    best, *_ = verdict.candidates
    # The RMSE falls from 18 to 1.04 times the noise. The cause must be the best of more than 100.
    assert best.effect == "friction.coulomb@elbow"
    assert best.heldout_gain > 0.99
    assert len(candidates) > 100
    # At the other joint nothing is missing.
    assert candidates["friction.coulomb@shoulder"].score < 0.1 * best.score
    assert candidates["drag.quadratic@shoulder"].score < 0.1 * best.score
    scores = [candidate.score for candidate in verdict.candidates]
    assert scores == sorted(scores, reverse=True)
