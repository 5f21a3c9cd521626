"""Tests of the steps that confirm a robot's causes by simulation."""

from types import SimpleNamespace

import pytest

from bench.diagnosis.prediction_error.robot_diagnosis import (
    MAX_REFITTED_COMPETITORS,
    RobotDiagnosis,
)
from tests.bench.diagnosis.search.search_models import model


def refit(gain, *others, effects=("a",)):
    """Return the effects of the competitors that are refitted after a final fit with this gain."""
    best = model(*effects, likelihood=1000.0)
    refitted = []
    diagnosis = RobotDiagnosis.__new__(RobotDiagnosis)
    diagnosis._model = best
    diagnosis._robot_search = SimpleNamespace(
        models={frozenset(m.effects): m for m in (best, *others)},
        parameter_penalty=6.0,
        fit_to_convergence=lambda m: refitted.append(m.effects),
    )
    diagnosis._refit_near_competitors(gain)
    return refitted


@pytest.mark.parametrize(
    ("gain", "expected"), [(0.0, []), (11.0, [("b",)]), (25.0, [("b",), ("c",)])]
)
def test_competitors_that_the_final_fit_left_behind_are_refitted(gain, expected):
    """An equal effect is behind by the gain of the final fit, which only the best model got."""
    # The limit is 7 + 6 + 2 times the gain: 35 and 63.
    near, far = model("b", likelihood=1000.0 - 34.0), model("c", likelihood=1000.0 - 62.0)
    assert refit(gain, far, near) == expected


def test_only_models_with_one_other_effect_are_refitted():
    others = [model("a", likelihood=999.0), model("a", "c", likelihood=999.0)]
    others += [model("c", "d", likelihood=999.0), model("a", "b", "c", likelihood=999.0)]
    assert refit(5.0, *others, effects=("a", "b")) == [("a", "c")]


def test_few_competitors_are_refitted_the_likeliest_first():
    others = [model(name, likelihood=990.0 + i) for i, name in enumerate("bcdefg")]
    assert refit(20.0, *others) == [(name,) for name in "gfed"][:MAX_REFITTED_COMPETITORS]
