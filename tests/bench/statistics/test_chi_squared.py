import math

import pytest
from scipy.special import chdtrc

from bench.benchmark.statistics.chi_squared import chi_squared_tail


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
