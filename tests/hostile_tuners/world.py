"""A plugin that claims to be the simulator, to be imported where true parameters are,
and a tuner.
"""

import contextlib
import sys
from pathlib import Path

from methods.tuners.random_search import RandomSearch

with contextlib.suppress(OSError):
    Path(__file__).with_suffix(".imported").write_text(" ".join(sys.modules))


def answer():
    """Patch the plugin inspection to report a simulator that does not exist."""
    from bench.benchmark.runner import plugin_inspection

    said = {"kind": "simulator", "name": "spring", "says": ""}
    plugin_inspection._describe_class = lambda _kind, _part: said


with contextlib.suppress(Exception):
    answer()


class World(RandomSearch):
    name = "world"
