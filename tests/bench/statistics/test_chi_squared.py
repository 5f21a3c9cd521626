import math

import pytest
from scipy.special import chdtrc, chdtri

from bench.benchmark.statistics.chi_squared import chi_squared_quantile, chi_squared_tail


@pytest.mark.parametrize("freedom", [1, 2, 3, 4, 9, 10, 99, 1000, 5001])
@pytest.mark.parametrize("ratio", [1e-6, 0.3, 0.9, 1.0, 1.1, 2.0, 10.0])
def test_it_is_the_tail_of_scipy(freedom, ratio):
    found, expected = chi_squared_tail(freedom, ratio * freedom), chdtrc(freedom, ratio * freedom)
    assert found == pytest.approx(expected, rel=2e-11, abs=1e-300)


def test_its_ends_are_certain_and_impossible():
    assert chi_squared_tail(3, 0.0) == chi_squared_tail(3, -1.0) == 1.0
    assert chi_squared_tail(3, math.inf) == 0.0
    assert math.isnan(chi_squared_tail(3, math.nan))
    with pytest.raises(ValueError, match="at least 1 degree of freedom, found 0"):
        chi_squared_tail(0, 1.0)


@pytest.mark.parametrize("freedom", [1, 2, 3, 7, 40])
@pytest.mark.parametrize("tail", [1e-12, 0.01, 0.1, 0.5, 0.999])
def test_its_quantile_is_that_of_scipy(freedom, tail):
    assert chi_squared_quantile(freedom, tail) == pytest.approx(chdtri(freedom, tail), rel=1e-10)


@pytest.mark.parametrize("tail", [0.0, -0.1, 1.5, math.nan])
def test_a_quantile_needs_a_probability(tail):
    with pytest.raises(ValueError, match="expected a probability above 0 and at most 1"):
        chi_squared_quantile(3, tail)
