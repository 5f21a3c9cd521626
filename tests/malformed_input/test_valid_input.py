"""Tests that the inputs from which malformed ones are made are valid.

Otherwise all cases would be refused, for a reason that the corruption did not cause.
"""

import pytest

from tests.malformed_input import valid_input
from tests.malformed_input.input_strategies import files_of_arguments
from tests.malformed_input.malformed_arguments import VECTORS
from tests.malformed_input.malformed_case import Case, tried
from tests.malformed_input.shortened_work import environment, shortened

VALID_CASES = [
    *VECTORS,
    "compare worldly.toml --out out",
    "explain ball.csv --out out",
    "score extended.toml data.csv",
    "track film/drop.mp4 --out track.csv",
]
REFUSED = (
    "track none.mp4",
    "download so101",
    "download all",
    "--cluster",
    "score extended.toml data.csv --json --held-out",
)


@pytest.mark.parametrize(
    "line", [line for line in VALID_CASES if not any(r in line for r in REFUSED)]
)
def test_undamaged_files_are_accepted(ready, tmp_path, line):
    _, there = ready
    files = {**files_of_arguments(), "worldly.toml": valid_input.toml(valid_input.WORLDLY)}
    for path in there["film"].iterdir():
        files[f"film/{path.name}"] = path.read_bytes()
    case = Case(tuple(line.split()), files, "half" if "resume" in line else "done", owns=("",))
    with environment(tmp_path), shortened():
        heard = tried(case, tmp_path, there)
    assert heard.code == 0, heard.err
