from types import SimpleNamespace

import numpy as np
import pytest

from bench.gap.causes import settle as settling
from bench.gap.causes.settle import NEAR, NEARLY, rivals, settle
from bench.gap.model.noise import Noise
from tests.bench.gap.causes.models import model, search_of


def test_rivals_are_near_by_merit_or_by_what_they_leave():
    best = model("a", merit=100.0)
    by_merit = model("b", merit=100.0 - 0.9 * NEAR)
    by_excess, far = model("c"), model("d")
    larger = model("a", "b", merit=100.0)
    excess = {("a",): 1.0, ("b",): 9.0, ("c",): 0.9 * NEARLY, ("d",): 1.1 * NEARLY}
    search = search_of(best, by_merit, by_excess, far, larger, excess=excess)
    assert [m.names for m in rivals(search, best)] == [("a",), ("b",), ("c",)]


@pytest.mark.parametrize(("structure", "stands"), [(False, "b"), (True, "a")])
def test_a_rival_that_is_better_fitted_to_the_end_stands_unless_structure_is_left(
    monkeypatch, structure, stands
):
    base, best = model(), model("a", merit=100.0)
    search = search_of(base, best, model("b", merit=90.0))
    search.world = SimpleNamespace(library=["a", "b"])
    refits = []

    def refit(starts, noise):
        refits.append(([start.effects for start in starts], noise))
        search.models[frozenset("b")] = model("b", merit=110.0)

    search.refit, search.extend = refit, lambda models, most: None
    monkeypatch.setattr(settling, "neighbours", lambda world, fit: [])
    monkeypatch.setattr(
        settling, "remains", lambda search, model: SimpleNamespace(structure=structure)
    )
    assert settle(search, best).names == (stands,)
    ((effects, noise),) = refits
    assert effects == [("a",), ("b",), ()], "it, its rivals and what it is measured against"
    if structure:
        assert noise is None
    else:
        assert isinstance(noise, Noise)
        assert np.array_equal(noise.sigma, [1.0])
