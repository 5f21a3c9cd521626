import pytest
from scipy.special import stdtr

from bench.benchmark.statistics.student_t import student_p_value


@pytest.mark.parametrize("freedom", [1, 2, 3, 4, 9, 30])
@pytest.mark.parametrize("size", [0.0, 0.3, 1.0, 2.5, 8.0])
def test_the_p_value_of_students_distribution_is_that_of_scipy(size, freedom):
    expected = 2.0 * stdtr(freedom, -size)
    assert student_p_value(size, freedom) == pytest.approx(expected, rel=1e-9, abs=1e-15)
