"""Explain a recording as a user would, and measure the time."""

from __future__ import annotations

import importlib
import tempfile
import time
import traceback

EXPLAIN = "bench.diagnosis.explain:explain"


def explained(written, explain=EXPLAIN, **settings):
    """Return the verdict on a recording with its time, or the error.

    Args:
        written: function that writes the recording into a folder and returns its path.
        explain: module:function to examine.
        settings: keyword arguments of that function.
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
