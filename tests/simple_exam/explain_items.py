"""A recording that is explained, as its user would have it, and timed."""

from __future__ import annotations

import importlib
import tempfile
import time
import traceback

EXPLAIN = "bench.diagnosis.explain:explain"


def explained(written, explain=EXPLAIN, **settings):
    """The verdict on a recording, and what it took; or why there is none.

    Args:
        written: writes the recording into a folder, and returns its path.
        explain: module:function to examine.
        settings: of that function.
    """
    module, function = explain.split(":")
    row = {"verdict": None, "seconds": None, "error": ""}
    with tempfile.TemporaryDirectory() as folder:
        path = written(folder)
        begin, busy = time.perf_counter(), time.process_time()
        try:
            asked = getattr(importlib.import_module(module), function)
            document = asked(path, **settings).answer.to_document()
            row["verdict"] = {key: v for key, v in document.items() if key != "candidates"}
        except Exception:
            row["error"] = traceback.format_exc(limit=-4)
        row["seconds"] = time.perf_counter() - begin
        row["processor"] = time.process_time() - busy
    return row
