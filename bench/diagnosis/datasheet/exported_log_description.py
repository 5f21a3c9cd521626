"""Description of a system's log for the MJCF model that its data sheet exports.

With it, the exported model can be scored on the same log (`simgap score`).
"""

from __future__ import annotations

from collections.abc import Iterator
from os.path import relpath
from pathlib import Path
from typing import Any

from bench.diagnosis.datasheet.constants_groups import ConstantsGroup
from bench.diagnosis.datasheet.sheet_content import SheetContent
from sims.core.system import RenderedModelFile
from sims.core.toml_validation import read_toml
from sims.recording.recording import Run
from sims.recording.recording_description import get_description_path

MOTOR_ON_THRESHOLD = 0.5
"""Value of a switching input above which the motor is on."""


def describe_log_for_model(
    sheet: SheetContent, group: ConstantsGroup, model: RenderedModelFile, stem: str, folder: Path
) -> Iterator[tuple[str, str]]:
    """Yield a description of the log for the model, in which its runs are marked held out.

    Nothing is yielded for a log of several files.
    """
    import tomli_w

    path = sheet.recording.path
    if path.suffix != ".csv" or any(run.log for run in sheet.recording.runs):
        return
    log_description = read_toml(get_description_path(path))
    file = relpath(path.resolve(), folder.resolve())
    document: dict[str, Any] = {
        "model": f"{stem}.xml",
        "title": f"{sheet.name} as {stem}.xml",
        "channels": {},
        "inputs": {},
        "runs": {
            run.name: {"held_out": True} for run in group.runs if _is_motor_always_on(run, model)
        },
    }
    for kind in ("channels", "inputs"):
        for name, description in log_description.get(kind, {}).items():
            if name in model.signals:
                document[kind][model.signals[name]] = {"file": file, "column": name, **description}
    yield f"{stem}.toml", tomli_w.dumps(document)


def _is_motor_always_on(run: Run, model: RenderedModelFile) -> bool:
    """Return whether the inputs that switch the motor are on all the time."""
    switches = [values for name, values in run.inputs.items() if name not in model.signals]
    return all(bool((values > MOTOR_ON_THRESHOLD).all()) for values in switches)
