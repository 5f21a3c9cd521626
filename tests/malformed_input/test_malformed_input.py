"""Tests that malformed inputs give one clear line of error.

CI runs a part of the 12,000 cases of `make malformed`. Some random cases are valid.
"""

import shutil
from collections import Counter

import pytest

from tests.malformed_input.input_strategies import SHARES, run_cases, share, strategies
from tests.malformed_input.malformed_case import tried
from tests.malformed_input.shortened_work import environment, shortened


@pytest.mark.slow
@pytest.mark.parametrize("kind", SHARES)
def test_malformed(ready, kind):
    folder, there = ready
    codes, place = Counter(), folder / "place"

    def act(case):
        try:
            codes[tried(case, place, there).code] += 1
        finally:
            shutil.rmtree(place, ignore_errors=True)

    with environment(place), shortened():
        run_cases(strategies(there)[kind], share(kind), act)
    # Too few refusals would mean that the inputs are not malformed.
    assert codes[2] > 0.3 * sum(codes.values())
