import shutil
from pathlib import Path

import pytest

from bench.diagnosis.evaluation.run_evaluator import RunEvaluator
from bench.logs.recording_joining import load_joined

EXAMPLE = Path(__file__).parents[2] / "examples" / "robot"


@pytest.fixture(scope="session")
def example_arm():
    """Return the first two runs of the example robot; tests do not change them."""
    recording, kind = load_joined([EXAMPLE / "log.csv"])
    evaluator = RunEvaluator(kind, recording, recording.training()[:2], kind.default_engine)
    yield evaluator
    evaluator.close()


@pytest.fixture(scope="session")
def arm_log(tmp_path_factory):
    """Return the path of a log with the first run of the example robot."""
    folder = tmp_path_factory.mktemp("arm")
    shutil.copy(EXAMPLE / "arm2.xml", folder)
    with (EXAMPLE / "log.csv").open() as rows:
        (folder / "log.csv").write_text("".join(next(rows) for _ in range(401)))
    text = (EXAMPLE / "log.toml").read_text().split("[runs.5]")[0]
    (folder / "log.toml").write_text(text)
    return folder / "log.csv"
