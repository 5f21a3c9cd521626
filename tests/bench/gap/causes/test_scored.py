"""What is kept between scans of one model."""

from dataclasses import replace

import numpy as np
import pytest

from bench.gap.causes.structure import remains
from tests.bench.gap.made import recording, searched


@pytest.mark.parametrize(("moved", "anew"), [(0.01, False), (1.0, True)])
def test_directions_are_simulated_anew_where_a_model_has_moved(moved, anew):
    """A fit a little to the side, by so many sigmas RMS, takes the place of the base model."""
    recorded = recording("slider", noise=["0.01"], observe=["x"], runs=2, seconds=2.0, rate=50.0)
    search, base = searched(recorded, 0.01, candidates=["friction.coulomb", "spring.linear"])
    search.scan(base)
    once = search.world.simulations
    assert search.scan(base) is search.scanned[frozenset()].scores

    shifted = replace(base.fit, simulated=base.fit.simulated + moved * 0.01, cost=0.0)
    search.models[frozenset()] = replace(base, merit=-np.inf)
    again = search.enter(shifted)
    scores = search.scan(again)
    assert (search.world.simulations > once) is anew
    # The residual is the new one's, whatever it is compared with.
    assert scores is not search.former.get(frozenset())
    assert set(scores.effects) == {"friction.coulomb", "spring.linear"}
    np.testing.assert_array_equal(
        search.scanned[frozenset()].at.simulated, (shifted if anew else base.fit).simulated
    )


def test_scores_of_a_model_do_not_hang_on_what_was_scored_before():
    recorded = recording(
        "slider", effects=["friction.coulomb=0.1"], noise=["0.01"], observe=["x"], runs=2, rate=50.0
    )
    chances = []
    for first in (True, False):
        search, base = searched(
            recorded, 0.01, candidates=["friction.coulomb", "spring.linear", "drag.linear"]
        )
        start = replace(base.fit.start(), effects=("drag.linear",))
        search.refit([start])
        larger = search.models[frozenset(["drag.linear"])]
        models = [base, larger] if first else [larger, base]
        for model in models:
            search.scan(model)
            remains(search, model)
        chances.append([*search.scan(base).chance, *search.scan(larger).chance])
        chances[-1].append(remains(search, larger).p_value)
    assert chances[0] == chances[1]
