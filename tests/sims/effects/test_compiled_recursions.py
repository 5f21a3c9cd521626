"""Tests of the compiled recursions of effects with memory."""

from functools import partial

import numpy as np
import pytest

from sims.effects.compiled_recursions import CLAMP, LINEAR, RATE_LIMIT, run_recursion
from sims.engines.compiled import compiled_functions


def test_recursions_of_few_steps_have_the_values_of_their_equations():
    a = np.array([[0.5, 0.5, 2.0], [1.0, -1.0, 0.0]])
    b = np.array([[1.0, 3.0, 0.5], [0.25, 0.25, 0.25]])
    start = np.array([[2.0], [0.0]])
    # y' = a y + b
    linear = run_recursion(LINEAR, a, b, start)
    np.testing.assert_array_equal(linear, [[2.0, 4.0, 8.5], [0.25, 0.0, 0.25]])
    # y' = min(max(y, a), b)
    clamped = run_recursion(CLAMP, a, b, start)
    np.testing.assert_array_equal(clamped, [[1.0, 1.0, 0.5], [0.25, 0.25, 0.25]])
    # y' = y + min(max(a - y, -b), b)
    limited = run_recursion(RATE_LIMIT, a, b, start)
    np.testing.assert_array_equal(limited, [[1.0, 0.5, 1.0], [0.25, 0.0, 0.0]])


@pytest.mark.parametrize("kind", [LINEAR, CLAMP, RATE_LIMIT])
def test_compiled_and_interpreted_recursions_agree(kind, monkeypatch):
    rng = np.random.default_rng(5)
    a, b = rng.uniform(-1.0, 0.0, (4, 50)), rng.uniform(0.0, 1.0, (4, 50))
    a[1, 20], b[2, 30] = np.nan, np.inf
    start = rng.normal(size=(4, 1))
    compiled = run_recursion(kind, a, b, start)
    monkeypatch.setattr(
        compiled_functions.CompiledFunctions,
        "_bind",
        lambda _self, function, _sizes, arguments: partial(function, *arguments),
    )
    np.testing.assert_array_equal(compiled, run_recursion(kind, a, b, start))


def test_operands_and_starts_may_share_memory_and_have_any_order():
    steps = np.broadcast_to(np.array([0.5, 0.25, 0.125]), (2, 3))
    additions = np.asfortranarray([[1.0, 1.0, 1.0], [0.0, 2.0, 0.0]])
    result = run_recursion(LINEAR, steps, additions, np.zeros((2, 1)))
    np.testing.assert_array_equal(result, [[1.0, 1.25, 1.15625], [0.0, 2.0, 0.25]])
