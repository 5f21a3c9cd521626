"""Two thousand malformed experiments, plugins and result folders: each gives one clear line, or is
sound after all.
"""

import shutil
from collections import Counter

import pytest
import tomli_w
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from bench.compare import Comparison
from bench.problem.experiment import load
from bench.problem.problem import Problem
from bench.registry import load_plugins
from bench.runs.runner import check
from bench.store.folder import configuration, read
from sims.base import InputError
from tests.conftest import PLUGINS
from tests.experiments import SPRING, spring_experiment

SPRING_PLUGIN = str(PLUGINS / "spring.py")
SETTINGS = settings(
    deadline=None,
    derandomize=True,
    database=None,
    suppress_health_check=[
        HealthCheck.function_scoped_fixture,
        HealthCheck.too_slow,
        HealthCheck.data_too_large,
    ],
)
FULL = {
    **SPRING,
    "noise": {"x": 0.01},
    "parameters": {"rate": {"training": [2.0, 3.0]}},
    "inputs": {},
    "tuners": {"random": {"seeds": 1}, "cma": {"tuner": "cma_es", "options": {"sigma": 0.2}}},
}
JUNK = st.one_of(
    st.none(), st.booleans(), st.integers(-3, 60),
    st.sampled_from([10**30, -(10**400), 1e308, -0.0, float("nan"),
    float("inf"), "", "x", "nan", "a\nb", "\x1b[31m", "\u2028", "spring", "random", "[]", [],
    [1, 2], [2, 1],
    ["x", "x"], {}, {"x": 1}, {"x": {"y": 1}}, [[1]], "sine:1", "sine:1:0", "real"]),
    st.text(max_size=5), st.floats(),
)  # fmt: skip
seen: Counter[str] = Counter()


def is_one_line(error, names=""):
    message = str(error)
    assert names in message
    assert message.isprintable(), message
    assert 10 < len(message) < 700, message
    seen["refused"] += 1


def without_none(value):
    if isinstance(value, dict):
        return {k: without_none(v) for k, v in value.items() if v is not None}
    return [without_none(v) for v in value if v is not None] if isinstance(value, list) else value


@st.composite
def spoilt_documents(draw):
    """An experiment with one to three things wrong with it, as bytes."""
    document = {k: dict(v) if isinstance(v, dict) else v for k, v in FULL.items()}
    for _ in range(draw(st.integers(1, 3))):
        key = draw(
            st.sampled_from(
                [*FULL, "memory", "settings", "world", "constants", "recording", "ranges", "oops"]
            )
        )
        act = draw(st.integers(0, 3))
        if act == 0:
            document.pop(key, None)
        elif act == 1 and isinstance(document.get(key), dict):
            inner = draw(
                st.sampled_from([*map(str, document[key]), "x", "rate", "nope", "tuner", "seeds"])
            )
            document[key][inner] = draw(JUNK)
        else:
            document[key] = draw(JUNK)
    try:
        data = tomli_w.dumps(without_none(document)).encode("utf-8", "replace")
    except (TypeError, ValueError):
        data = repr(document).encode("utf-8", "replace")
    return spoilt(draw, data)


def spoilt(draw, data, chance=8):
    """The bytes, now and then cut off or with others in them."""
    act, place = draw(st.integers(0, chance)), draw(st.integers(0, max(len(data), 1)))
    if act == 0:
        return data[:place]
    if act == 1:
        return data[:place] + draw(st.binary(max_size=5)) + data[place:]
    if act == 2:
        return data[:place] + draw(
            st.sampled_from([b"\x00", b"\xff\xfe", b"'", b'"""', b"\n[", b"=", b"\xef\xbb\xbf"])
        )
    return data


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    load_plugins([SPRING_PLUGIN])
    return tmp_path_factory.mktemp("malformed")


def examine(path):
    """What `simgap compare` checks before any work, and one target."""
    experiment = load(str(path))
    problem = Problem(experiment)
    check(experiment)
    if experiment.sampling.samples < 1000 and not experiment.recording:
        problem.target(experiment.ranges[0], 0)
    seen["sound"] += 1


@pytest.mark.slow
@settings(SETTINGS, max_examples=1100)
@given(data=spoilt_documents())
def test_spoilt_experiments(folder, data):
    path = folder / "spoilt.toml"
    path.write_bytes(data)
    try:
        examine(path)
    except InputError as error:
        is_one_line(error)


