import numpy as np

from bench.diagnosis.evaluation import simulation_cache
from bench.diagnosis.evaluation.simulation_cache import SimulationCache

ROW = np.zeros((2, 1)).nbytes


def rows(*values):
    return np.array([np.full((2, 1), value) for value in values])


def fill_cache(cache, keys, rows_by_key):
    """Fill the cache as a run evaluator does; return the results and the simulated keys."""
    new = cache.missing(keys)
    out = np.full((len(keys), 2, 1), np.nan)
    cache.fill(keys, new, rows(*(rows_by_key[keys[place]] for place in new)), out)
    return out[:, 0, 0].tolist(), [keys[place] for place in new]


def test_what_it_holds_is_its_own():
    cache = SimulationCache()
    results, out = rows(1.0), np.empty((1, 2, 1))
    cache.fill([b"a"], cache.missing([b"a"]), results, out)
    results[:] = out[:] = 7.0
    assert fill_cache(cache, [b"a"], {}) == ([1], [])


def test_beyond_its_limit_the_oldest_are_dropped(monkeypatch):
    monkeypatch.setattr(simulation_cache, "CACHE_BYTES", 2 * ROW)
    cache = SimulationCache()
    made = {key: float(place) for place, key in enumerate([b"a", b"b", b"c", b"d"])}
    # One call may request more results than the cache can hold, and equal ones.
    found = fill_cache(cache, [b"a", b"b", b"a", b"c"], made)
    assert found == ([0, 1, 0, 2], [b"a", b"b", b"c"])
    assert fill_cache(cache, [b"b", b"c"], made) == ([1, 2], [])
    # Results needed by this call are returned although they are dropped at its end.
    assert fill_cache(cache, [b"b", b"d", b"c", b"a"], made) == ([1, 3, 2, 0], [b"d", b"a"])
    assert fill_cache(cache, [b"d", b"a"], {}) == ([3, 0], [])
