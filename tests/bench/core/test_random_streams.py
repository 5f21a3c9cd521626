"""Tests of named random streams."""

import numpy as np

from bench.core.random_streams import make_rng


def test_a_stream_is_the_same_in_every_process_and_on_every_machine():
    drawn = make_rng("a target", "in", 3).integers(1000, size=6)
    assert drawn.tolist() == GOLDEN


GOLDEN = [153, 560, 105, 860, 820, 544]


def test_names_do_not_run_into_each_other_and_their_order_matters():
    names = [("a", "bc"), ("ab", "c"), ("abc",), ("bc", "a"), ("a", "b", "c"), ("a", 1), ("a1",)]
    drawn = [float(make_rng(*each).random()) for each in names]
    assert len(set(drawn)) == len(names)
    np.testing.assert_array_equal(make_rng("a", 1).random(3), make_rng("a", "1").random(3))
