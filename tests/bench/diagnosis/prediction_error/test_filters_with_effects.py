"""Tests of results that the filters of a search store."""

from types import SimpleNamespace

import pytest

from bench.diagnosis.prediction_error.filters_with_effects import ModelFilters


@pytest.mark.parametrize("start", [SimpleNamespace(theta="likeliest"), None])
def test_soft_friction_is_searched_once_for_each_sign(start):
    models = SimpleNamespace(evaluator=None, noise=None)
    stiff, soft = ModelFilters(models), ModelFilters(models)
    searches = []

    def search(filters, name, sign):
        searches.append((filters, name, sign))
        return start

    name = "friction.coulomb@elbow"
    assert [stiff.get_soft_friction_start(name, 1.0, search) for _ in range(2)] == [start] * 2
    # Another search of the same models finds the results of the first one.
    soft.take_over(stiff)
    assert soft.get_soft_friction_start(name, 1.0, search) is start
    assert soft.get_soft_friction_start(name, -1.0, search) is start
    assert searches == [(stiff, name, 1.0), (soft, name, -1.0)]
