"""A share of the twelve thousand malformed inputs of `make malformed`: each gives one clear line,
or is sound after all.
"""

import shutil
from collections import Counter

import pytest

from tests.malformed_input.input_strategies import SHARES, made, share, strategies
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
        made(strategies(there)[kind], share(kind), act)
    # Otherwise nothing would have been tried.
    assert codes[2] > 0.3 * sum(codes.values())
