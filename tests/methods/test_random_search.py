import numpy as np

from methods.tuners.random_search import RandomSearch
from tests.methods.analytic_problems import run, smooth


def test_draws_are_the_generators_uniform_ones() -> None:
    trace = run(RandomSearch(), *smooth(2, 500), seed=9)
    assert (trace.proposals[1:] == np.random.default_rng(9).uniform(size=(499, 2))).all()
    assert np.allclose(trace.proposals.mean(0), 0.5, atol=0.05)
    assert np.allclose(trace.proposals.std(0), 12**-0.5, atol=0.03)
