"""Tests of the filter of a model whose parameters differ from those of a known filter."""

import pytest

from bench.diagnosis.kalman.linearised_filter import FollowedRuns


def with_effect(followed, name, coefficient):
    """Return the parameters with one effect."""
    theta = followed.theta.copy()
    theta[followed.evaluator.coefficient_slices[name]] = coefficient
    return theta


@pytest.mark.parametrize(
    ("effect", "size", "is_reused"),
    [
        ("sensor.bias@q.elbow", 0.01, True),
        ("force.bias@elbow", 0.01, True),
        ("drag.linear@elbow", 0.05, False),
    ],
)
def test_jacobians_are_computed_again_only_if_an_effect_changes_them(
    followed, monkeypatch, effect, size, is_reused
):
    theta = with_effect(followed, effect, size)
    reused = followed.with_parameters(theta)
    before, after = (one.linear[0]._tangent.quotients for one in (followed, reused))
    assert (before is after) == is_reused
    # The likelihood is that of new Jacobians.
    monkeypatch.setattr(FollowedRuns, "_has_jacobians_of", lambda *_: False)
    renewed = followed.with_parameters(theta)
    assert reused.log_likelihood == pytest.approx(renewed.log_likelihood, abs=0.5)
    assert abs(reused.log_likelihood - followed.log_likelihood) > 5.0
