import gc
import os
import signal
from collections import Counter
from importlib.util import find_spec
from pathlib import Path
from zlib import crc32

import pytest

from tests.data_dependence import can_be_slow_or_data, find_data_dependent_names

PLUGINS = Path(__file__).parent / "plugins"

_SHARED = Path(__file__).parents[2] / "shared"
_DATA_FOLDER = _SHARED / "data"
"""Default folder of the real recordings, on machines that have it."""

# Child processes inherit these values; values set by the user have priority.
for _name, _folder in (("SIMGAP_DATA", _DATA_FOLDER), ("SIMGAP_ROBOTS", _SHARED / "robots")):
    if _folder.is_dir():
        os.environ.setdefault(_name, str(_folder))

# One thread per test: parallel tests would compete for the processors.
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

# Commands that tests start store their byte code: without it each compiles 300 modules.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)

# Nothing that is collected is garbage: looking for it took a quarter of the time of the collection.
gc.disable()

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # background jobs ignore it
    signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_configure(config):
    """Compile native code before pytest starts its workers, which would all wait for it.

    Compiling is reported once on stderr, where some tests expect nothing.
    """
    if not hasattr(config, "workerinput"):
        from bench.diagnosis.kalman import kalman_recursions
        from sims.effects import compiled_recursions
        from sims.engines.compiled import element_stepping

        for module in (element_stepping, compiled_recursions, kalman_recursions):
            module.COMPILED.load()
        if find_spec("mujoco") is not None:
            from sims.robot.dynamics.mujoco_callback import find_data_offsets, load_callback

            offsets = find_data_offsets()
            if offsets is not None:
                load_callback(offsets)


def pytest_collection_finish():
    """Exclude modules and collected tests from garbage collection, which tests would pay for."""
    gc.freeze()
    gc.set_threshold(10_000, 10, 10)
    gc.enable()


@pytest.fixture(scope="session")
def spring():
    """Register and return the test simulator."""
    from bench.core.plugin_registries import load_plugins, simulators

    load_plugins([PLUGINS / "spring.py"])
    return simulators.get("spring")


@pytest.fixture(autouse=True)
def own_cache(tmp_path_factory, monkeypatch):
    """Use a separate cache for the trained weights and data sets of tests."""
    monkeypatch.setenv("SIMGAP_CACHE", str(tmp_path_factory.getbasetemp() / "cache"))
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path_factory.getbasetemp() / "data"))


@pytest.fixture(scope="session")
def recordings():
    """Return the folder of real recordings; skip the test if it does not exist."""
    folder = Path(os.environ.get("SIMGAP_DATA", _DATA_FOLDER))
    if not folder.is_dir():
        pytest.skip(f"no recordings: {folder} is missing (set SIMGAP_DATA)")
    return folder


@pytest.fixture(scope="module", autouse=True)
def registries_as_before():
    """Undo the registrations of a test module, except for the test simulator."""
    from bench.core.plugin_registries import REGISTRIES, simulators

    before = [registry.snapshot() for registry in REGISTRIES]
    yield
    # Other modules use the class that the session-scoped fixture registered.
    shared = {name: part for name, part in simulators.snapshot().items() if name == "spring"}
    for registry, snapshot in zip(REGISTRIES, before, strict=True):
        registry.restore(snapshot)
    simulators.restore({**simulators.snapshot(), **shared})


@pytest.fixture
def fresh_registries():
    """Undo the registrations of a test."""
    from bench.core.plugin_registries import REGISTRIES

    before = [registry.snapshot() for registry in REGISTRIES]
    yield
    for registry, snapshot in zip(REGISTRIES, before, strict=True):
        registry.restore(snapshot)


@pytest.fixture
def undrawn():
    """Make comparisons in this process write tables only, without figures and pages."""
    from tests import without_drawing

    with without_drawing.undrawn():
        yield


def pytest_addoption(parser):
    parser.addoption("--part", metavar="K/N", help="of the slow test files, the Kth of N parts")


def is_in_part(path, part):
    """Return whether a test file belongs to a part.

    Parts are drawn by the name of the file, so that they have similar durations.

    Args:
        path: path of the file.
        part: number of the part from 1, and number of parts, as "1/3"; None for all files.
    """
    if not part:
        return True
    number, count = map(int, part.split("/"))
    return crc32(path.name.encode()) % count == number - 1


SLOW_OR_DATA = "(slow or data) and not long"
"""Marker expression of `make test-rest`."""


def pytest_ignore_collect(collection_path, config):
    """Do not import test files of which `make test-rest` would deselect every test.

    Each worker would import them, which takes half of the time of the collection.
    """
    is_test_file = collection_path.match("test_*.py")
    if not is_test_file:
        return None
    if not is_in_part(collection_path, config.getoption("part")):
        return True
    if config.getoption("markexpr") == SLOW_OR_DATA:
        return True if not can_be_slow_or_data(collection_path.read_text()) else None
    return None


_SECONDS = {True: 15.0, False: 0.2}
"""Approximate duration of a test in seconds, by whether it is marked as slow.

A mark ``slow(seconds=...)`` states the duration of a test that takes much longer.
"""


@pytest.hookimpl(tryfirst=True)  # before `-m` selects tests by marker
def pytest_collection_modifyitems(items):
    """Mark tests that depend on the folder of recordings, and run the slowest files first.

    A slow file that starts last would keep the other workers waiting.
    """
    seconds = Counter()
    sources = {path: path.read_text() for path in {item.path for item in items}}
    reads = {path: find_data_dependent_names(source) for path, source in sources.items()}
    for item in items:
        name = item.originalname if item.cls is None else item.cls.__name__
        if name in reads[item.path] or "recordings" in item.fixturenames:
            item.add_marker(pytest.mark.data)
        slow = item.get_closest_marker("slow")
        if (slow or item.get_closest_marker("data")) and not can_be_slow_or_data(
            sources[item.path]
        ):
            raise pytest.UsageError(
                f"{item.nodeid} is marked, but `make test-rest` would ignore its file: write "
                "`pytest.mark.slow` or the parameter `recordings` there"
            )
        seconds[item.path] += (
            slow.kwargs.get("seconds", _SECONDS[True]) if slow else _SECONDS[False]
        )
    items.sort(key=lambda item: -seconds[item.path])


@pytest.fixture(scope="session")
def browser():
    """Start one headless browser for all page tests; skip them if no browser is installed."""
    from tests.browser import launched

    with launched() as started:
        yield started
