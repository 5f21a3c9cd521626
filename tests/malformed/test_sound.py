"""What malformed inputs are made from is sound: otherwise all would be refused, and for no reason
of theirs.
"""

import pytest

from tests.malformed import sound
from tests.malformed.arguments import VECTORS
from tests.malformed.case import Case, tried
from tests.malformed.kinds import files_of_arguments
from tests.malformed.short import environment, shortened

SOUND = [
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


@pytest.mark.parametrize("line", [line for line in SOUND if not any(r in line for r in REFUSED)])
def test_what_is_not_spoilt_is_taken(ready, tmp_path, line):
    _, there = ready
    files = {**files_of_arguments(), "worldly.toml": sound.toml(sound.WORLDLY)}
    for path in there["film"].iterdir():
        files[f"film/{path.name}"] = path.read_bytes()
    case = Case(tuple(line.split()), files, "half" if "resume" in line else "done", owns=("",))
    with environment(tmp_path), shortened():
        heard = tried(case, tmp_path, there)
    assert heard.code == 0, heard.err