PIECES = [
    "from methods.base import Tuner", "import numpy as np", "class Good{n}(Tuner):\n    pass",
    "class Random(Tuner): pass",
    "class Odd{n}(Tuner):\n    name = 3", "class Odd{n}(Tuner):\n    name = 'a b'",
    "class Odd{n}(Tuner):\n    name = ''",
    "class Odd{n}(Tuner):\n    requires = 5", "raise ValueError('a\\nb')", "raise SystemExit(3)",
    "1/0", "def f(:", "\tx = 1", "import no_such_thing", "from sims.base import Simulator",
    "assert False", "x = (",
    "class S{n}(Simulator):\n    name = 's{n}'",
    "class S{n}(Simulator):\n    def simulate(self, a, b): pass",
    "from sims.system import Effect", "class E{n}(Effect):\n    name = 'drag.linear'",
    "class E{n}(Effect): pass",
    "def recurse(): recurse()\nrecurse()", "exit()", "class Odd{n}(Tuner, metaclass=5): pass",
    "'\\ud800'", "# \x00",
]  # fmt: skip
count = iter(range(10**9))


@pytest.mark.slow
@settings(SETTINGS, max_examples=450)
@given(
    pieces=st.lists(st.sampled_from(PIECES), max_size=5),
    junk=st.binary(max_size=30),
    tail=st.integers(0, 5),
)
def test_spoilt_plugins(folder, pieces, junk, tail):
    number = next(count)
    path = folder / f"plugin_{number}.py"
    text = "\n".join(pieces).replace("{n}", str(number)).encode("utf-8", "surrogatepass")
    path.write_bytes(text + (junk if tail == 0 else b""))
    try:
        load_plugins([path])
        seen["sound"] += 1
    except InputError as error:
        is_one_line(
            error, f"plugin_{number}.py" if "exists already" not in str(error) else "exists already"
        )
    finally:
        path.unlink()


@pytest.fixture(scope="module")
def results(folder):
    """A finished folder, and one that was interrupted."""
    experiment = spring_experiment(targets=1, seeds=1, tuners={"random": {}})
    Comparison.begin(experiment, [SPRING_PLUGIN], folder / "done").make(jobs=1)
    results = Comparison.begin(experiment, [SPRING_PLUGIN], folder / "half").results
    from bench.runs.runner import run

    run(results, [SPRING_PLUGIN], 1)
    results.kept.close()
    return folder / "done", folder / "half"


@st.composite
def damages(draw):
    """Which file of a folder is spoilt, and how."""
    half = draw(st.booleans())
    common = ["experiment.toml", "environment.json"]
    name = draw(st.sampled_from([*common,
    *(["segments/plan.txt", "segments/000001.journal"] if half else []),
                                 *([] if half else ["runs.parquet", "status.csv",
                                 "training.csv"])]))  # fmt: skip
    return (
        half,
        name,
        draw(st.sampled_from(["missing", "empty", "cut", "spoilt", "other"])),
        draw(st.randoms()),
    )


@pytest.mark.slow
@settings(SETTINGS, max_examples=450)
@given(damage=damages())
def test_half_written_and_damaged_folders(folder, results, damage):
    half, name, how, random = damage
    place = folder / "damaged"
    shutil.rmtree(place, ignore_errors=True)
    shutil.copytree(results[half], place)
    path = place / name
    data = path.read_bytes()
    cut = random.randrange(len(data) + 1)
    if how == "missing":
        path.unlink()
    elif how == "other":
        path.write_bytes(
            random.choice(
                [b"{}", b"[]", b"null", b"a,b\n1,2\n", b"PAR1PAR1", b'{"experiment": 3}', b"\xff"]
            )
        )
    else:
        spoiled = {
            "empty": b"",
            "cut": data[:cut],
            "spoilt": data[:cut] + bytes([random.randrange(256)]) + data[cut + 1 :],
        }
        path.write_bytes(spoiled[how])
    for act in (
        lambda: read(place),
        lambda: configuration(place),
        lambda: seen.update(["said"] * len(Comparison(place).status().ends)),
        lambda: Comparison.resume(place),
    ):
        try:
            made = act()
            if isinstance(made, Comparison) and hasattr(made.results.kept, "close"):
                made.results.kept.close()
        except InputError as error:
            is_one_line(error)


def test_there_were_two_thousand_and_most_were_refused():
    if not seen:
        pytest.skip("needs the tests before it")
    assert seen["refused"] > 1500
    assert seen["sound"] > 20
