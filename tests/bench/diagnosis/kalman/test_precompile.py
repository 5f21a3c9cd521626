import os
import subprocess
import sys

import pytest

SIGNATURES = """
from bench.diagnosis.kalman.precompile import precompile
from bench.diagnosis.kalman.compiled_recursions import (
    filter_recursion, smoother_recursion
)
precompile()
before = [set(f.signatures) for f in (filter_recursion, smoother_recursion)]
assert all(before), before
from bench.diagnosis.explain import explain
explain("examples/robot/log.csv")
assert before == [set(f.signatures) for f in (filter_recursion, smoother_recursion)]
"""


@pytest.mark.slow
def test_an_explanation_needs_no_other_code(tmp_path):
    pytest.importorskip("numba")
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    subprocess.run([sys.executable, "-c", SIGNATURES], check=True, env=environment)
    assert list(tmp_path.rglob("*_filter*.nbc"))
